//! Submaps from end to end on real data.
mod data;
mod ransac;
mod world;

use data::{Place, Set};
use merganser_protocol::geometry::{Se3, Sim3};
use merganser_protocol::submap::{RefineConfig, fit, match_keypoints, refine};
use nalgebra::Vector3;
use std::time::Instant;

fn overlap(a: &Place, b: &Place, t_b_a: &Se3, radius: f64) -> f64 {
    let mine: Vec<Vector3<f64>> = b.described.features.surfels().iter().map(|s| s.position).collect();
    let theirs: Vec<Vector3<f64>> = a.described.features.surfels().iter().map(|s| *t_b_a * s.position).collect();
    let _ = &mine;
    let mut cells = std::collections::BTreeMap::<[i64; 3], Vec<Vector3<f64>>>::new();
    let key = |p: &Vector3<f64>| [p.x, p.y, p.z].map(|x| (x / radius).floor() as i64);
    for p in &mine { cells.entry(key(p)).or_default().push(*p); }
    let hit = |p: &&Vector3<f64>| {
        let k = key(p);
        (-1..=1).any(|x| (-1..=1).any(|y| (-1..=1).any(|z| cells.get(&[k[0] + x, k[1] + y, k[2] + z]).is_some_and(|c| c.iter().any(|q| (q - **p).norm() < radius)))))
    };
    theirs.iter().filter(hit).count() as f64 / theirs.len() as f64
}

fn report(set: &Set) {
    println!("{}: points {:?}", set.name, set.places.iter().map(|p| p.described.features.len()).collect::<Vec<_>>());
    println!("describe ms {:?}", set.places.iter().map(|p| p.describe_time.as_millis()).collect::<Vec<_>>());
    let v = set.config.voxel_m;
    for count in [128, 256, 384] {
        let (mut ok, mut total, mut ratio, mut pairs, mut time) = (0, 0, 0.0, 0, 0.0);
        for (ia, a) in set.places.iter().enumerate() {
            let keypoints = a.described.keypoints.first(count);
            for (ib, b) in set.places.iter().enumerate() {
                if ia == ib { continue; }
                let truth = b.t_world_anchor.inverse() * a.t_world_anchor;
                if overlap(a, b, &truth, 1.5 * v) < 0.25 { continue; }
                total += 1;
                let start = Instant::now();
                let matches = match_keypoints(&keypoints, &b.described.features);
                time += start.elapsed().as_secs_f64();
                let inl = matches.source.iter().zip(&matches.target).filter(|(s, t)| (truth * Vector3::from(**s) - Vector3::from(**t)).norm() < 1.5 * v).count();
                ratio += inl as f64 / matches.source.len() as f64;
                pairs += matches.source.len();
                let (pose, _support) = ransac::solve(&matches, 1.5 * v, 1);
                let error = pose.local(&truth);
                let rot = error.fixed_rows::<3>(3).norm().to_degrees();
                let tra = (pose.translation - truth.translation).norm();
                let good = rot < set.rotation_deg_max && tra < set.translation_max;
                ok += usize::from(good);
                let _ = fit(&keypoints, &b.described.features, &Sim3::from_se3(&pose), 1.5 * v);
            }
        }
        let n = f64::from(total);
        println!("N {count}: {ok}/{total} matches {:.0} inlier ratio {:.3} match {:.1} ms", pairs as f64 / n, ratio / n, time / n * 1e3);
    }
}

fn chi(set: &Set, config: &RefineConfig, count: usize, verbose: bool) {
    let v = set.config.voxel_m;
    let (mut nees, mut errs, mut fails, mut sig) = (vec![], vec![], vec![], vec![]);
    let (mut nt, mut nr) = (vec![], vec![]);
    for (ia, a) in set.places.iter().enumerate() {
        let keypoints = a.described.keypoints.first(count);
        for (ib, b) in set.places.iter().enumerate() {
            if ia == ib { continue; }
            let truth = b.t_world_anchor.inverse() * a.t_world_anchor;
            let ov = overlap(a, b, &truth, 1.5 * v);
            if ov < 0.25 { continue; }
            let matches = match_keypoints(&keypoints, &b.described.features);
            let (rough, _) = ransac::solve(&matches, 1.5 * v, 1);
            let e0 = rough.local(&truth);
            let (rot, tra) = (e0.fixed_rows::<3>(3).norm().to_degrees(), (rough.translation - truth.translation).norm());
            if !(rot < set.rotation_deg_max && tra < set.translation_max) { continue; }
            if let Some(path) = std::env::var_os("DUMP") { use std::io::Write; let mut f = std::fs::OpenOptions::new().append(true).create(true).open(path).unwrap(); writeln!(f, "T {} {ia} {ib} {ov} {:?}", set.name, truth.log().as_slice()).unwrap(); }
            if let Some(path) = std::env::var_os("DUMP") { use std::io::Write; let mut f = std::fs::OpenOptions::new().append(true).create(true).open(path).unwrap(); writeln!(f, "T {} {ia} {ib} {ov} {:?}", set.name, truth.log().as_slice()).unwrap(); }
            match refine(&keypoints, &b.described.features, &rough, config) {
                Ok(r) => {
                    let e = r.pose.pose.local(&truth);
                    let n = r.pose.covariance.mahalanobis_squared(&e);
                    let m = r.pose.covariance.matrix();
                    let (et, er) = (e.fixed_rows::<3>(0).into_owned(), e.fixed_rows::<3>(3).into_owned());
                    nt.push(et.dot(&m.fixed_view::<3,3>(0,0).into_owned().try_inverse().unwrap().mul_vec(&et)));
                    nr.push(er.dot(&m.fixed_view::<3,3>(3,3).into_owned().try_inverse().unwrap().mul_vec(&er)));
                    if verbose { println!("{ia}-{ib} ov {ov:.2} rough {rot:.2}° {:.3} refined {:.2}° {:.3} nees {n:.1} pairs {} rms {:.4} sig {:.4} {:.3}°", tra, er.norm().to_degrees(), et.norm(), r.pairs, r.rms, m.fixed_view::<3,3>(0,0).trace().sqrt(), m.fixed_view::<3,3>(3,3).trace().sqrt().to_degrees()); }
                    nees.push(n);
                    errs.push((er.norm().to_degrees(), et.norm()));
                    sig.push((m.fixed_view::<3,3>(3,3).trace().sqrt().to_degrees(), m.fixed_view::<3,3>(0,0).trace().sqrt()));
                }
                Err(e) => { if verbose { println!("{ia}-{ib} ov {ov:.2} {e}"); } fails.push(e) }
            }
        }
    }
    let med = |mut v: Vec<f64>| { v.sort_by(f64::total_cmp); v[v.len() / 2] };
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    println!("{} N {count}: n {} fails {} NEES mean {:.2} med {:.2} t {:.2} r {:.2} in95 {:.2} err med {:.3}° {:.4} sigma med {:.3}° {:.4}", set.name, nees.len(), fails.len(), mean(&nees), med(nees.clone()), mean(&nt), mean(&nr),
        nees.iter().filter(|n| **n < 12.59).count() as f64 / nees.len() as f64, med(errs.iter().map(|e| e.0).collect()), med(errs.iter().map(|e| e.1).collect()), med(sig.iter().map(|e| e.0).collect()), med(sig.iter().map(|e| e.1).collect()));
}

trait MulVec { fn mul_vec(&self, v: &Vector3<f64>) -> Vector3<f64>; }
impl MulVec for nalgebra::Matrix3<f64> { fn mul_vec(&self, v: &Vector3<f64>) -> Vector3<f64> { self * v } }

#[test]
fn calib() {
    let Some(data) = data::shared() else { return };
    let halls = world::World::hall(1).set("hall", 8, [5.0, 3.0], 0.005, 2);
    report(&halls);
    let clean = world::World::hall(3).set("hall-clean", 8, [5.0, 3.0], 0.0, 2);
    let corr = world::World::corridor().set("corridor", 4, [1.0, 0.5], 0.002, 3);
    for set in [data::seven_scenes(&data), data::kitti07(&data), halls, clean, corr] {
        let c = RefineConfig::default();
        chi(&set, &c, 384, true);
        if std::env::var_os("DUMP").is_some() { continue; }
        if std::env::var_os("DUMP").is_some() { continue; }
        for (inflation, sandwich, floor) in [(1.0, 0.0, 1e-6), (0.0, 1.0, 1e-6), (1.0, 1.0, 1e-6), (1.0, 1.0, 0.05), (1.0, 1.0, 0.1), (1.0, 1.0, 0.2), (3.0,1.0,0.1)] {
            let c = RefineConfig { inflation, sandwich, floor_voxels: floor, floor_rim_voxels: floor, ..c.clone() };
            print!("inf {inflation} sand {sandwich} floor {floor}: "); chi(&set, &c, 384, false);
        }
    }
}

#[test]
fn seven() {
    let Some(data) = data::shared() else { return };
    report(&data::seven_scenes(&data));
}
#[test]
fn kitti() {
    let Some(data) = data::shared() else { return };
    report(&data::kitti07(&data));
}

#[test]
fn select() {
    let Some(data) = data::shared() else { return };
    report(&data::seven_scenes(&data));
    report(&data::kitti07(&data));
    report(&world::World::hall(1).set("hall", 6, [5.0, 3.0], 0.005, 2));
    report(&world::World::hall(5).set("hall5", 6, [5.0, 3.0], 0.005, 2));
}

#[test]
fn corridor() {
    let set = world::World::corridor().set("corridor", 4, [1.0, 0.5], 0.002, 3);
    for a in &set.places { for b in &set.places {
        let truth = b.t_world_anchor.inverse() * a.t_world_anchor;
        println!("{:?}", refine(&a.described.keypoints, &b.described.features, &truth, &RefineConfig::default()).map(|r| (r.pose.covariance.sigmas().transpose(), r.pose.pose.local(&truth).transpose())));
    }}
}
