//! Three planar robots on a real laser log (Radish `aces`), through the importer and the cores on perfect wires: they
//! merge, nothing false is used, and the merged map explains the relations that people checked by hand.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use merganser::demo::views::{pose, relation};
use merganser::recording::Recording;
use merganser::recording::import::prepare;
use merganser_protocol::geometry::{Relative, Se3, So3};
use merganser_protocol::snapshot::{EdgeView, MapView, PathView, Snapshot, bodies};
use merganser_tests::real_data;
use merganser_tests::wires::play;
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// Relations of two robots are off by so much at most, m and °. They are themselves not exact: a tenth of those over
/// which one robot's own way closes are 0.10 m or 1.8° off from the map that fits them best, the worst 0.25 m and 3.5°.
const WORST: (f64, f64) = (0.5, 6.0);
/// Half of them by so much.
const MEDIAN: (f64, f64) = (0.10, 1.5);
/// An agreed alignment is false if it is farther off than this, m and °.
const FALSE: (f64, f64) = (1.0, 8.0);
/// A robot that turns by more than this (rad) from one keyframe to the next turns.
const TURN_MAX: f64 = 0.05;
/// One that takes longer than this to the next keyframe rests on the way, nobody knows where.
const PAUSE_MAX_NANOS: i64 = 2_000_000_000;
/// Clouds are thinned to a point in squares of this size, m...
const CELL_M: f64 = 0.1;
/// ...points of two robots agree as those of one, but for so much: they did not see all the same things...
const AGREE: f64 = 1.5;
/// ...and points of two robots are of one thing if no farther apart, and seen from one place if the bodies were no
/// farther apart, m.
const SAME_M: f64 = 1.0;
/// Relations over more than this time are loops, s.
const LOOP_SECS: f64 = 20.0;

/// One robot's body in the merged map.
struct Way {
    stamps: Vec<i64>,
    /// `t_odometry_body` as recorded...
    raw: Vec<Se3>,
    /// ...and `t_map_body`.
    mapped: Vec<Option<Se3>>,
}

impl Way {
    /// A robot's own path on the map of another.
    fn of(recording: &Recording, path: &PathView, map: &MapView) -> Self {
        let way = Self {
            stamps: recording.keyframes().iter().map(|line| line.stamp.0).collect(),
            raw: recording.keyframes().iter().map(|line| line.pose.pose).collect(),
            mapped: bodies(path, map).iter().map(|body| body.map(|body| body.to_se3())).collect(),
        };
        assert_eq!((way.mapped.len(), path.forgotten), (way.raw.len(), 0));
        let odom: Vec<Se3> = path.keyframes.iter().map(|keyframe| pose(&keyframe.t_odom_body).unwrap()).collect();
        assert!(odom.iter().zip(&way.raw).all(|(a, b)| a.local(b).norm() < 1e-9));
        way
    }

    /// `t_map_body` at a time, by the odometry since the last keyframe; not while the robot turns or rests: wheels and
    /// clocks are not good enough then.
    fn at(&self, stamp: i64) -> Option<Se3> {
        let next = self.stamps.partition_point(|&s| s <= stamp);
        let k = next.checked_sub(1).filter(|_| next < self.stamps.len())?;
        let turn = (self.raw[k].inverse() * self.raw[next]).rotation.angle();
        if turn > TURN_MAX || self.stamps[next] - self.stamps[k] > PAUSE_MAX_NANOS {
            return None;
        }
        let share = (stamp - self.stamps[k]) as f64 / (self.stamps[next] - self.stamps[k]) as f64;
        let raw = self.raw[k].interpolate(&self.raw[next], share);
        Some(self.mapped[k]? * (self.raw[k].inverse() * raw))
    }
}

fn off(a: &Se3, b: &Se3) -> (f64, f64) {
    let between = a.inverse() * *b;
    (between.translation.xy().norm(), between.rotation.angle().to_degrees())
}

/// An anchor is where the middle keyframe of its submap is.
fn passes_through(way: &Way, path: &PathView, anchors: &BTreeMap<u32, Se3>) {
    for (index, anchor) in anchors {
        let within = || (0..path.keyframes.len()).filter(|&k| path.keyframes[k].submap == *index);
        let away = |at: Se3| anchor.local(&at).norm();
        let nearest = within().map(|k| away(way.mapped[k].unwrap())).fold(f64::INFINITY, f64::min);
        assert!(nearest < 1e-6, "the path passes {nearest} from anchor {index}");
    }
}

/// `t_map_odom` maps what the SLAM says to where the robot is, as surely as that is known; and it moves while odometry
/// drifts.
fn is_tied(way: &Way, own: &Snapshot) {
    let live = own.poses.robots.first().unwrap();
    assert_eq!(live.robot, own.status.robot);
    assert!(own.poses.robots[1..].iter().all(|other| other.t_map_odom.is_none()));
    let t_map_odom = live.t_map_odom.as_ref().and_then(relation).unwrap();
    let t_own_body = live.t_own_body.as_ref().and_then(relation).unwrap();
    let back = Relative::Metric(t_map_odom).onto(way.raw.last().unwrap());
    let back = back.metric().unwrap();
    assert!(back.pose.local(&t_own_body.pose).norm() < 1e-6);
    let covariance = t_own_body.covariance.matrix();
    assert!((back.covariance.matrix() - covariance).amax() < 1e-5 * covariance.amax());
    let first = bodies(&own.path, &own.map)[0].unwrap().to_se3() * way.raw[0].inverse();
    let (metres, degrees) = off(&first, &t_map_odom.pose);
    println!("{}: map to odom moved by {metres:.2} m, {degrees:.1}°", live.robot);
    assert!(metres > 0.5 || degrees > 3.0, "wheels drift");
}

/// A point in each square of [`CELL_M`] that these keyframes saw.
fn cloud(recording: &Recording, poses: &[Option<Se3>], keyframes: impl Iterator<Item = usize>) -> Vec<[f64; 2]> {
    let mut taken: BTreeMap<[i64; 2], [f64; 2]> = BTreeMap::new();
    for k in keyframes {
        for point in recording.points(k).unwrap() {
            let p = poses[k].unwrap() * Vector3::from(point.map(f64::from));
            taken.entry([p.x, p.y].map(|x| (x / CELL_M).floor() as i64)).or_insert([p.x, p.y]);
        }
    }
    taken.into_values().collect()
}

/// Two robots' points agree, of what the second saw from where the first was, too, about as well as those of every other keyframe of one robot. Where
/// raw odometry hangs from the first anchors, they do not.
fn clouds_agree(recordings: [&Recording; 2], ways: [&Way; 2]) {
    let raw = |way: &Way| -> Vec<Option<Se3>> {
        let t_map_odom = way.mapped[0].unwrap() * way.raw[0].inverse();
        way.raw.iter().map(|t_odom_body| Some(t_map_odom * *t_odom_body)).collect()
    };
    let at = |r: usize, k: usize| ways[r].mapped[k].unwrap().translation;
    let is_shared = |k: &usize| (0..ways[0].mapped.len()).any(|of| (at(0, of) - at(1, *k)).norm() < SAME_M);
    let shared: Vec<usize> = (0..ways[1].mapped.len()).filter(is_shared).collect();
    let of_two = |poses: [&[Option<Se3>]; 2]| {
        let whole = cloud(recordings[0], poses[0], 0..poses[0].len());
        mean_nearest(&[whole, cloud(recordings[1], poses[1], shared.iter().copied())])
    };
    let half = |from: usize| cloud(recordings[0], &ways[0].mapped, (from..ways[0].mapped.len()).step_by(2));
    let merged = of_two([&ways[0].mapped, &ways[1].mapped]);
    let odometry = of_two([&raw(ways[0]), &raw(ways[1])]);
    let alone = mean_nearest(&[0, 1].map(half));
    println!("nearest points: {merged:.3} m of two robots, {alone:.3} m of one, {odometry:.3} m by odometry");
    assert!(merged < AGREE * alone && odometry > 2.0 * merged, "{merged} m, {alone} m alone, {odometry} m by odometry");
}

/// Of the second cloud's points to the nearest of the first; farther than [`SAME_M`] it is something else.
fn mean_nearest([a, b]: &[Vec<[f64; 2]>; 2]) -> f64 {
    let tree = ImmutableKdTree::<f64, 2>::new_from_slice(a).unwrap();
    let distance = |p| tree.query(p).nearest_one::<SquaredEuclidean<f64>>().execute().distance.sqrt();
    let near: Vec<f64> = b.iter().map(distance).filter(|distance| *distance < SAME_M).collect();
    near.iter().sum::<f64>() / near.len() as f64
}

#[test]
fn two_robots_merge_on_a_real_planar_laser() {
    robots_merge(2);
}

#[test]
#[ignore = "night: the log in full"]
fn three_robots_merge_on_a_real_planar_laser() {
    robots_merge(3);
}

/// The first of the three robots alone, if fewer are asked for.
fn robots_merge(robots: usize) {
    let Some(data) = real_data("lidar2d_radish") else { return };
    let out = tempfile::tempdir().unwrap();
    let mut recordings = prepare(&data, out.path(), 1).unwrap().recordings;
    recordings.truncate(robots);
    let wires = play(&recordings, 1).unwrap();
    let Snapshot { status, frames, map, graph, stats, .. } = wires.agents[0].snapshot(wires.now);
    for pair in &frames.pairs {
        println!("{} {}: {:?}, {} agreed, {} used", pair.a, pair.b, pair.status, pair.agreed, pair.used);
    }
    println!("work {:?}, sent {:?}", stats.work, stats.sent_bytes);

    let mut anchors: BTreeMap<String, BTreeMap<u32, Se3>> = BTreeMap::new();
    for submap in &map.submaps {
        let known = submap.t_own_anchor.as_ref().and_then(relation);
        known.map(|t| anchors.entry(submap.robot.clone()).or_default().insert(submap.index, t.pose));
    }
    let own: Vec<Snapshot> = wires.agents.iter().map(|agent| agent.snapshot(wires.now)).collect();
    let ways: Vec<Way> = recordings.iter().zip(&own).map(|(r, own)| Way::of(r, &own.path, &map)).collect();
    for ((recording, way), own) in recordings.iter().zip(&ways).zip(&own) {
        let anchors = anchors.get(recording.manifest().robot.as_str()).unwrap();
        passes_through(way, &own.path, anchors);
        is_tied(way, own);
    }
    clouds_agree([&recordings[0], &recordings[1]], [&ways[0], &ways[1]]);

    let at = |name: &str| -> Option<Se3> {
        let (frame, index) = name.rsplit_once('#')?;
        anchors.get(frame.split('/').next()?)?.get(&index.parse().ok()?).copied()
    };
    let wrong = |edge: &&EdgeView| {
        let (Some(i), Some(j), Some(t)) = (at(&edge.i), at(&edge.j), pose(&edge.t_i_j.pose)) else { return true };
        let (distance, angle) = off(&t, &(i.inverse() * j));
        distance > FALSE.0 || angle > FALSE.1
    };
    let alignments = || graph.edges.iter().filter(|edge| edge.kind == "alignment");
    for edge in alignments().filter(wrong) {
        println!("FALSE {} {} agreed {} weight {} {}", edge.i, edge.j, edge.agreed, edge.weight, edge.reason);
    }
    println!(
        "{} alignments, {} agreed, {} used",
        alignments().count(),
        alignments().filter(|e| e.agreed).count(),
        alignments().filter(|e| e.weight > 0.0).count()
    );

    let (mut all, mut loops) = (Vec::new(), 0);
    for line in std::fs::read_to_string(data.join("aces.relations")).unwrap().lines() {
        let v: Vec<f64> = line.split_ascii_whitespace().map(|word| word.parse().unwrap()).collect();
        let [t1, t2, x, y, _, _, _, yaw] = *v.as_slice() else { panic!("{line}") };
        let stamp = |t: f64| (t * 1e6).round() as i64 * 1000;
        let truth = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, yaw)), Vector3::new(x, y, 0.0));
        for (a, b) in (0..ways.len()).flat_map(|a| (0..ways.len()).map(move |b| (a, b))).filter(|(a, b)| a != b) {
            if let (Some(from), Some(to)) = (ways[a].at(stamp(t1)), ways[b].at(stamp(t2))) {
                let (distance, angle) = off(&truth, &(from.inverse() * to));
                if distance > WORST.0 || angle > WORST.1 {
                    println!("relation {t1} {t2} of {a} and {b}: {distance:.2} m, {angle:.1} deg off");
                }
                loops += usize::from(t2 - t1 > LOOP_SECS);
                all.push((distance, angle));
            }
        }
    }
    let sorted = |pick: fn(&(f64, f64)) -> f64| {
        let mut values: Vec<f64> = all.iter().map(pick).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let (distances, angles) = (sorted(|x| x.0), sorted(|x| x.1));
    assert!(!all.is_empty(), "no relation ties two merged robots");
    let middle = all.len() / 2;
    let (last, tenth) = (all.len() - 1, all.len() * 9 / 10);
    println!(
        "{} relations between robots, {loops} of them loops: median {:.3} m {:.2} deg, 90 % {:.3} m {:.2} deg, worst {:.3} m {:.2} deg",
        all.len(),
        distances[middle],
        angles[middle],
        distances[tenth],
        angles[tenth],
        distances[last],
        angles[last]
    );
    assert_eq!(status.merged_with.len(), robots - 1, "merged with {:?}", status.merged_with);
    assert!(!alignments().filter(|edge| edge.weight > 0.0).any(|edge| wrong(&edge)), "a false alignment is used");
    assert!(distances[middle] <= MEDIAN.0 && angles[middle] <= MEDIAN.1);
    assert!(distances[last] <= WORST.0 && angles[last] <= WORST.1);
    assert!(all.len() >= 50 && (robots < 3 || loops >= 5), "{} relations, {loops} loops between robots", all.len());
}
