//! Agents on real Zenoh, over loopback: everything that one core says reaches the other as it was said, every question
//! ends in one answer, and floods are dropped and counted.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;

use common::{PATIENCE, Puppet, id, keyframe, name, puppet, start, swarm, until};
use merganser::config::{FileConfig, ZenohConfig};
use merganser::keys;
use merganser::link::session::{self, Role};
use merganser::observation::{KeyframeMessage, POINTS_MAX};
use merganser::store;
use merganser_protocol::agent::io::{Channel, Command, Input, Output, QueryId, QueryKind, Record};
use merganser_protocol::ids::RobotId;
use merganser_protocol::snapshot::StatusView;
use merganser_protocol::submap::Loss;
use std::collections::BTreeMap;
use std::time::Duration;
use zenoh::Session;
use zenoh::qos::CongestionControl;

async fn onlooker(config: &FileConfig) -> Session {
    let zenoh = ZenohConfig { connect: config.zenoh.listen.clone(), multicast: false, ..ZenohConfig::default() };
    session::open(&zenoh, Role::Onlooker).await.unwrap()
}

/// A view of `robot`, asked for over Zenoh.
async fn view(session: &Session, robot: &str, view: &str) -> Option<serde_json::Value> {
    let key = keys::of(&name("test"), &name(robot), &format!("view/{view}"));
    let replies = session.get(key).timeout(Duration::from_secs(5)).await.unwrap();
    let reply = replies.recv_async().await.ok()?;
    let sample = reply.result().ok()?;
    assert_eq!(sample.encoding().to_string(), format!("application/json;merganser.view.{view}/1"));
    Some(serde_json::from_slice(&sample.payload().to_bytes()).unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn channels_questions_and_presence_cross_the_network_unchanged() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha", "beta", "gamma"]); // gamma never starts
    let (a, b) = (Puppet::default(), Puppet { answers: true, ..Puppet::default() });
    let alpha = puppet(&configs[0], &a).await;
    let beta = puppet(&configs[1], &b).await;
    let up = |robot: RobotId, wanted: bool| move |input: &Input| matches!(input, Input::Neighbour { robot: r, up } if *r == robot && *up == wanted);
    until("alpha sees beta", async || a.has_heard(up(id(&configs[1]), true))).await;
    until("beta sees alpha", async || b.has_heard(up(id(&configs[0]), true))).await;

    for (channel, content) in [(Channel::Pose, 1_u8), (Channel::Facts, 2), (Channel::Have, 3)] {
        let sent = vec![content; 40_000 * usize::from(channel == Channel::Facts) + 20];
        let heard = |input: &Input| matches!(input, Input::Received { from, channel: c, bytes } if *from == id(&configs[0]) && *c == channel && *bytes == sent);
        // Drop on congestion is allowed, so say it until it is heard.
        until("a broadcast", async || {
            a.say(Output::Publish { channel, bytes: sent.clone() });
            b.has_heard(heard)
        })
        .await;
    }
    for (number, kind) in keys::QUERIES.into_iter().enumerate() {
        let (query, peer) = (QueryId(number as u64), id(&configs[1]));
        a.say(Output::Ask { query, peer, kind, bytes: vec![1, 2, number as u8] });
        let answered = |input: &Input| matches!(input, Input::Answered { query: q, bytes: Some(bytes) } if *q == query && *bytes == [number as u8, 2, 1]);
        until("an answer", async || a.has_heard(answered)).await;
        assert!(b.has_heard(|input| matches!(input, Input::Asked { kind: k, .. } if *k == kind)));
    }
    for (query, peer) in [(QueryId(100), id(&configs[2])), (QueryId(101), RobotId([0; 8]))] {
        a.say(Output::Ask { query, peer, kind: QueryKind::Sync, bytes: vec![] });
        let none = |input: &Input| matches!(input, Input::Answered { query: q, bytes: None } if *q == query);
        until("the answer that there is none", async || a.has_heard(none)).await;
    }
    assert!(!a.has_heard(|input| matches!(input, Input::Received { from, .. } if *from == id(&configs[0]))), "an echo");

    beta.stop().await.unwrap();
    until("alpha misses beta", async || a.has_heard(up(id(&configs[1]), false))).await;
    alpha.stop().await.unwrap();
}

/// Anyone may answer in another's name, and call himself complete; whoever was asked is heard all the same.
#[tokio::test(flavor = "multi_thread")]
async fn whoever_answers_in_anothers_name_silences_nobody() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha", "beta"]);
    let (a, b) = (Puppet::default(), Puppet { answers: true, ..Puppet::default() });
    let alpha = puppet(&configs[0], &a).await;
    let beta = puppet(&configs[1], &b).await;
    let outsider = onlooker(&configs[0]).await;
    let mut stolen = Vec::new();
    for kind in keys::QUERIES {
        let key = keys::of(&name("test"), &name("beta"), keys::query(kind));
        let (sender, receiver) = std::sync::mpsc::channel();
        let answer = move |query: zenoh::query::Query| {
            use zenoh::Wait as _;
            for _ in 0..3 {
                query.reply(query.key_expr().clone(), vec![9]).wait().unwrap();
            }
            sender.send(()).unwrap();
        };
        outsider.declare_queryable(key).complete(true).callback(answer).background().await.unwrap();
        stolen.push(receiver);
    }
    let mut number = 0;
    for (kind, stolen) in keys::QUERIES.into_iter().zip(stolen) {
        until("a question that both answer", async || {
            number += 1;
            let query = QueryId(number);
            a.say(Output::Ask { query, peer: id(&configs[1]), kind, bytes: vec![1, 2] });
            let of = |input: &Input| match input {
                Input::Answered { query: of, bytes } if *of == query => Some(bytes.clone()),
                _ => None,
            };
            until("the end of a question", async || a.has_heard(|input| of(input) == Some(None))).await;
            let heard: Vec<_> = a.heard.lock().unwrap().iter().filter_map(of).collect();
            assert_eq!(heard.iter().position(Option::is_none), Some(heard.len() - 1), "the end comes once, and last");
            let is_heard = |bytes: &[u8]| heard.iter().flatten().any(|answer| answer == bytes);
            stolen.try_recv().is_ok() && is_heard(&[9]) && is_heard(&[2, 1])
        })
        .await;
    }
    alpha.stop().await.unwrap();
    beta.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_is_dropped_and_counted_while_the_core_keeps_answering() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha", "beta"]);
    configs[1].driver.queue = 16;
    let a = Puppet::default();
    let b = Puppet { answers: true, slow: Duration::from_millis(5), ..Puppet::default() };
    let alpha = puppet(&configs[0], &a).await;
    let beta = puppet(&configs[1], &b).await;
    let mut asked = 0;
    until("drops", async || {
        for _ in 0..500 {
            a.say(Output::Publish { channel: Channel::Facts, bytes: vec![7; 100] });
        }
        asked += 1;
        a.say(Output::Ask { query: QueryId(asked), peer: id(&configs[1]), kind: QueryKind::Sync, bytes: vec![5] });
        beta.inbox().drops.counts().get("queue full: alpha").is_some_and(|count| *count > 1000)
    })
    .await;
    let answer = |input: &Input| matches!(input, Input::Answered { bytes: Some(bytes), .. } if *bytes == [5]);
    until("an answer through the flood", async || a.has_heard(answer)).await;
    let ends = |input: &Input| matches!(input, Input::Answered { bytes: None, .. });
    until("every question ended", async || a.heard.lock().unwrap().iter().filter(|i| ends(i)).count() as u64 == asked)
        .await;
    alpha.stop().await.unwrap();
    beta.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn strangers_and_oversized_messages_stop_at_the_edge() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha", "beta"]);
    let core = Puppet::default();
    let alpha = puppet(&configs[0], &core).await;
    let session = onlooker(&configs[0]).await;
    let counted = |reason: &str| alpha.inbox().drops.counts().keys().any(|counted| counted.contains(reason));
    until("the refusals", async || {
        for (robot, length) in [("stranger", 10), ("beta", 200_000)] {
            session.put(keys::of(&name("test"), &name(robot), "facts"), vec![1; length]).await.unwrap();
        }
        let _ = session.get(keys::of(&name("test"), &name("alpha"), "sync")).await; // no payload
        counted("not in the roster") && counted("beta broadcast more than") && counted("without a payload")
    })
    .await;
    assert!(!core.has_heard(|input| matches!(input, Input::Received { .. } | Input::Asked { .. })));
    session::close(&session, PATIENCE).await;
    alpha.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_swarm_on_one_host_is_fed_in_json_and_postcard_on_its_own_session() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha", "beta"]);
    configs[1].zenoh.input_interfaces = vec!["none0".into()]; // as if we were another computer
    let alpha = start(&configs[0], None).await;
    let beta = start(&configs[1], None).await;
    let session = onlooker(&configs[0]).await;
    until("both robots", async || {
        view(&session, "alpha", "status").await.is_some() && view(&session, "beta", "status").await.is_some()
    })
    .await;
    let send = async |robot: &str, bytes: Vec<u8>, encoding: &str| {
        let key = keys::of(&name("test"), &name(robot), "in/keyframe");
        session.put(key, bytes).encoding(encoding).await.unwrap();
    };
    let keyframes = async |robot: &str| view(&session, robot, "status").await.map(|v| v["keyframes"].as_u64().unwrap());
    let message = |index| KeyframeMessage::from(&keyframe(0, index));
    // What is published while links come up may be lost: until something has arrived.
    until("the way to alpha", async || {
        send("alpha", b"hello".to_vec(), "text/plain").await;
        let stats = view(&session, "alpha", "stats").await;
        stats.is_some_and(|stats| stats["shell"].to_string().contains("neither application/json nor"))
    })
    .await;

    for robot in ["beta", "alpha"] {
        send(robot, serde_json::to_vec(&message(0)).unwrap(), "application/json").await;
        send(robot, postcard::to_stdvec(&message(1)).unwrap(), "application/octet-stream").await;
        send(robot, b"{}".to_vec(), "application/json").await;
        send(robot, b"hello".to_vec(), "text/plain").await;
    }
    until("both keyframes", async || keyframes("alpha").await == Some(2)).await;
    let counts = async |robot: &str| {
        let stats = view(&session, robot, "stats").await.unwrap();
        serde_json::from_value::<BTreeMap<String, u64>>(stats["shell"].clone()).unwrap()
    };
    until("the refusals", async || {
        let counts = counts("alpha").await;
        let refused = |reason: &str| counts.keys().any(|counted| counted.contains(reason));
        refused("in/keyframe: JSON") && refused("neither application/json nor")
    })
    .await;
    assert_eq!(keyframes("beta").await, Some(0), "beta was sent the same, before alpha");
    assert!(counts("beta").await.is_empty(), "refused before it reached us");
    session::close(&session, PATIENCE).await;
    alpha.stop().await.unwrap();
    beta.stop().await.unwrap();
}

/// A full turn of a LiDAR is larger than what peers may send, and so is a depth image in JSON.
#[tokio::test(flavor = "multi_thread")]
async fn the_largest_keyframe_arrives_and_a_larger_one_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha"]);
    let core = Puppet::default();
    let alpha = puppet(&configs[0], &core).await;
    let session = onlooker(&configs[0]).await;
    let send = async |bytes: Vec<u8>, encoding: &str| {
        let key = keys::of(&name("test"), &name("alpha"), "in/keyframe");
        session.put(key, bytes).encoding(encoding).congestion_control(CongestionControl::Block).await.unwrap();
    };
    let of = |points: usize| KeyframeMessage { points: vec![[1.0, 2.0, 3.0]; points], ..(&keyframe(0, 0)).into() };
    let counted = |reason: &str| alpha.inbox().drops.counts().keys().any(|counted| counted.contains(reason));
    until("the way to alpha", async || {
        send(b"hello".to_vec(), "text/plain").await;
        counted("neither application/json nor")
    })
    .await;
    let heard = |points: usize| {
        core.has_heard(|input| matches!(input, Input::Keyframe(keyframe) if keyframe.points.len() == points))
    };
    send(postcard::to_stdvec(&of(POINTS_MAX)).unwrap(), "application/octet-stream").await;
    until("the largest keyframe", async || heard(POINTS_MAX)).await;
    send(postcard::to_stdvec(&of(POINTS_MAX + 1)).unwrap(), "application/octet-stream").await;
    until("the refusal of a point too many", async || counted("in/keyframe: too many points")).await;
    send(vec![b' '; configs[0].zenoh.input_bytes_max + 1], "application/json").await;
    until("the refusal of too many bytes", async || counted("in/keyframe: larger than zenoh.input_bytes_max")).await;
    assert!(!heard(POINTS_MAX + 1));
    let lost =
        |wanted: Loss| core.has_heard(|input| matches!(input, Input::KeyframesLost { why, .. } if *why == wanted));
    until("the core to be told of both", async || lost(Loss::Unreadable) && lost(Loss::TooLarge)).await;
    session::close(&session, PATIENCE).await;
    alpha.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn views_are_published_as_json_while_somebody_subscribes() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha"]);
    let alpha = start(&configs[0], None).await;
    alpha.inbox().feed(Input::Keyframe(keyframe(0, 0))).await;
    let session = onlooker(&configs[0]).await;
    let samples = session.declare_subscriber("merganser/v1/*/*/view/status").await.unwrap();
    let sample = tokio::time::timeout(PATIENCE, samples.recv_async()).await.unwrap().unwrap();
    assert_eq!(sample.key_expr().as_str(), "merganser/v1/test/alpha/view/status");
    assert_eq!(sample.encoding().to_string(), "application/json;merganser.view.status/1");
    let status: StatusView = serde_json::from_slice(&sample.payload().to_bytes()).unwrap();
    assert_eq!((status.robot.as_str(), status.swarm.as_str()), ("alpha", "test"));
    for view_name in keys::VIEWS {
        assert!(view(&session, "alpha", view_name).await.is_some(), "{view_name}");
    }
    let all = session.get("merganser/v1/test/*/view/*").await.unwrap();
    let mut names = Vec::new();
    while let Ok(reply) = all.recv_async().await {
        names.push(reply.result().unwrap().key_expr().as_str().rsplit('/').next().unwrap().to_string());
    }
    names.sort();
    assert_eq!(names, ["frames", "graph", "map", "path", "poses", "stats", "status"]);
    drop(samples);
    session::close(&session, PATIENCE).await;
    alpha.stop().await.unwrap();
}

/// Found in review: what an agent drove in the epoch before is written though it ends as the next one begins.
#[tokio::test(flavor = "multi_thread")]
async fn an_agent_that_ends_as_an_epoch_begins_still_saves_what_it_drove() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha"]);
    let entries = |config: &FileConfig| {
        let records = store::open(config).unwrap().restored.records;
        records.iter().filter(|record| matches!(record, Record::Entry { .. })).count()
    };
    // The first submap takes its epoch; the second is open when both that and the agent end.
    for wanted in 1..=2 {
        let alpha = start(&configs[0], None).await;
        for index in 0..4 {
            alpha.inbox().deliver(Input::Keyframe(keyframe(0, 4 * wanted + index)));
        }
        let status = async || alpha.snapshots().overview().await.unwrap().status;
        until("keyframes", async || status().await.keyframes == 4).await;
        if wanted == 2 {
            let epoch = status().await.epoch;
            alpha.inbox().deliver(Input::Command(Command::NewEpoch));
            // At once: the submap is still being described then.
            let told = async || while status().await.epoch == epoch {};
            tokio::time::timeout(PATIENCE, told()).await.unwrap();
        }
        alpha.stop().await.unwrap();
        assert_eq!(entries(&configs[0]) as u64, wanted);
    }
}
