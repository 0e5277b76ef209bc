//! Three planar robots on a real laser log (Radish `aces`), through the importer and the cores on perfect wires: they
//! merge, nothing false is used, and the merged map explains the relations that people checked by hand.

use merganser::demo::views::{pose, relation};
use merganser::recording::Recording;
use merganser::recording::import::prepare;
use merganser_protocol::geometry::{Se3, So3};
use merganser_protocol::snapshot::{EdgeView, Snapshot};
use merganser_protocol::submap::SubmapBuilder;
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
    /// Drives the recording once more: where each keyframe is in its submap is a function of the keyframes alone.
    fn of(recording: &Recording, anchors: &BTreeMap<u32, Se3>) -> Self {
        let mut builder = SubmapBuilder::new(recording.manifest().config.submap.clone());
        let mut way = Self { stamps: Vec::new(), raw: Vec::new(), mapped: Vec::new() };
        for index in 0..recording.len() {
            let keyframe = recording.keyframe(index).unwrap();
            way.stamps.push(keyframe.stamp.0);
            way.raw.push(keyframe.pose.pose);
            let closed = builder.push(keyframe).unwrap();
            let closed = closed.or_else(|| (index + 1 == recording.len()).then(|| builder.flush()).flatten());
            if let Some(submap) = closed {
                let anchor = anchors.get(&submap.index);
                way.mapped.extend(submap.keyframes.iter().map(|t_anchor_body| Some(*anchor? * *t_anchor_body)));
            }
        }
        assert_eq!(way.mapped.len(), way.raw.len());
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
    let robot = |r: &Recording| r.manifest().robot.as_str().to_owned();
    let ways: Vec<Way> =
        recordings.iter().map(|r| Way::of(r, anchors.get(&robot(r)).unwrap_or(&BTreeMap::new()))).collect();

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
