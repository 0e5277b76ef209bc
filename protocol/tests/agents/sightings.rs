//! What one robot sees of another is carried to anchors with an uncertainty that it can stand by, though both moved on
//! since the last keyframe and the last beacon.

use super::common::{Wires, World, agent, drive, name, robot};
use merganser_protocol::agent::io::{Channel, Input, PositionSighting, Record, Sighting};
use merganser_protocol::agent::{Restored, SIGHTING_AGE_SECS_MAX, TURN_SIGMA_MAX};
use merganser_protocol::geometry::{Covariance, Se3};
use merganser_protocol::ids::SubmapId;
use merganser_protocol::snapshot::Snapshot;
use merganser_protocol::submap::Keyframe;
use merganser_protocol::time::{Instant, Stamp};
use merganser_protocol::wire::Entry;
use merganser_protocol::wire::fact::{Fact, PositionFact};
use nalgebra::{SMatrix, Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::time::Duration;

const KEYFRAMES: usize = 40;
const SIGMAS: [f64; 6] = [0.05, 0.05, 0.05, 0.02, 0.02, 0.02];

/// Two robots that drive, and where they truly are.
struct Drive {
    wires: Wires,
    keyframes: [Vec<Keyframe>; 2],
    truth: [Vec<Se3>; 2],
}

/// The drive until half of it, and the same way back: a robot that stops and turns where none can foresee it.
fn turned_back(keyframes: &[Keyframe], truth: &[Se3]) -> (Vec<Keyframe>, Vec<Se3>) {
    let there = |n: usize| if n <= KEYFRAMES / 2 { n } else { KEYFRAMES - n };
    let at = |n: usize| Keyframe { stamp: keyframes[n].stamp, ..keyframes[there(n)].clone() };
    ((0..KEYFRAMES).map(at).collect(), (0..KEYFRAMES).map(|n| truth[there(n)]).collect())
}

impl Drive {
    fn new() -> Self {
        let world = World::new(5);
        let [(a, true_a), (b, true_b)] = [0, 1].map(|k| drive(&world, k, KEYFRAMES));
        let (b, true_b) = turned_back(&b, &true_b);
        let wires = Wires::new((0..2).map(|k| agent(k, Restored::default())).collect());
        Self { wires, keyframes: [a, b], truth: [true_a, true_b] }
    }

    /// Keyframe `n` of both, one after the other, and a second passes.
    fn second(&mut self, n: usize, mut meanwhile: impl FnMut(&mut Self, f64)) {
        for k in [0, 1] {
            self.wires.input(k, Input::Keyframe(self.keyframes[k][n].clone()));
        }
        for tenth in 1..=10 {
            self.wires.run(Duration::from_millis(100));
            meanwhile(self, n as f64 + 0.1 * f64::from(tenth));
        }
    }

    /// Where robot `k` is at a moment: between two keyframes it moves evenly.
    fn at(&self, k: usize, secs: f64) -> Se3 {
        let n = (secs.floor() as usize).min(KEYFRAMES - 2);
        let (from, to) = (self.truth[k][n], self.truth[k][n + 1]);
        from * Se3::exp(&((from.inverse() * to).log() * (secs - n as f64)))
    }

    /// The true pose of an anchor, which was a keyframe.
    fn anchor(&self, snapshot: &Snapshot, named: &str) -> Se3 {
        let view = snapshot.map.submaps.iter().find(|s| format!("{}#{}", s.frame, s.index) == named).unwrap();
        let k = usize::from(view.robot == "beta");
        let place = Vector3::from(view.t_frame_anchor.translation);
        let off = |n: &usize| (self.keyframes[k][*n].pose.pose.translation - place).norm();
        let n = (0..KEYFRAMES).min_by(|a, b| off(a).total_cmp(&off(b))).unwrap();
        assert!(off(&n) < 1e-3);
        self.truth[k][n]
    }

    /// Alpha sees beta with the noise it states.
    fn sees(&mut self, secs: f64, rng: &mut ChaCha8Rng) {
        self.sees_as_sure(secs, rng, SIGMAS);
    }

    fn sees_as_sure(&mut self, secs: f64, rng: &mut ChaCha8Rng, sigmas: [f64; 6]) {
        let noise = Vector6::from(sigmas.map(|s| s * normal(rng)));
        let t = (self.at(0, secs).inverse() * self.at(1, secs)).retract(&noise);
        let [x, y, z, w] = t.rotation.xyzw();
        let matrix = *Covariance::from_sigmas(sigmas).unwrap().matrix();
        let mut upper = (0..6).flat_map(|r| (r..6).map(move |c| (r, c)));
        let sighting = Sighting {
            stamp: Stamp((secs * 1e9) as i64),
            robot: name(1),
            t_body_other: [t.translation.x, t.translation.y, t.translation.z, x, y, z, w],
            covariance: core::array::from_fn(|_| matrix[upper.next().unwrap()]),
        };
        self.wires.input(0, Input::Sighting(sighting));
    }

    /// Alpha sees where beta is, not how it is turned.
    fn sees_place(&mut self, secs: f64, rng: &mut ChaCha8Rng) {
        let noise = Vector3::from_fn(|k, _| SIGMAS[k] * normal(rng));
        let p = self.at(0, secs).inverse() * self.at(1, secs).translation + noise;
        let [xx, yy, zz] = [0, 1, 2].map(|k| SIGMAS[k] * SIGMAS[k]);
        self.wires.input(
            0,
            Input::Position(PositionSighting {
                stamp: Stamp((secs * 1e9) as i64),
                robot: name(1),
                position: p.into(),
                covariance: [xx, 0.0, 0.0, yy, 0.0, zz],
            }),
        );
    }

    /// Positions that alpha stated.
    fn positions(&self) -> Vec<PositionFact> {
        let fact = |record: &Record| match record {
            Record::Entry { bytes, .. } => match Entry::decode(bytes).unwrap().fact().unwrap() {
                Fact::Position(fact) => Some(fact),
                _ => None,
            },
            _ => None,
        };
        self.wires.disks[0].iter().filter_map(fact).collect()
    }

    fn refused(&self) -> u64 {
        let rejected = self.snapshot().stats.rejected;
        ["sighting", "position"].iter().filter_map(|kind| rejected.get(*kind)).sum()
    }

    fn snapshot(&self) -> Snapshot {
        self.wires.agents[0].snapshot(self.wires.now)
    }
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0
}

#[test]
fn a_sighting_is_as_uncertain_as_what_moved_since() {
    let mut drive = Drive::new();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for n in 0..KEYFRAMES - 1 {
        drive.second(n, |drive, secs| {
            // At every phase between keyframes.
            if n > 12 && ((secs * 10.0).round() as usize).is_multiple_of(7) {
                drive.sees(secs, &mut rng);
            }
        });
    }
    drive.wires.run(Duration::from_secs(3));
    let snapshot = drive.snapshot();
    let seen: Vec<_> = snapshot.graph.edges.iter().filter(|edge| edge.kind == "sighting").collect();
    assert!(seen.len() > 30, "{} of {} sightings", seen.len(), drive.refused());
    let (mut nees, mut naive) = (0.0, 0.0);
    for edge in &seen {
        let truth = drive.anchor(&snapshot, &edge.i).inverse() * drive.anchor(&snapshot, &edge.j);
        let [x, y, z, w] = edge.t_i_j.pose.rotation;
        let rotation = merganser_protocol::geometry::So3::from_xyzw([x, y, z, w]).unwrap();
        let error = Se3::new(rotation, edge.t_i_j.pose.translation.into()).local(&truth);
        let mut upper = edge.t_i_j.covariance.iter();
        let mut covariance = SMatrix::<f64, 6, 6>::zeros();
        for r in 0..6 {
            for c in r..6 {
                let v = *upper.next().unwrap();
                (covariance[(r, c)], covariance[(c, r)]) = (v, v);
            }
        }
        nees += Covariance::new(covariance).unwrap().mahalanobis_squared(&error) / seen.len() as f64;
        // As if nobody had moved.
        naive += Covariance::from_sigmas(SIGMAS).unwrap().mahalanobis_squared(&error) / seen.len() as f64;
    }
    println!("{} sightings, NEES {nees:.2} of 6; of the measurement alone {naive:.0}", seen.len());
    assert!(nees < 7.0, "NEES {nees}");
    assert!(naive > 12.0, "nothing moved: {naive}");
}

#[test]
fn a_sighting_far_in_time_from_what_is_known_of_either_robot_is_refused() {
    let mut drive = Drive::new();
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    for n in 0..20 {
        drive.second(n, |_, _| {});
    }
    let last = 19.0;
    drive.sees(last + SIGHTING_AGE_SECS_MAX - 0.1, &mut rng);
    assert_eq!(drive.refused(), 0);
    drive.sees(last + SIGHTING_AGE_SECS_MAX + 0.1, &mut rng);
    drive.sees(last - SIGHTING_AGE_SECS_MAX - 0.1, &mut rng);
    assert_eq!(drive.refused(), 2);
    // Alpha drives on, and nothing is heard of beta.
    let silent = drive.wires.now;
    drive.wires.agents.truncate(1);
    drive.wires.run(Duration::from_secs_f64(SIGHTING_AGE_SECS_MAX + 1.0));
    assert!(drive.wires.now > silent && drive.wires.now > Instant::ZERO);
    drive.sees(last, &mut rng);
    assert_eq!(drive.refused(), 3);
}

/// Of one pair of submaps the first position is stated, and what is surer by half.
#[test]
fn a_position_is_as_uncertain_as_what_moved_since_and_is_stated_where_it_is_news() {
    let mut drive = Drive::new();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut given = 0;
    for n in 0..KEYFRAMES - 1 {
        drive.second(n, |drive, secs| {
            if n > 8 {
                drive.sees_place(secs, &mut rng);
                given += 1;
            }
        });
    }
    drive.wires.run(Duration::from_secs(3));
    let snapshot = drive.snapshot();
    let facts = drive.positions();
    let named = |id: SubmapId| {
        let k = (0..2).find(|k| robot(*k) == id.frame.robot).unwrap();
        format!("{}/{}#{}", name(k), id.frame.epoch, id.index)
    };
    let mut nees = 0.0;
    for fact in &facts {
        let t_i_j = drive.anchor(&snapshot, &named(fact.i)).inverse() * drive.anchor(&snapshot, &named(fact.j));
        let [p_i, p_j] = [fact.p_i, fact.p_j].map(|p| Vector3::from(p.map(f64::from)));
        nees += fact.covariance.mahalanobis_squared(&(p_i - t_i_j * p_j)) / facts.len() as f64;
    }
    println!("{} positions of {given} stated, NEES {nees:.2} of 3", facts.len());
    assert_eq!(drive.refused(), 0);
    assert!(facts.len() > 8 && facts.len() < given / 10, "{} of {given}", facts.len());
    assert!((0.3..4.0).contains(&nees), "NEES {nees}");
    let mut least: BTreeMap<(SubmapId, SubmapId), f64> = BTreeMap::new();
    for fact in &facts {
        let variance = fact.covariance.matrix().trace();
        let before = least.insert((fact.i, fact.j), variance).unwrap_or(f64::INFINITY);
        assert!(variance <= 0.5 * before, "{variance} after {before}");
    }
    // They count in a map that alignments have merged, and nowhere else.
    let edges: Vec<_> = snapshot.graph.edges.iter().filter(|edge| edge.kind == "position").collect();
    assert_eq!(edges.len(), facts.len());
    let used = edges.iter().filter(|edge| edge.weight > 0.0).count();
    println!("{used} used, {:?}", snapshot.status.merged_with);
    assert!(used * 10 >= 9 * edges.len() && !snapshot.status.merged_with.is_empty());
}

#[test]
fn a_sighting_that_does_not_know_how_the_other_is_turned_tells_its_place() {
    let mut drive = Drive::new();
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    for n in 0..20 {
        drive.second(n, |_, _| {});
    }
    let sure = |turn: f64| [0.05, 0.05, 0.05, 0.02, 0.02, turn];
    drive.sees_as_sure(19.5, &mut rng, sure(0.99 * TURN_SIGMA_MAX));
    assert!(drive.positions().is_empty());
    drive.sees_as_sure(19.5, &mut rng, sure(1.01 * TURN_SIGMA_MAX));
    drive.sees_as_sure(19.5, &mut rng, sure(100.0));
    drive.wires.run(Duration::from_secs(1));
    assert_eq!((drive.positions().len(), drive.refused()), (1, 0));
}

#[test]
fn a_position_that_is_none_is_refused() {
    let mut drive = Drive::new();
    for n in 0..20 {
        drive.second(n, |_, _| {});
    }
    let good = PositionSighting {
        stamp: Stamp(19_500_000_000),
        robot: name(1),
        position: [1.0, 2.0, 0.0],
        covariance: [0.01, 0.0, 0.0, 0.01, 0.0, 0.01],
    };
    let spoiled = [
        PositionSighting { position: [f64::NAN, 0.0, 0.0], ..good.clone() },
        PositionSighting { covariance: [0.0; 6], ..good.clone() },
        PositionSighting { covariance: [0.01, 0.02, 0.0, 0.01, 0.0, 0.01], ..good.clone() },
        PositionSighting { robot: name(0), ..good.clone() },
        PositionSighting { stamp: Stamp(9_500_000_000), ..good.clone() },
        PositionSighting { position: [1e300, 0.0, 0.0], ..good.clone() },
    ];
    for (count, bad) in (1..).zip(spoiled) {
        drive.wires.input(0, Input::Position(bad));
        let own = drive.snapshot().stats.rejected;
        assert_eq!(
            own.iter()
                .filter(|(kind, _)| kind.contains("position") || kind.contains("own fact"))
                .map(|(_, n)| n)
                .sum::<u64>(),
            count,
            "{own:?}"
        );
    }
    drive.wires.input(0, Input::Position(good));
    drive.wires.run(Duration::from_secs(1));
    assert_eq!(drive.positions().len(), 1);
}

#[test]
fn a_beacon_goes_out_with_the_keyframe_that_it_tells_of() {
    let mut drive = Drive::new();
    let told = |drive: &Drive| {
        drive.wires.published.iter().filter(|(k, channel, _)| *k == 0 && *channel == Channel::Pose).count()
    };
    for n in 0..20 {
        drive.second(n, |_, _| {});
    }
    for n in 20..30 {
        let before = told(&drive);
        drive.wires.input(0, Input::Keyframe(drive.keyframes[0][n].clone()));
        assert_eq!(told(&drive), before + 1, "at once");
        drive.wires.run(Duration::from_millis(900));
        assert_eq!(told(&drive), before + 1, "no news");
    }
    // Ten keyframes a second: the latest, every half second.
    let before = told(&drive);
    let mut keyframe = drive.keyframes[0][29].clone();
    for _ in 0..50 {
        drive.wires.run(Duration::from_millis(100));
        keyframe.stamp = Stamp(keyframe.stamp.0 + 100_000_000);
        drive.wires.input(0, Input::Keyframe(keyframe.clone()));
    }
    let often = told(&drive) - before;
    assert!((9..=11).contains(&often), "{often} in five seconds");
}
