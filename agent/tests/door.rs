//! The robot's own SLAM comes in by a door of its own: what comes for `…/in/*` by the network of the robots is refused,
//! counted and told, whoever relays it; the door finds nobody, takes the robot's own input alone, and asks for a password
//! where others could reach it.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;

use common::{PATIENCE, Puppet, free_endpoint, keyframe, name, puppet, start, swarm, until};
use merganser::host::Host;
use merganser::keys;
use merganser::link::session;
use merganser::observation::KeyframeMessage;
use merganser_protocol::agent::io::{Channel, Input};
use serde_json::{Value, json};
use std::time::Duration;
use zenoh::Session;
use zenoh::qos::CongestionControl;

/// A session like that of a SLAM: of plain Zenoh, which knows nothing of ours.
async fn plain(mode: &str, connect: &str, more: &[(&str, Value)]) -> zenoh::Result<Session> {
    let mut config = zenoh::Config::default();
    let multicast = ("scouting/multicast/enabled", json!(false));
    let usual = [("mode", json!(mode)), ("connect/endpoints", json!([connect])), multicast];
    for (key, value) in usual.iter().chain([&("listen/endpoints", json!([]))]).chain(more) {
        config.insert_json5(key, &value.to_string()).unwrap();
    }
    tokio::time::timeout(PATIENCE, zenoh::open(config)).await.unwrap()
}

async fn put(session: &Session, robot: &str, rest: &str, index: u64) {
    let message = postcard::to_stdvec(&KeyframeMessage::from(&keyframe(0, index))).unwrap();
    let put = session.put(keys::of(&name("test"), &name(robot), rest), message).encoding("application/octet-stream");
    put.congestion_control(CongestionControl::Block).await.unwrap();
}

/// What an agent was handed with this stamp.
fn was_fed(core: &Puppet, index: u64) -> bool {
    let stamp = keyframe(0, index).stamp;
    core.has_heard(|input| matches!(input, Input::Keyframe(heard) if heard.stamp == stamp))
}

fn is_counted(host: &Host, reason: &str) -> bool {
    host.inbox().drops.counts().keys().any(|counted| counted.contains(reason))
}

#[tokio::test(flavor = "multi_thread")]
async fn input_by_the_network_of_the_robots_is_refused_and_told_whoever_relays_it() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha"]);
    let door = free_endpoint();
    configs[0].zenoh.input_listen = Some(vec![door.clone()]);
    let core = Puppet::default();
    let alpha = puppet(&configs[0], &core).await;
    let robots = configs[0].zenoh.listen[0].clone();
    // Each has a link over this host's loopback: itself, or what it passes on has.
    let mut index = 0;
    for (relay, mode) in [(None, "peer"), (None, "client"), (Some("router"), "client"), (Some("peer"), "client")] {
        let (way, relay) = match relay {
            None => (robots.clone(), None),
            Some(relay) => {
                let endpoint = free_endpoint();
                let listen = ("listen/endpoints", json!([endpoint]));
                (endpoint, Some(plain(relay, &robots, &[listen]).await.unwrap()))
            }
        };
        let outsider = plain(mode, &way, &[]).await.unwrap();
        let count = || {
            let counts = alpha.inbox().drops.counts();
            counts.get("refused: in/keyframe from the network of the robots").copied().unwrap_or(0)
        };
        let before = count();
        until("a refusal", async || {
            index += 1;
            put(&outsider, "alpha", "in/keyframe", index).await;
            count() > before
        })
        .await;
        session::close(&outsider, PATIENCE).await;
        if let Some(relay) = relay {
            session::close(&relay, PATIENCE).await;
        }
    }
    // By its own door the same is taken, and nothing of all that was.
    let slam = plain("client", &door, &[]).await.unwrap();
    until("the robot's own keyframe", async || {
        put(&slam, "alpha", "in/keyframe", 10_000).await;
        was_fed(&core, 10_000)
    })
    .await;
    assert!((1..=index).all(|index| !was_fed(&core, index)));
    assert!(!core.has_heard(|input| matches!(input, Input::KeyframesLost { .. })), "a stranger makes no gaps");
    session::close(&slam, PATIENCE).await;
    alpha.stop().await.unwrap();
}

/// Who comes in by the door feeds this robot, and can say nothing to others or in others' names.
#[tokio::test(flavor = "multi_thread")]
async fn the_door_takes_the_robots_own_input_alone_and_shows_its_views() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha", "beta"]);
    let door = free_endpoint();
    configs[0].zenoh.input_listen = Some(vec![door.clone()]);
    let core = Puppet::default();
    let alpha = puppet(&configs[0], &core).await;
    let slam = plain("client", &door, &[]).await.unwrap();
    let view = keys::of(&name("test"), &name("alpha"), "view/status");
    let mut status = None;
    until("a view", async || {
        let replies = slam.get(&view).await.unwrap();
        status = replies.recv_async().await.ok();
        status.is_some()
    })
    .await;
    let status: Value = serde_json::from_slice(&status.unwrap().result().unwrap().payload().to_bytes()).unwrap();
    assert_eq!(status["input"], json!([door]));
    let published = slam.declare_subscriber(&view).await.unwrap();
    tokio::time::timeout(PATIENCE, published.recv_async()).await.unwrap().unwrap();

    for rest in ["facts", "pose", "have", "in/keyframe"] {
        put(&slam, "beta", rest, 1).await;
    }
    until("the robot's own keyframe", async || {
        put(&slam, "alpha", "in/keyframe", 2).await;
        was_fed(&core, 2)
    })
    .await;
    let broadcast = |input: &Input| {
        matches!(input, Input::Received { channel: Channel::Facts | Channel::Pose | Channel::Have, .. })
    };
    assert!(!core.has_heard(broadcast) && !was_fed(&core, 1));
    assert!(alpha.inbox().drops.counts().is_empty(), "{:?}", alpha.inbox().drops.counts());
    session::close(&slam, PATIENCE).await;
    alpha.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_door_with_a_password_opens_to_those_who_have_it() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha"]);
    let door = free_endpoint();
    let users = dir.path().join("users");
    std::fs::write(&users, "slam:secret\n").unwrap();
    configs[0].zenoh.input_listen = Some(vec![door.clone()]);
    configs[0].zenoh.input_users_file = Some(users);
    let core = Puppet::default();
    let alpha = puppet(&configs[0], &core).await;
    let user = |password: &str| {
        let name = ("transport/auth/usrpwd/user", json!("slam"));
        [name, ("transport/auth/usrpwd/password", json!(password))]
    };
    // A client that is not let in does not open, or finds nobody.
    for more in [Vec::new(), user("guess").to_vec()] {
        if let Ok(stranger) = plain("client", &door, &more).await {
            put(&stranger, "alpha", "in/keyframe", 1).await;
            session::close(&stranger, Duration::from_secs(3)).await;
        }
    }
    let slam = plain("client", &door, &user("secret")).await.unwrap();
    until("the robot's own keyframe", async || {
        put(&slam, "alpha", "in/keyframe", 2).await;
        was_fed(&core, 2)
    })
    .await;
    assert!(!was_fed(&core, 1), "a stranger fed the robot");
    session::close(&slam, PATIENCE).await;
    alpha.stop().await.unwrap();
}

/// Views to the network of the robots have a budget; the door has none.
#[tokio::test(flavor = "multi_thread")]
async fn views_to_the_network_stay_within_their_budget() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha"]);
    let door = free_endpoint();
    configs[0].zenoh.input_listen = Some(vec![door.clone()]);
    configs[0].debug.bytes_per_sec = 2_000.0;
    let alpha = start(&configs[0], None).await;
    let outsider = plain("client", &configs[0].zenoh.listen[0], &[]).await.unwrap();
    let slam = plain("client", &door, &[]).await.unwrap();
    let view = keys::of(&name("test"), &name("alpha"), "view/status");
    let ask = async |session: &Session| {
        let replies = session.get(&view).timeout(Duration::from_secs(5)).await.unwrap();
        let reply = replies.recv_async().await.ok()?;
        let told = match reply.result() {
            Ok(sample) => Ok(sample.payload().len()),
            Err(error) => Err(error.payload().try_to_string().unwrap().into_owned()),
        };
        Some(told)
    };
    until("an answer by either way", async || {
        ask(&slam).await.is_some_and(|told| told.is_ok()) && ask(&outsider).await.is_some()
    })
    .await;
    let (began, mut bytes, mut refusals) = (std::time::Instant::now(), 0, Vec::new());
    for _ in 0..200 {
        match ask(&outsider).await {
            Some(Ok(length)) => bytes += length,
            Some(Err(told)) => refusals.push(told),
            None => {}
        }
        assert!(matches!(ask(&slam).await, Some(Ok(_))), "the door has no budget");
    }
    let most = 1_000.0 * (began.elapsed().as_secs_f64() + 2.0) + 4_000.0; // and the last one in full
    assert!((bytes as f64) < most, "{bytes} bytes, {most} at most");
    assert!(!refusals.is_empty() && is_counted(&alpha, "beyond debug.bytes_per_sec"));
    assert!(refusals[0].contains("debug.bytes_per_sec is spent; ask again in"), "{}", refusals[0]);
    [slam, outsider].into_iter().for_each(drop);
    alpha.stop().await.unwrap();
}
