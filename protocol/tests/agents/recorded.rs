//! A beacon that somebody recorded, played to a robot that has just started: it tells where the other was last known to
//! be, not that it is there, and nothing is measured against it.

use super::common::{Wires, World, agent, drive, identity, name, robot, secret};
use merganser_protocol::agent::io::{AskToken, Channel, Input, Output, QueryKind, Sighting};
use merganser_protocol::agent::{PROOFS_PER_SEC, Restored};
use merganser_protocol::snapshot::RobotView;
use merganser_protocol::time::{Instant, Stamp};
use merganser_protocol::wire::{BeaconAge, Life, LifeContent, Message, SwarmTag};
use std::time::Duration;

/// Alpha and beta drive; what beta's beacons said, and what alpha kept.
fn recorded() -> (Wires, Vec<Vec<u8>>) {
    let mut wires = Wires::new((0..2).map(|k| agent(k, Restored::default())).collect());
    let drives = [0, 1].map(|k| drive(&World::new(1), k, 12).0);
    for step in 0..12 {
        for (k, keyframes) in drives.iter().enumerate() {
            wires.input(k, Input::Keyframe(keyframes[step].clone()));
        }
        wires.run(Duration::from_secs(1));
    }
    let of_beta = wires.published.iter().filter(|(k, channel, _)| (*k, *channel) == (1, Channel::Pose));
    let beacons: Vec<_> = of_beta.map(|(_, _, bytes)| bytes.clone()).collect();
    assert!(beacons.len() > 5);
    (wires, beacons)
}

fn of_beta(wires: &Wires) -> Option<RobotView> {
    wires.agents[0].snapshot(wires.now).poses.robots.into_iter().find(|view| view.robot == "beta")
}

fn sight(wires: &mut Wires, stamp: Stamp) -> u64 {
    let t_body_other = [1.0, 2.0, 0.5, 0.0, 0.0, 0.0, 1.0];
    let mut covariance = [0.0; 21];
    [0, 6, 11, 15, 18, 20].into_iter().for_each(|diagonal| covariance[diagonal] = 1e-4);
    wires.input(0, Input::Sighting(Sighting { stamp, robot: name(1), t_body_other, covariance }));
    wires.agents[0].snapshot(wires.now).stats.rejected.get("sighting").copied().unwrap_or(0)
}

/// Alpha after a restart, which drives on, without beta.
fn restarted(wires: Wires) -> (Wires, Stamp) {
    let records = wires.disks[0].clone();
    let mut again = Wires::new(vec![agent(0, Restored { records, fresh_epoch: 9 })]);
    again.run(Duration::from_secs(3));
    let mut last = drive(&World::new(1), 0, 13).0.pop().unwrap();
    last.stamp = Stamp(last.stamp.0 + 1_000_000_000);
    let stamp = last.stamp;
    again.input(0, Input::Keyframe(last));
    (again, stamp)
}

fn play(wires: &mut Wires, beacon: &[u8]) {
    let bytes = beacon.to_vec();
    wires.input(0, Input::Received { from: robot(1), channel: Channel::Pose, bytes });
    wires.run(Duration::from_secs(2));
}

#[test]
fn who_is_there_is_known_to_be_and_can_be_sighted() {
    let (mut wires, _) = recorded();
    let view = of_beta(&wires).unwrap();
    assert!(view.live && view.age_secs < 2.0, "{view:?}");
    let stamp = drive(&World::new(1), 0, 12).0.pop().unwrap().stamp;
    assert_eq!(sight(&mut wires, stamp), 0);
    // It goes: what was heard last is told with its age.
    let alpha = wires.agents.remove(0);
    let mut alone = Wires::new(vec![alpha]);
    alone.now = wires.now;
    alone.run(Duration::from_secs(60));
    let view = of_beta(&alone).unwrap();
    assert!(view.age_secs > 59.0, "{view:?}");
}

#[test]
fn a_recorded_beacon_tells_where_a_robot_was_last_known_to_be_and_no_more() {
    let (wires, beacons) = recorded();
    let (mut wires, stamp) = restarted(wires);
    for (k, beacon) in beacons.iter().enumerate() {
        play(&mut wires, beacon);
        let view = of_beta(&wires).unwrap();
        assert!(!view.live && view.age_secs >= 3.0 + 2.0 * k as f64, "{view:?}");
        assert_eq!(sight(&mut wires, stamp), k as u64 + 1, "it is sighted at a place where it may not be");
    }
    let poses = wires.agents[0].snapshot(wires.now).poses;
    assert!(poses.pairs.is_empty());
}

/// What an outsider and a third member can answer in beta's name.
#[test]
fn nobody_else_can_say_that_it_is_there() {
    let (wires, beacons) = recorded();
    let latest = BeaconAge { epoch: 0, stamp: Stamp(i64::MIN), counter: 0 };
    let say = move |signer: usize, of: usize, nonce| {
        let key = ed25519_dalek::SigningKey::from_bytes(&secret(signer));
        let content = LifeContent { robot: robot(of), nonce, latest: Some(latest) };
        Message::LifeReply(Life::sign(&key, SwarmTag::of(&identity(0).swarm), content)).encode()
    };
    let (mut lied, stamp) = restarted(wires);
    let asked = std::rc::Rc::new(std::cell::Cell::new(0));
    let count = asked.clone();
    lied.forged = Box::new(move |_, kind, question| {
        let Ok(Message::LifeRequest { nonce }) = Message::decode(question) else { return Vec::new() };
        assert_eq!(kind, QueryKind::Life);
        count.set(count.get() + 1);
        // Another's word of itself or of beta; beta's word on another question.
        vec![say(2, 2, nonce), say(2, 1, nonce), say(1, 1, [7; 16]), Vec::new(), b"nonsense".to_vec()]
    });
    beacons.iter().for_each(|beacon| play(&mut lied, beacon));
    assert!(!of_beta(&lied).unwrap().live && asked.get() > 3, "{}", asked.get());
    assert_eq!(sight(&mut lied, stamp), 1);
    let rejected = lied.agents[0].snapshot(lied.now).stats.rejected;
    assert!(rejected["life: signature"] >= 3 * asked.get(), "{rejected:?}");
    // Beta's own word on this very question is believed.
    lied.forged = Box::new(move |_, _, question| match Message::decode(question) {
        Ok(Message::LifeRequest { nonce }) => vec![say(1, 1, nonce)],
        _ => Vec::new(),
    });
    let (mut wires, _) = recorded();
    wires.run(Duration::from_secs(5));
    let newer = wires.published.iter().rfind(|(k, channel, _)| (*k, *channel) == (1, Channel::Pose)).unwrap();
    play(&mut lied, &newer.2);
    assert!(of_beta(&lied).unwrap().live);
}

/// Whoever asks is not known, and costs a signature.
#[test]
fn so_many_proofs_of_life_are_signed_in_a_second_and_no_more() {
    let mut alpha = agent(0, Restored::default());
    let mut ask = |number: u8, millis: u64| {
        let (token, bytes) = (AskToken(u64::from(number)), Message::LifeRequest { nonce: [number; 16] }.encode());
        alpha.handle(Instant::from_nanos(millis * 1_000_000), Input::Asked { token, kind: QueryKind::Life, bytes });
        let answers = core::iter::from_fn(|| alpha.poll_output()).filter_map(|output| match output {
            Output::Answer { bytes, .. } => Some(!bytes.is_empty()),
            _ => None,
        });
        answers.collect::<Vec<_>>()
    };
    for number in 0..PROOFS_PER_SEC as u8 {
        assert_eq!(ask(number, u64::from(number)), [true]);
    }
    assert_eq!(ask(101, 999), [false]);
    assert_eq!(ask(102, 1_000), [true]);
}
