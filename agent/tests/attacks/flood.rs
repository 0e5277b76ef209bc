//! A member of the swarm that talks of ten thousand robots a second that nobody knows: facts of unknown origin under
//! its own key, and messages under names that no roster has. Two honest agents must go on to hold the same facts while
//! the flood lasts, and must not grow with what they refuse.

use super::common::{swarm, until};
use super::outsider::{Agent, Outsider, Voice, sighting};
use merganser_protocol::agent::io::Channel;
use merganser_protocol::config::Config;
use merganser_protocol::ids::{EntryId, FrameId, Hash, RobotId};
use merganser_protocol::snapshot::StatusView;
use merganser_protocol::wire::{Entry, EntryContent, Message};
use std::path::Path;
use std::time::{Duration, Instant};

/// Unknown robots named in one message.
const IDS_PER_MESSAGE: u64 = 100;
/// Time between two such messages: ten thousand a second.
const MESSAGE_EVERY: Duration = Duration::from_millis(10);
/// Unknown names on keys for each such message: a thousand a second.
const NAMES_PER_MESSAGE: u64 = 10;
/// Most that an agent may grow while it is flooded, bytes.
const GROWTH_MAX: u64 = 16 << 20;
/// Sightings that the honest robots state in the flood.
const HONEST_FACTS: u64 = 20;

/// The flood ends when the honest have agreed, or after this long, s.
const FLOOD_SECS_MAX: u64 = 30;

#[tokio::test(flavor = "multi_thread")]
async fn strangers_in_any_number_cost_no_memory_and_stop_nobody() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    let mut configs = swarm(folder, &["alpha", "beta", "gamma"]);
    for config in &mut configs {
        config.core = Config::default(); // the recordings know better
        config.save(&folder.join(format!("{}.toml", config.robot))).unwrap();
    }
    let run = |robot: &str| {
        let recording = std::path::absolute("recordings").unwrap().join(robot);
        Agent::run(folder, robot, &["--recording", recording.to_str().unwrap(), "--speed", "10"])
    };
    let agents = [run("alpha"), run("beta")];
    let mut outsider = Outsider::join(&configs[2], "alpha").await; // who is gamma
    until("a quiet swarm", async || {
        let [alpha, beta] = both(&outsider).await;
        alpha.digest == beta.digest && [alpha, beta].iter().all(|s| s.idle && s.keyframes == 45 && s.submaps > 0)
    })
    .await;

    let quiet = state(&mut outsider, 0).await;
    let memory = agents.each_ref().map(Agent::memory);
    let (stop, stopped) = tokio::sync::watch::channel(false);
    let flood = tokio::spawn(flood(outsider.voice(), Forgery::new(&outsider), FLOOD_SECS_MAX, stopped));
    let began = Instant::now();
    tokio::time::sleep(Duration::from_secs(1)).await;
    let flooded = state(&mut outsider, HONEST_FACTS).await;
    assert!(!flood.is_finished(), "the flood was over before they agreed");
    stop.send(true).unwrap();
    let ids = flood.await.unwrap();

    println!("{ids} unknown ids in {:.0} s", began.elapsed().as_secs_f64());
    println!("{HONEST_FACTS} facts stated and held by both after {quiet:.2} s in quiet, {flooded:.2} s in the flood");
    for ((agent, before), robot) in agents.iter().zip(memory).zip(["alpha", "beta"]) {
        let rejected = outsider.stats(robot).await.rejected;
        let refused = rejected.get("unknown_origin").copied().unwrap_or(0);
        assert!(refused > 0, "the flood never came to {robot}: {rejected:?}");
        let Some((before, after)) = before.zip(agent.memory()) else { continue };
        println!("{robot} refused {refused}; resident memory {} kB, then {} kB", before >> 10, after >> 10);
        assert!(after < before + GROWTH_MAX, "{robot} grew from {before} to {after} bytes");
    }
    outsider.listen();
    outsider.leave().await;
}

/// Has alpha state facts, and waits until beta holds them: how long that took, s. Sightings are numbered from `first`,
/// and of the outsider, who says where it is: of the others the last keyframe may be too long ago.
async fn state(outsider: &mut Outsider, first: u64) -> f64 {
    let entries = outsider.status("alpha").await.entries;
    let wanted = entries + HONEST_FACTS / 2; // an own queue may be full, too, but not for long
    let last = last_stamp("alpha");
    let began = Instant::now();
    for number in first..first + HONEST_FACTS {
        outsider.beacon().await;
        outsider.feed("alpha", "sighting", &sighting(last + number as i64, "gamma")).await;
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    until("facts of alpha at beta", async || {
        let [alpha, beta] = both(outsider).await;
        alpha.digest == beta.digest && alpha.entries >= wanted
    })
    .await;
    began.elapsed().as_secs_f64()
}

/// Of the last keyframe of a robot's recording, ns.
fn last_stamp(robot: &str) -> i64 {
    let table = Path::new("recordings").join(robot).join("keyframes.csv");
    let text = std::fs::read_to_string(table).unwrap();
    text.lines().last().unwrap().split(',').next().unwrap().parse().unwrap()
}

async fn both(outsider: &Outsider) -> [StatusView; 2] {
    [outsider.status("alpha").await, outsider.status("beta").await]
}

/// Floods for so many seconds and until told to stop; how many ids were named.
async fn flood(voice: Voice, mut forgery: Forgery, secs: u64, stop: tokio::sync::watch::Receiver<bool>) -> u64 {
    let began = tokio::time::Instant::now();
    for step in 0_u32.. {
        if began.elapsed().as_secs() >= secs && *stop.borrow() {
            break;
        }
        tokio::time::sleep_until(began + MESSAGE_EVERY * step).await;
        let entries = (0..IDS_PER_MESSAGE).map(|_| forgery.next());
        for message in Message::facts(entries) {
            voice.say("gamma", Channel::Facts, message.encode()).await;
        }
        for _ in 0..NAMES_PER_MESSAGE {
            voice.say(&format!("stranger-{}", forgery.made), Channel::Facts, forgery.next()).await;
        }
    }
    forgery.made
}

/// Makes entries of robots that nobody knows.
struct Forgery {
    sample: Vec<u8>,
    /// Where in the sample its robot is named.
    place: usize,
    made: u64,
}

impl Forgery {
    fn new(outsider: &Outsider) -> Self {
        let robot = RobotId(*b"nobody!!");
        let id = EntryId { frame: FrameId { robot, epoch: 1 }, seq: 0 };
        let content = EntryContent {
            swarm: outsider.replica.swarm(),
            id,
            kind: 200,
            floor: 0,
            previous: Hash::default(),
            payload: vec![7; 32],
        };
        let sample = Entry::sign(&ed25519_dalek::SigningKey::from_bytes(&[77; 32]), content).unwrap().encode();
        let place = sample.windows(8).position(|bytes| bytes == robot.0).unwrap();
        Self { sample, place, made: 0 }
    }

    /// An entry of yet another robot.
    fn next(&mut self) -> Vec<u8> {
        self.made += 1;
        let mut entry = self.sample.clone();
        entry[self.place..self.place + 8].copy_from_slice(&self.made.to_le_bytes());
        entry
    }
}
