//! Five planar robots among bar codes (MRCLAM), through the importer and the cores on perfect wires: the five end in
//! one frame, no false alignment is used, and the landmarks of the joint map lie where the survey says.

use merganser::demo::trajectory::fit;
use merganser::demo::views::{pose, relation};
use merganser::recording::Recording;
use merganser::recording::import::prepare;
use merganser_protocol::geometry::Se3;
use merganser_protocol::snapshot::{EdgeView, Snapshot};
use merganser_protocol::submap::{Submap, SubmapBuilder};
use merganser_sim::bench::logs::mrclam::{Survey, placed, survey};
use merganser_tests::real_data;
use merganser_tests::wires::play;
use nalgebra::{Matrix3, Vector3};
use std::collections::BTreeMap;

/// Root mean square distance of the landmarks from the survey, at most, m.
const RMS_MAX: f64 = 0.15;
/// An alignment is false if it is farther off than this, m and °, from what the survey says of its two submaps, which
/// is itself known to some centimetres and degrees.
const FALSE: (f64, f64) = (0.5, 10.0);
/// The list of bar codes and the survey disagree about two landmarks, whose names are exchanged in one of them: as
/// printed, all five robots see each of the two where the other one is, 2.9 m away.
const EXCHANGED: [u32; 2] = [18, 61];

/// Where the survey has each bar code, with the two names exchanged.
fn exchanged(printed: &Survey) -> Survey {
    let name = |code: u32| match EXCHANGED {
        [a, b] if code == a => b,
        [a, b] if code == b => a,
        _ => code,
    };
    printed.iter().map(|(code, place)| (name(*code), *place)).collect()
}

/// The submaps of a recording: a function of its keyframes alone.
fn submaps(recording: &Recording) -> Vec<Submap> {
    let mut builder = SubmapBuilder::new(recording.manifest().config.submap.clone());
    let closed = (0..recording.len()).filter_map(|k| builder.push(recording.keyframe(k).unwrap()).unwrap());
    let mut all: Vec<Submap> = closed.collect();
    all.extend(builder.flush());
    all
}

/// A fit of points in a plane may turn it over.
fn upright(t: &Se3) -> Se3 {
    let z = t.rotation.matrix()[(2, 2)];
    assert!(z > 0.99, "the fit turned the plane over");
    *t
}

fn off(a: &Se3, b: &Se3) -> (f64, f64) {
    let between = a.inverse() * *b;
    (between.translation.xy().norm(), between.rotation.angle().to_degrees())
}

/// Distances of the landmarks of a map from the survey, after the rigid motion that fits best.
fn errors(map: &BTreeMap<u32, Vector3<f64>>, survey: &Survey) -> Vec<(u32, f64)> {
    let (seen, there): (Vec<_>, Vec<_>) =
        map.iter().filter_map(|(code, p)| Some((*p, survey.get(code)?.push(0.0)))).unzip();
    let t = upright(&fit(&seen, &there));
    let codes = map.keys().filter(|code| survey.contains_key(code));
    codes.zip(seen.iter().zip(&there)).map(|(code, (p, q))| (*code, (t * *p - q).norm())).collect()
}

fn rms(errors: &[(u32, f64)]) -> f64 {
    (errors.iter().map(|(_, e)| e * e).sum::<f64>() / errors.len().max(1) as f64).sqrt()
}

#[test]
fn two_robots_agree_with_the_survey() {
    agree_with_the_survey(3..5, 20);
}

#[test]
#[ignore = "night: the log in full"]
fn five_robots_agree_with_the_survey() {
    agree_with_the_survey(0..5, 100);
}

/// These of the five robots alone; they state so many sightings of one another at least.
fn agree_with_the_survey(robots: core::ops::Range<usize>, positions_min: usize) {
    let Some(data) = real_data("mrclam_dataset1") else { return };
    let out = tempfile::tempdir().unwrap();
    let recordings: Vec<Recording> = prepare(&data, out.path(), 1).unwrap().recordings.drain(robots).collect();
    let printed = survey(&data).unwrap();
    let survey = [printed.clone(), exchanged(&printed)];
    let names: Vec<&str> = recordings.iter().map(|r| r.manifest().robot.as_str()).collect();
    let all: Vec<Vec<Submap>> = recordings.iter().map(submaps).collect();
    for ((recording, submaps), name) in recordings.iter().zip(&all).zip(&names) {
        let counts: Vec<usize> = submaps.iter().map(|s| s.constellation.landmarks.len()).collect();
        let placed = submaps.iter().filter(|s| placed(s, &survey[1]).is_some()).count();
        println!(
            "{name}: {} keyframes, {} submaps, {placed} placed, landmarks {counts:?}",
            recording.len(),
            submaps.len()
        );
    }
    let wires = play(&recordings, 1).unwrap();
    let Snapshot { status, frames, map, graph, stats, .. } = wires.agents[0].snapshot(wires.now);
    for pair in &frames.pairs {
        println!("{} {}: {:?}, {} agreed, {} used", pair.a, pair.b, pair.status, pair.agreed, pair.used);
    }
    println!("work {:?}, sent {:?}", stats.work, stats.sent_bytes);

    let robot_of = |name: &str| names.iter().position(|n| *n == name);
    let truth = |name: &str| -> Option<Se3> {
        let (frame, index) = name.rsplit_once('#')?;
        let submaps = &all[robot_of(frame.split('/').next()?)?];
        placed(submaps.get(index.parse::<usize>().ok()?)?, &survey[1])
    };
    let error = |edge: &EdgeView| {
        let (i, j) = (truth(&edge.i)?, truth(&edge.j)?);
        Some(off(&pose(&edge.t_i_j.pose)?, &(i.inverse() * j)))
    };
    let wrong = |edge: &EdgeView| error(edge).is_some_and(|(distance, angle)| distance > FALSE.0 || angle > FALSE.1);
    let alignments = || graph.edges.iter().filter(|edge| edge.kind == "alignment");
    let mut uses: BTreeMap<&str, usize> = BTreeMap::new();
    alignments().flat_map(|edge| [&edge.i, &edge.j]).for_each(|id| *uses.entry(id.as_str()).or_default() += 1);
    println!("alignments of one submap: {:?}", uses.values().collect::<Vec<_>>());
    for edge in alignments().filter(|edge| wrong(edge)) {
        let (i, j, e) = (&edge.i, &edge.j, error(edge));
        println!("FALSE {i} {j} {e:?} agreed {} weight {} {}", edge.agreed, edge.weight, edge.reason);
    }
    let count = |which: &dyn Fn(&&EdgeView) -> bool| alignments().filter(which).count();
    println!(
        "{} alignments, {} agreed, {} used; {} judged by the survey, {} of them false, {} false and used",
        count(&|_| true),
        count(&|e| e.agreed),
        count(&|e| e.weight > 0.0),
        count(&|e| error(e).is_some()),
        count(&|e| wrong(e)),
        count(&|e| wrong(e) && e.weight > 0.0)
    );

    let positions: Vec<&EdgeView> = graph.edges.iter().filter(|edge| edge.kind == "position").collect();
    let given: usize = recordings.iter().map(|recording| recording.positions().len()).sum();
    let off: Vec<f64> = positions
        .iter()
        .filter_map(|edge| {
            let t_i_j = relation(&edge.t_i_j)?;
            Some(
                t_i_j.covariance.mahalanobis_squared(&t_i_j.pose.local(&(truth(&edge.i)?.inverse() * truth(&edge.j)?))),
            )
        })
        .collect();
    let used = positions.iter().filter(|edge| edge.weight > 0.0).count();
    println!(
        "{given} sightings of robots, {} stated, {used} used; NEES of {} by the survey {:.2} of 3",
        positions.len(),
        off.len(),
        off.iter().sum::<f64>() / off.len() as f64
    );
    for edge in positions.iter().filter(|edge| edge.weight == 0.0) {
        println!("  {} {}: {}", edge.i, edge.j, edge.reason);
    }

    // Every landmark in the joint frame: what all submaps say of it, by their certainty.
    let mut sums: BTreeMap<u32, (Matrix3<f64>, Vector3<f64>)> = BTreeMap::new();
    let mut joined = 0;
    for view in &map.submaps {
        let Some(anchor) = view.t_own_anchor.as_ref().and_then(relation) else { continue };
        let Some(submap) = robot_of(&view.robot).and_then(|robot| all[robot].get(view.index as usize)) else {
            continue;
        };
        joined += 1;
        for landmark in &submap.constellation.landmarks {
            let Some(label) = landmark.mark.label else { continue };
            let turn = anchor.pose.rotation.matrix();
            let around = landmark.at.norm() * anchor.covariance.sigmas()[5];
            let spread = (around * around) * Matrix3::identity();
            let covariance = turn * landmark.mark.covariance.matrix() * turn.transpose()
                + spread
                + anchor.covariance.matrix().fixed_view::<3, 3>(0, 0);
            let information = covariance.try_inverse().unwrap();
            let sum = sums.entry(label).or_insert((Matrix3::zeros(), Vector3::zeros()));
            sum.0 += information;
            let mut at = anchor.pose * landmark.at;
            at.z = 0.0;
            sum.1 += information * at;
        }
    }
    let flat = |p: Vector3<f64>| Vector3::new(p.x, p.y, 0.0);
    let joint: BTreeMap<u32, Vector3<f64>> =
        sums.iter().filter_map(|(code, (h, g))| Some((*code, flat(h.try_inverse()? * g)))).collect();
    let (printed, exchanged) = (errors(&joint, &survey[0]), errors(&joint, &survey[1]));
    println!("{joined} of {} submaps in the joint frame, {} landmarks", map.submaps.len(), joint.len());
    println!("survey, with two names exchanged: RMS {:.3} m, {exchanged:.3?}", rms(&exchanged));
    println!("survey, as printed: RMS {:.3} m", rms(&printed));
    println!("merged with {:?}", status.merged_with);
    assert_eq!(status.merged_with.len(), names.len() - 1, "the robots are not in one frame");
    assert_eq!((joined, exchanged.len()), (map.submaps.len(), 15));
    assert!(!alignments().any(|edge| edge.weight > 0.0 && wrong(edge)), "a false alignment is used");
    assert!(
        positions.len() >= positions_min && used * 20 >= positions.len() * 19,
        "what robots saw of one another does not fit"
    );
    assert!(off.iter().sum::<f64>() < 3.0 * off.len() as f64, "sightings are off by more than they say");
    assert!(rms(&exchanged) <= RMS_MAX, "{:.3} m", rms(&exchanged));
    assert!(rms(&printed) > 0.5, "as printed two landmarks cannot fit");
}
