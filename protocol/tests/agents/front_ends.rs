//! Front ends that restart, relocalise or err: a new epoch or a refusal, and no lie in the odometry.

use super::common::{Wires, agent};
use merganser_protocol::agent::Restored;
use merganser_protocol::agent::io::{Command, EpochReason, Event, Input, Record};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::submap::continuity::RESTART_KEYFRAMES;
use merganser_protocol::submap::{CovarianceOf, Keyframe, Loss};
use merganser_protocol::time::Stamp;
use merganser_protocol::wire::entry::Entry;
use merganser_protocol::wire::fact::{Fact, SubmapFact};
use nalgebra::Vector3;
use std::time::Duration;

const FIRST_EPOCH: u32 = 2;
/// Way between two keyframes, m, and the standard deviation that is stated of it.
const STEP: f64 = 0.78;
const SIGMA: f64 = 0.01;

fn keyframe(secs: u32, x: f64) -> Keyframe {
    let covariance = Covariance::from_sigmas([SIGMA; 6]).unwrap();
    let pose = PoseWithCovariance { pose: Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0)), covariance };
    let points = (0..400).map(|k| [(k % 20) as f32 * 0.3, (k / 20) as f32 * 0.3 - 3.0, 1.0 + (k % 7) as f32 * 0.1]);
    let (stamp, covariance_of) = (Stamp(i64::from(secs) * 1_000_000_000), CovarianceOf::Motion);
    let points = points.collect();
    Keyframe { stamp, session: None, pose, covariance_of, points, marks: vec![], place: None, up: None }
}

/// A drive from the frame's origin: keyframe by keyframe, from that second on.
fn drive(from: u32, count: u32) -> Vec<Keyframe> {
    (0..count).map(|k| keyframe(from + k, STEP * f64::from(k))).collect()
}

fn told(keyframes: Vec<Keyframe>) -> Wires {
    let mut wires = Wires::new(vec![agent(0, Restored { records: vec![], fresh_epoch: FIRST_EPOCH })]);
    for keyframe in keyframes {
        wires.input(0, Input::Keyframe(keyframe));
        wires.run(Duration::from_secs(1));
    }
    wires.input(0, Input::Command(Command::Flush));
    wires
}

/// Why epochs began.
fn begun(wires: &Wires) -> Vec<EpochReason> {
    let reason = |(_, event): &(usize, Event)| match event {
        Event::EpochBegan { reason, .. } => Some(*reason),
        _ => None,
    };
    wires.events.iter().filter_map(reason).collect()
}

fn refusals(wires: &Wires) -> u64 {
    wires.agents[0].snapshot(wires.now).stats.rejected.get("keyframe").copied().unwrap_or(0)
}

/// The epochs and submaps that were stated.
fn stated(wires: &Wires) -> Vec<(u32, SubmapFact)> {
    let submap = |record: &Record| match record {
        Record::Entry { id, bytes } => match Entry::decode(bytes).unwrap().fact() {
            Ok(Fact::Submap(fact)) => Some((id.frame.epoch, fact)),
            _ => None,
        },
        _ => None,
    };
    wires.disks[0].iter().filter_map(submap).collect()
}

/// No motion was stated but those that were driven, with no more doubt than they had.
fn is_all_driven(wires: &Wires, epochs: &[u32]) {
    let stated = stated(wires);
    assert!(epochs.iter().all(|epoch| stated.iter().any(|(of, _)| of == epoch)), "{stated:?}");
    for (epoch, fact) in stated.iter().filter(|(_, fact)| fact.index > 0) {
        let (way, sigma) = (fact.odometry.pose.translation.x, fact.odometry.covariance.sigmas()[0]);
        // Submaps of 3 m, of at least two keyframes.
        assert!((STEP..6.0).contains(&way) && sigma < 4.0 * SIGMA, "{epoch}#{}: {way:.2} ± {sigma:.3} m", fact.index);
    }
}

#[test]
fn a_slam_that_is_reset_to_its_origin_begins_an_epoch_and_no_lie_is_absorbed() {
    // After 15.6 m, and after 31.2 m.
    for driven in [21, 41] {
        let wires = told([drive(0, driven), drive(driven, 60)].concat());
        let status = wires.agents[0].status();
        assert_eq!((status.epoch, begun(&wires)), (FIRST_EPOCH + 1, vec![EpochReason::Jumped]));
        let lost = u64::from(RESTART_KEYFRAMES) - 1;
        assert_eq!((refusals(&wires), status.keyframes), (lost, u64::from(driven) + 60 - lost));
        is_all_driven(&wires, &[FIRST_EPOCH, FIRST_EPOCH + 1]);
    }
}

#[test]
fn one_wrong_pose_is_refused_by_a_clear_error() {
    let mut keyframes = drive(0, 40);
    keyframes[25].pose.pose.translation.y = 15.0;
    let wires = told(keyframes);
    assert_eq!((wires.agents[0].status().epoch, begun(&wires), refusals(&wires)), (FIRST_EPOCH, vec![], 1));
    let said = wires.events.iter().find_map(|(_, event)| match event {
        Event::Rejected { reason, .. } => Some(reason.clone()),
        _ => None,
    });
    let said = said.unwrap();
    for part in ["moved by 15.0", "in the 1.00 s", "at most 3.2", "odometry frame", "session", "submap.distance_m"] {
        assert!(said.contains(part), "{part} is not in: {said}");
    }
}

#[test]
fn another_session_begins_an_epoch_at_once() {
    let of = |session: u64, keyframes: Vec<Keyframe>| -> Vec<Keyframe> {
        keyframes.into_iter().map(|keyframe| Keyframe { session: Some(session), ..keyframe }).collect()
    };
    // Where nobody could see it by the poses.
    let wires = told([of(1, drive(0, 4)), of(2, drive(4, 20))].concat());
    assert_eq!((wires.agents[0].status().epoch, begun(&wires)), (FIRST_EPOCH + 1, vec![EpochReason::Session]));
    assert_eq!((refusals(&wires), wires.agents[0].status().keyframes), (0, 24));
    is_all_driven(&wires, &[FIRST_EPOCH, FIRST_EPOCH + 1]);
    // Who tells it both ways begins one.
    let mut wires = told(of(1, drive(0, 4)));
    wires.input(0, Input::Command(Command::NewEpoch));
    of(2, drive(4, 4)).into_iter().for_each(|keyframe| wires.input(0, Input::Keyframe(keyframe)));
    assert_eq!(begun(&wires), vec![EpochReason::Told]);
}

/// An old SLAM that is not dead yet beside the new one: of the old one all is refused, and the odometry of the new one
/// has no holes by it.
#[test]
fn two_sessions_that_take_turns_begin_one_epoch() {
    let of = |session: u64, keyframe: Keyframe| Keyframe { session: Some(session), ..keyframe };
    let both = drive(0, 40).into_iter().enumerate().map(|(k, keyframe)| of(1 + k as u64 % 2, keyframe));
    let wires = told(both.collect());
    assert_eq!((wires.agents[0].status().epoch, begun(&wires)), (FIRST_EPOCH + 1, vec![EpochReason::Session]));
    // The first of the old one was taken, and all of the new one.
    assert_eq!((refusals(&wires), wires.agents[0].status().keyframes), (19, 21));
}

#[test]
fn a_robot_that_restarts_beyond_its_last_epoch_goes_on() {
    let mut config = super::common::config();
    config.gossip.epochs_per_robot_max = 1;
    let mut wires = Wires::new(vec![super::common::agent_of(0, &config)]);
    let keyframes = [drive(0, 21), drive(21, 12)].concat();
    for keyframe in keyframes {
        wires.input(0, Input::Keyframe(keyframe));
        wires.run(Duration::from_secs(1));
    }
    let status = wires.agents[0].status();
    assert_eq!((begun(&wires).len(), status.receive_only), (1, false));
    assert!(status.keyframes > 28, "{}", status.keyframes);
}

/// Whatever lost a keyframe, the shell or the core: the motion across says so, it is counted, and told once.
#[test]
fn a_lost_keyframe_widens_the_odometry_is_counted_and_told_once() {
    let lost = |inputs: Vec<Input>| {
        let mut wires = Wires::new(vec![agent(0, Restored { records: vec![], fresh_epoch: FIRST_EPOCH })]);
        inputs.into_iter().for_each(|input| {
            wires.input(0, input);
            wires.run(Duration::from_secs(1));
        });
        wires.input(0, Input::Command(Command::Flush));
        let worst = |sigma: f64, (_, fact): &(u32, SubmapFact)| sigma.max(fact.odometry.covariance.sigmas()[0]);
        let sigma = stated(&wires).iter().filter(|(_, fact)| fact.index > 0).fold(0.0, worst);
        let told = |(_, event): &(usize, Event)| match event {
            Event::OdometryGap { why, .. } => Some(*why),
            _ => None,
        };
        let told: Vec<_> = wires.events.iter().filter_map(told).collect();
        let status = wires.agents[0].snapshot(wires.now).status;
        (sigma, told, status.gaps, status.keyframes_lost)
    };
    let all = || drive(1, 24).into_iter().map(Input::Keyframe).collect::<Vec<_>>();
    let (sigma, told, gaps, count) = lost(all());
    assert!(sigma < 4.0 * SIGMA && told.is_empty() && gaps == 0 && count.is_empty(), "{sigma} {told:?} {count:?}");
    for why in [Loss::Unreadable, Loss::TooLarge, Loss::QueueFull] {
        let mut inputs = all();
        inputs.insert(16, Input::KeyframesLost { why, count: 2 });
        inputs[12] = Input::KeyframesLost { why, count: 1 };
        inputs.insert(0, Input::KeyframesLost { why, count: 1 }); // before the first there is no motion
        let (sigma, told, gaps, count) = lost(inputs);
        assert!(sigma > 0.1 * STEP && told == [why] && gaps == 2, "{why:?}: {sigma} {told:?} {gaps}");
        assert_eq!(count.into_iter().collect::<Vec<_>>(), [(why.name().to_owned(), 4)]);
    }
    // Refused by the core, and late.
    let mut inputs = all();
    let mut bad = keyframe(13, STEP * 12.0);
    bad.stamp = Stamp(i64::MAX);
    inputs[12] = Input::Keyframe(bad);
    inputs.insert(18, Input::Keyframe(Keyframe { stamp: Stamp(5_500_000_000), ..keyframe(19, 0.0) }));
    let (sigma, told, gaps, count) = lost(inputs);
    assert!(sigma > 0.1 * STEP && told == [Loss::Refused, Loss::Late] && gaps == 2, "{sigma} {told:?} {gaps}");
    assert_eq!(count.len(), 2);
}

/// Six minutes parked at 10 Hz: one submap that others can have, and a live pose that is no older than the last keyframe.
#[test]
fn a_parked_robot_states_one_submap_and_where_it_is() {
    let mut wires = Wires::new(vec![agent(0, Restored { records: vec![], fresh_epoch: FIRST_EPOCH })]);
    for k in 0..3600 {
        let stamp = Stamp(1_000_000_000 + i64::from(k) * 100_000_000);
        wires.input(0, Input::Keyframe(Keyframe { stamp, ..keyframe(1, 0.002 * f64::from(k % 2)) }));
        if k % 100 == 99 {
            wires.run(Duration::from_secs(10));
        }
    }
    let seen = wires.agents[0].snapshot(wires.now);
    assert_eq!((stated(&wires).len(), seen.status.keyframes, seen.path.keyframes.len()), (1, 3600, 10));
    assert!((seen.poses.robots[0].stamp_secs - 360.9).abs() < 1e-6, "{}", seen.poses.robots[0].stamp_secs);
    let t = seen.poses.robots[0].t_own_body.as_ref().unwrap();
    // Four motions to the anchor, five from there to the submap's end, and one for all the time since.
    assert!((t.sigmas[0] - SIGMA * 10.0_f64.sqrt()).abs() < 1e-5, "{:?}", t.sigmas);
}
