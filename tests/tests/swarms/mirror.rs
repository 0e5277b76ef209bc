//! A member that restates what two others saw as its own, with a forged step between the copies: it would place them as
//! it likes, if copies were evidence.

use ed25519_dalek::SigningKey;
use merganser::recording::Recording;
use merganser::recording::import::open_all;
use merganser_protocol::agent::io::{Channel, Event, Input};
use merganser_protocol::config::Config;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3, So3};
use merganser_protocol::ids::{FrameId, Hash, Name, RobotId, SubmapId};
use merganser_protocol::kinds::PairStatus;
use merganser_protocol::replica::{Ingested, Replica};
use merganser_protocol::snapshot::FramesView;
use merganser_protocol::wire::fact::{AlignmentFact, Fact, SubmapFact};
use merganser_protocol::wire::{EntryBytes, Message};
use merganser_tests::wires::{LIAR, LIAR_SECRET, Wires, play, play_with};
use nalgebra::Vector3;
use std::collections::BTreeSet;
use std::path::Path;

/// How far apart the mirror has them, m.
const JUMP_M: f64 = 5.0;
/// How often each submap is restated.
const COPIES: u32 = 3;

fn recordings() -> Vec<Recording> {
    open_all(Path::new("../agent/recordings")).unwrap().into_iter().take(2).collect()
}

fn at(x: f64, sigma: f64) -> PoseWithCovariance {
    let pose = Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0));
    PoseWithCovariance { pose, covariance: Covariance::from_sigmas([sigma; 6]).unwrap() }
}

/// What the mirror signs of all submaps that the honest published so far.
fn reflections(wires: &Wires, names: &[Name]) -> Vec<Vec<u8>> {
    let key = SigningKey::from_bytes(&LIAR_SECRET);
    let me = RobotId::of_key(&key.verifying_key().to_bytes());
    let keys = |k: usize| SigningKey::from_bytes(&[k as u8 + 1; 32]).verifying_key().to_bytes();
    let roster: Vec<(Name, [u8; 32])> = names.iter().enumerate().map(|(k, name)| (name.clone(), keys(k))).collect();
    let swarm = Name::new("wires").unwrap();
    let mut heard = Replica::new(&swarm, roster, &Config::default().gossip).unwrap();
    for (_, _, bytes) in wires.published.iter().filter(|(_, channel, _)| *channel == Channel::Facts) {
        let Ok(Message::Facts(entries)) = Message::decode(bytes) else { continue };
        for EntryBytes(entry) in entries {
            if let Ingested::New(ids) = heard.ingest(&entry).unwrap() {
                ids.into_iter().for_each(|id| heard.mark_durable(id));
            }
        }
    }
    let mut log =
        Replica::new(&swarm, [(Name::new(LIAR).unwrap(), key.verifying_key().to_bytes())], &Config::default().gossip)
            .unwrap();
    let frame = FrameId { robot: me, epoch: 1 };
    let mut submaps: Vec<(SubmapId, SubmapFact)> = heard
        .facts()
        .filter_map(|(id, fact)| match fact {
            Fact::Submap(fact) => Some((SubmapId { frame: id.frame, index: fact.index }, fact)),
            _ => None,
        })
        .collect();
    submaps.sort_by_key(|(id, _)| *id);
    let mut facts = Vec::new();
    let mut ties: Vec<(SubmapId, SubmapId, Hash)> = Vec::new();
    for (place, (id, fact)) in submaps.iter().enumerate() {
        let is_next_robot = place > 0 && submaps[place - 1].0.frame != id.frame;
        for copy in 0..COPIES {
            let odometry = match copy {
                0 if is_next_robot => at(JUMP_M, 1e-3),
                0 => PoseWithCovariance { covariance: at(0.0, 1e-3).covariance, ..fact.odometry },
                _ => at(0.0, 1e-3),
            };
            let own = SubmapId { frame, index: facts.len() as u32 };
            facts.push(Fact::Submap(SubmapFact { index: own.index, odometry, ..fact.clone() }));
            ties.push((own, *id, fact.blob));
        }
    }
    for (own, id, blob) in ties {
        let (i, j) = (own.min(id), own.max(id));
        let t_i_j = Relative::Metric(at(0.0, 3e-3));
        let blobs = [blob; 2];
        facts.push(Fact::Alignment(AlignmentFact { i, j, t_i_j, sigma: 0.01, support: 200, log10_nfa: -99.0, blobs }));
    }
    facts.iter().map(|fact| log.append(&key, 1, fact).unwrap().encode()).collect()
}

fn frames(wires: &Wires, robot: usize) -> FramesView {
    wires.agents[robot].snapshot(wires.now).frames
}

#[test]
fn a_mirror_places_nobody_and_is_named() {
    let recordings = recordings();
    let names: Vec<Name> = recordings.iter().map(|recording| recording.manifest().robot.clone()).collect();
    let honest = play(&recordings, 1).unwrap();
    let me = RobotId::of_key(&SigningKey::from_bytes(&LIAR_SECRET).verifying_key().to_bytes());
    let mut told = 0;
    let mirrored = play_with(&recordings, 1, |wires, count| {
        // While there is much still to come.
        if count == 60 {
            let lies = reflections(wires, &names);
            (0..2).for_each(|robot| wires.input(robot, Input::Neighbour { robot: me, up: true }));
            for entries in lies.chunks(8) {
                let message = Message::Facts(entries.iter().cloned().map(EntryBytes).collect());
                wires.publish_as(me, Channel::Facts, &message.encode());
            }
            told = lies.len();
        }
    })
    .unwrap();
    assert!(told > 60, "{told} lies");
    for robot in 0..2 {
        let (with, without) = (frames(&mirrored, robot), frames(&honest, robot));
        let statuses: BTreeSet<_> =
            with.pairs.iter().map(|pair| (pair.a.clone(), pair.b.clone(), pair.status)).collect();
        assert!(
            statuses.iter().any(|(a, b, status)| {
                *status == PairStatus::Merged && !a.starts_with(LIAR) && !b.starts_with(LIAR)
            }),
            "{statuses:?}"
        );
        let other = names[1 - robot].as_str();
        let t = |view: &FramesView| {
            view.frames.iter().find(|frame| frame.robot == other).and_then(|frame| frame.t_own_frame.clone()).unwrap()
        };
        let (t_with, t_without) = (t(&with), t(&without));
        let off =
            (0..3).map(|k| (t_with.pose.translation[k] - t_without.pose.translation[k]).powi(2)).sum::<f64>().sqrt();
        let sigma = t_without.sigmas[..3].iter().map(|s| s * s).sum::<f64>().sqrt();
        assert!(off < 2.0 * sigma, "moved by {off:.3} m, standard deviation {sigma:.3} m");
        let hers = with.frames.iter().find(|frame| frame.robot == LIAR).unwrap();
        assert!(hers.t_own_frame.is_none(), "nobody merges with her");
        let suspects: BTreeSet<&str> = with.suspects.iter().map(|suspect| suspect.robot.as_str()).collect();
        assert_eq!(suspects, BTreeSet::from([LIAR]), "she, and nobody else");
        assert!(with.suspects.iter().any(|suspect| suspect.certain), "{:?}", with.suspects);
        let warned = mirrored.events.iter().any(|(by, event)| {
            *by == robot && matches!(event, Event::Rejected { name, reason, .. } if name == LIAR && reason.starts_with("copied_submap"))
        });
        assert!(warned, "{robot} says nothing");
    }
}
