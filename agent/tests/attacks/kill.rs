//! Kill −9 at random moments, again and again on one store: while the agent starts, while it describes submaps, and
//! while facts are written as fast as they can be. Whatever it had told anybody it must still hold after the restart,
//! in the same place with the same bytes; and it must go on with the same log, without a second entry in any place.

use super::common::{keyframe, name, swarm, until};
use super::number;
use super::outsider::{Agent, Outsider, sighting};
use merganser::observation::KeyframeMessage;
use merganser_protocol::config::Config;
use merganser_protocol::ids::RobotId;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};
use std::os::unix::process::ExitStatusExt as _;
use std::time::{Duration, Instant};
use tokio::time::sleep;

/// Latest moment of a kill while the agent starts, and while it writes, in milliseconds after the start of either.
const KILL_MS_MAX: [u64; 2] = [200, 200];
/// One in so many kills comes while the agent starts.
const STARTS: u64 = 4;
/// In one of so many loops a submap is finished.
const SUBMAPS: u64 = 8;
/// Keyframes that make a submap here.
const KEYFRAMES: u32 = 3;

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_killed_some_times_keeps_all_that_it_told() {
    all_is_kept(16, 1).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "night: a fifth of a second a kill, MERGANSER_KILLS of them"]
async fn a_robot_killed_at_any_moment_keeps_all_that_it_told() {
    all_is_kept(number("MERGANSER_KILLS", 300), number("MERGANSER_KILL_SEED", 1)).await;
}

async fn all_is_kept(kills: u64, seed: u64) {
    println!("MERGANSER_KILLS={kills} MERGANSER_KILL_SEED={seed}");
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut draw = |below: u64| rng.next_u64() % below;
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    let mut configs = swarm(folder, &["alpha", "beta", "gamma"]);
    let endpoint = |index: usize| configs[index].zenoh.listen[0].clone();
    let [beta, gamma] = [endpoint(1), endpoint(2)];
    let connect = [vec![beta.clone(), gamma], vec![], vec![beta]]; // alpha, which comes back, calls the others
    for (config, connect) in configs.iter_mut().zip(connect) {
        config.core = Config::default();
        config.core.submap.keyframes_max = KEYFRAMES;
        // Entries are counted here; a log that is replaced by what still counts of it has fewer.
        config.core.gossip.condense_entries = 0;
        config.zenoh.connect = connect;
        config.zenoh.gossip = false;
        config.save(&folder.join(format!("{}.toml", config.robot))).unwrap();
    }
    let _beta = Agent::run(folder, "beta", &[]);
    let mut outsider = Outsider::join(&configs[2], "alpha").await; // who is gamma
    outsider.status("beta").await;

    let alpha_id = RobotId::of_key(&configs[0].roster[&name("alpha")].to_bytes());
    let (mut epoch, mut frames, mut sighted) = (None, 0, 0);
    let (mut starting, mut acknowledged) = (0, 0);
    let began = Instant::now();
    for loop_number in 0..kills {
        let beta_held = outsider.status("beta").await.entries;
        let alpha = Agent::run(folder, "alpha", &["--seed", &loop_number.to_string()]);
        if epoch.is_some() && draw(STARTS) == 0 {
            sleep(Duration::from_millis(draw(KILL_MS_MAX[0]))).await;
            assert_eq!(alpha.kill().signal(), Some(9));
            starting += 1;
            continue;
        }

        let status = outsider.status("alpha").await;
        let told = outsider.take_told();
        acknowledged += told.len();
        let context = format!("kill {loop_number} of seed {seed}: {status:?}");
        assert!(status.entries >= outsider.replica.count(), "told {}: {context}", outsider.replica.count());
        assert!(status.entries >= beta_held, "beta held {beta_held}: {context}");
        assert_eq!(status.epoch, *epoch.get_or_insert(status.epoch), "{context}");
        assert!(outsider.sync("alpha").await, "{context}");
        for (id, bytes) in told {
            assert_eq!(outsider.replica.entry_bytes(id), Some(&bytes[..]), "{id}: {context}");
        }
        until("the same set", async || {
            outsider.listen(); // what is pending from before the kill may be stated now
            outsider.sync("alpha").await;
            let status = outsider.status("alpha").await;
            (status.digest, status.entries) == (outsider.replica.digest().to_string(), outsider.replica.count())
        })
        .await;

        let wanted = if loop_number % SUBMAPS == 0 { u64::from(KEYFRAMES) } else { 1 };
        for index in frames..frames + wanted {
            outsider.feed("alpha", "keyframe", &KeyframeMessage::from(&keyframe(0, index))).await;
        }
        frames += wanted;
        if loop_number == 0 {
            // What is published while links come up may be lost. A SLAM goes on.
            until("the first fact", async || {
                sleep(Duration::from_millis(500)).await;
                let done = outsider.status("alpha").await.entries > 0;
                if !done {
                    outsider.feed("alpha", "keyframe", &KeyframeMessage::from(&keyframe(0, frames))).await;
                    frames += 1;
                }
                done
            })
            .await;
        }
        let end = Instant::now() + Duration::from_millis(draw(KILL_MS_MAX[1]));
        while Instant::now() < end {
            outsider.beacon().await;
            for _ in 0..2 {
                sighted += 1;
                let stamp = keyframe(0, frames).stamp.0 + sighted % 1000;
                outsider.feed("alpha", "sighting", &sighting(stamp, "gamma")).await;
            }
            if draw(4) == 0 {
                outsider.sync("alpha").await; // an answer tells facts, too
            }
            sleep(Duration::from_millis(4)).await;
        }
        assert_eq!(alpha.kill().signal(), Some(9));
        outsider.listen();
    }
    let secs = began.elapsed().as_secs_f64();

    let _alpha = Agent::run(folder, "alpha", &[]);
    until("all hold the same", async || {
        outsider.listen();
        let synced = outsider.sync("alpha").await;
        let (alpha, beta) = (outsider.status("alpha").await, outsider.status("beta").await);
        synced && alpha.digest == beta.digest && alpha.digest == outsider.replica.digest().to_string()
    })
    .await;
    let rejected = outsider.stats("beta").await.rejected;
    assert!(!rejected.keys().any(|reason| reason.contains("fork")), "{rejected:?}");
    assert_eq!(outsider.replica.forks().count(), 0);
    assert_eq!(outsider.replica.epochs_of(alpha_id).count(), 1);
    let (entries, submaps) = (outsider.replica.count(), outsider.status("alpha").await.submaps);
    println!(
        "{kills} kills in {secs:.0} s ({starting} of them while it started): {entries} entries, {acknowledged} times one \
         was told; 0 lost, 0 places used twice, 1 epoch, {submaps} submaps"
    );
    assert!(entries > kills, "too little was written to mean anything");
    outsider.leave().await;
}
