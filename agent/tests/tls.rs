//! Links by TLS on real Zenoh, over loopback: robots of one authority hear one another as over plain links, nobody else
//! gets a link, and what a robot says in another's name is not heard, by its link or through a router.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;

use base64::Engine as _;
use common::{PATIENCE, Puppet, free_endpoint, id, name, puppet, secured, start, swarm, until};
use merganser::certificates::authority::{Authority, key_pem};
use merganser::certificates::router::Router;
use merganser::certificates::{Certificate, Holder};
use merganser::config::{FileConfig, Mode};
use merganser::host::Host;
use merganser::keys;
use merganser::link::refusals::{self, Refusals};
use merganser::link::session;
use merganser::recording::Recording;
use merganser::trust::SecretKey;
use merganser_protocol::agent::io::{Channel, Command, Input, Output, QueryId, QueryKind};
use merganser_protocol::ids::RobotId;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;
use time::OffsetDateTime;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;
use zenoh::Session;

fn sees(robot: RobotId, wanted: bool) -> impl Fn(&Input) -> bool {
    move |input| matches!(input, Input::Neighbour { robot: r, up } if *r == robot && *up == wanted)
}

fn heard(from: RobotId, content: &[u8]) -> impl Fn(&Input) -> bool {
    move |input| matches!(input, Input::Received { from: f, bytes, .. } if *f == from && bytes == content)
}

/// A session of plain Zenoh that calls `endpoint` with these credentials.
async fn plain(
    endpoint: &str,
    authority: &Authority,
    own: Option<(&Certificate, &SecretKey)>,
) -> zenoh::Result<Session> {
    called(endpoint, authority, own, 20_000).await
}

/// The same, without patience.
async fn called(
    endpoint: &str,
    authority: &Authority,
    own: Option<(&Certificate, &SecretKey)>,
    wait_ms: u64,
) -> zenoh::Result<Session> {
    let text = |pem: &str| json!(base64::engine::general_purpose::STANDARD.encode(pem));
    let mut values = vec![
        ("mode", json!("client")),
        ("connect/endpoints", json!([endpoint])),
        ("connect/timeout_ms", json!(wait_ms)),
        ("scouting/multicast/enabled", json!(false)),
        ("transport/link/tls/root_ca_certificate_base64", text(authority.certificate().pem())),
        ("transport/link/tls/verify_name_on_connect", json!(false)),
    ];
    if let Some((certificate, key)) = own {
        values.push(("transport/link/tls/enable_mtls", json!(true)));
        values.push(("transport/link/tls/connect_certificate_base64", text(certificate.pem())));
        values.push(("transport/link/tls/connect_private_key_base64", text(&key_pem(&key.to_bytes()))));
    }
    let mut config = zenoh::Config::default();
    for (key, value) in values {
        config.insert_json5(key, &value.to_string()).unwrap();
    }
    tokio::time::timeout(PATIENCE, zenoh::open(config)).await.unwrap()
}

async fn view(session: &Session, robot: &str) -> Option<Value> {
    let key = keys::of(&name("test"), &name(robot), "view/status");
    let replies = session.get(key).timeout(Duration::from_secs(2)).await.unwrap();
    let reply = replies.recv_async().await.ok()?;
    serde_json::from_slice(&reply.result().ok()?.payload().to_bytes()).ok()
}

/// All that robots say to one another crosses links by TLS; `a` and `b` are their stand-ins.
async fn talk(configs: &[FileConfig], a: &Puppet, b: &Puppet) {
    until("alpha sees beta", async || a.has_heard(sees(id(&configs[1]), true))).await;
    until("beta sees alpha", async || b.has_heard(sees(id(&configs[0]), true))).await;
    for channel in [Channel::Pose, Channel::Facts, Channel::Have] {
        let sent = vec![7; 30];
        let is_it = |input: &Input| matches!(input, Input::Received { from, channel: c, bytes } if *from == id(&configs[0]) && *c == channel && *bytes == sent);
        until("a broadcast", async || {
            a.say(Output::Publish { channel, bytes: sent.clone() });
            b.has_heard(is_it)
        })
        .await;
    }
    for (number, kind) in keys::QUERIES.into_iter().enumerate() {
        let (query, peer) = (QueryId(number as u64), id(&configs[1]));
        a.say(Output::Ask { query, peer, kind, bytes: vec![1, 2, number as u8] });
        let answered = |input: &Input| matches!(input, Input::Answered { query: q, bytes: Some(bytes) } if *q == query && *bytes == [number as u8, 2, 1]);
        until("an answer", async || a.has_heard(answered)).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn robots_of_one_authority_hear_and_answer_one_another_and_show_views_to_observers() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha", "beta"]);
    let authority = secured(dir.path(), &mut configs, &["laptop"], &[]);
    let (a, b) = (Puppet::default(), Puppet { answers: true, ..Puppet::default() });
    let alpha = puppet(&configs[0], &a).await;
    let beta = puppet(&configs[1], &b).await;
    talk(&configs, &a, &b).await;

    let laptop = SecretKey::from_bytes([101; 32]);
    let issue = |holder, key: &SecretKey| authority.issue(&holder, &key.public(), 1).unwrap();
    let certificate = issue(Holder::Observer(name("laptop")), &laptop);
    let listed = plain(&configs[0].zenoh.listen[0], &authority, Some((&certificate, &laptop))).await.unwrap();
    let mut status = None;
    until("a view", async || {
        status = view(&listed, "alpha").await;
        status.is_some()
    })
    .await;
    let told = &status.unwrap()["certificate"];
    assert_eq!((&told["name"], &told["standing"]), (&json!("alpha"), &json!("valid")));
    // What an observer says is not heard; nor is a view shown to one that is not listed, or to a robot.
    listed.put(keys::of(&name("test"), &name("beta"), "pose"), vec![66]).await.unwrap();
    for (holder, key) in
        [(Holder::Observer(name("other")), &laptop), (Holder::Robot(name("beta")), &SecretKey::from_bytes([2; 32]))]
    {
        let certificate = issue(holder, key);
        let session = plain(&configs[0].zenoh.listen[0], &authority, Some((&certificate, key))).await.unwrap();
        assert_eq!(view(&session, "alpha").await, None, "{}", certificate.holder);
        session::close(&session, PATIENCE).await;
    }
    assert!(view(&listed, "alpha").await.is_some(), "the observer that is listed sees it still");
    assert!(!a.has_heard(heard(id(&configs[1]), &[66])));
    session::close(&listed, PATIENCE).await;
    beta.stop().await.unwrap();
    until("alpha misses beta", async || a.has_heard(sees(id(&configs[1]), false))).await;
    alpha.stop().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn two_robots_merge_by_tls() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha", "beta"]);
    secured(dir.path(), &mut configs, &[], &[]);
    let recordings = ["alpha", "beta"].map(|robot| Recording::open(&Path::new("recordings").join(robot)).unwrap());
    configs.iter_mut().zip(&recordings).for_each(|(config, of)| config.core = of.manifest().config.clone());
    let (alpha, beta) = (start(&configs[0], None).await, start(&configs[1], None).await);
    for (host, recording) in [&alpha, &beta].into_iter().zip(&recordings) {
        for index in 0..recording.len() {
            host.inbox().feed(Input::Keyframe(recording.keyframe(index).unwrap())).await;
        }
        host.inbox().feed(Input::Command(Command::Flush)).await;
    }
    let merged =
        async |host: &Host| host.snapshots().take().await.is_some_and(|seen| !seen.status.merged_with.is_empty());
    until("they merge", async || merged(&alpha).await && merged(&beta).await).await;
    alpha.stop().await.unwrap();
    beta.stop().await.unwrap();
}

/// Held by the tests that hear or cause refusals: those of all tests of one process are heard together.
static REFUSALS: tokio::sync::Mutex<()> = tokio::sync::Mutex::const_new(());

/// Who has no certificate of this swarm's authority that is good now gets no link, and the reason is kept to be told.
#[tokio::test(flavor = "multi_thread")]
async fn strangers_get_no_link_and_the_reason_is_told() {
    let _alone = REFUSALS.lock().await;
    let refused = Arc::<Refusals>::default();
    tracing_subscriber::registry().with(refusals::layer(refused.clone())).init();
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha", "beta"]);
    let authority = secured(dir.path(), &mut configs, &[], &[]);
    let core = Puppet::default();
    let alpha = puppet(&configs[0], &core).await;
    let endpoint = configs[0].zenoh.listen[0].clone();
    let beta = SecretKey::from_bytes([2; 32]);
    let holder = Holder::Robot(name("beta"));
    let day = time::Duration::DAY;
    let old = authority.issue_at(&holder, &beta.public(), OffsetDateTime::now_utc() - 3 * day, 1).unwrap();
    let early = authority.issue_at(&holder, &beta.public(), OffsetDateTime::now_utc() + 3 * day, 1).unwrap();
    let namesake = Authority::generate(name("test"), 10).unwrap().issue(&holder, &beta.public(), 1).unwrap();
    let other = Authority::generate(name("other"), 10).unwrap().issue(&holder, &beta.public(), 1).unwrap();
    let mut reasons = BTreeSet::new();
    for (who, own, wanted) in [
        ("one of another authority of this name", Some(&namesake), "BadSignature"),
        ("one of another swarm", Some(&other), "UnknownIssuer"),
        ("one whose certificate is over", Some(&old), "expired"),
        ("one whose certificate is not yet good", Some(&early), "not valid yet"),
        ("one without a certificate", None, "no certificates"),
    ] {
        until(who, async || {
            let own = own.map(|certificate| (certificate, &beta));
            let opened = called(&endpoint, &authority, own, 300).await;
            assert!(opened.is_err(), "{who} got a link");
            reasons.extend(refused.take().into_keys());
            reasons.iter().any(|refusal| refusal.called.is_none() && refusal.reason.contains(wanted))
        })
        .await;
    }
    for refusal in &reasons {
        let told = format!("{refusal}: {}", refusal.cure());
        assert!(!told.contains("UNIX"), "another reason at each moment: {told}");
        assert!(!told.contains("open file limit") && !told.contains("Retry") && told.lines().count() == 1, "{told}");
    }
    assert!(called(&endpoint.replace("tls/", "tcp/"), &authority, None, 300).await.is_err(), "plain TCP got a link");

    // On the other side: whoever calls a robot of another swarm learns which one, and why.
    let strange = tempfile::tempdir().unwrap();
    let mut others = swarm(strange.path(), &["alpha", "beta"]);
    secured(strange.path(), &mut others, &[], &[]);
    others[1].zenoh.connect = vec![endpoint.clone()];
    let caller = puppet(&others[1], &Puppet::default()).await;
    until("the caller is told", async || {
        reasons.extend(refused.take().into_keys());
        reasons.iter().any(|refusal| refusal.called.as_ref() == Some(&endpoint) && !refusal.reason.is_empty())
    })
    .await;
    caller.stop().await.unwrap();
    assert!(!core.has_heard(|input| matches!(input, Input::Neighbour { .. } | Input::Received { .. })));
    alpha.stop().await.unwrap();
}

/// What is said with beta's certificate in gamma's name; then what beta says itself, which comes after it.
async fn impostor(session: &Session) {
    let of = |robot: &str, rest: &str| keys::of(&name("test"), &name(robot), rest);
    for rest in ["pose", "facts", "have", "view/status"] {
        session.put(of("gamma", rest), vec![66]).await.unwrap();
    }
    for (robot, byte) in [("gamma", 66), ("beta", 77)] {
        for channel in ["pose", "facts", "have"] {
            session.put(of(robot, channel), vec![byte]).await.unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_robot_says_nothing_in_anothers_name() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha", "beta", "gamma"]); // gamma never starts
    let authority = secured(dir.path(), &mut configs, &[], &[]);
    let a = Puppet::default();
    let alpha = puppet(&configs[0], &a).await;
    let key = SecretKey::from_bytes([2; 32]);
    let certificate = authority.issue(&Holder::Robot(name("beta")), &key.public(), 1).unwrap();
    let beta = plain(&configs[0].zenoh.listen[0], &authority, Some((&certificate, &key))).await.unwrap();
    let of = |robot: &str, rest: &str| keys::of(&name("test"), &name(robot), rest);
    let mut tokens = Vec::new();
    for robot in ["gamma", "beta"] {
        for kind in keys::QUERIES {
            let answer = move |query: zenoh::query::Query| {
                use zenoh::Wait as _;
                query.reply(query.key_expr().clone(), vec![9]).wait().unwrap();
            };
            beta.declare_queryable(of(robot, keys::query(kind)))
                .complete(true)
                .callback(answer)
                .background()
                .await
                .unwrap();
        }
        tokens.push(beta.liveliness().declare_token(of(robot, keys::ALIVE)).await.unwrap());
    }
    until("beta is heard", async || {
        impostor(&beta).await;
        a.has_heard(heard(id(&configs[1]), &[77]))
    })
    .await;
    until("beta is there", async || a.has_heard(sees(id(&configs[1]), true))).await;
    // A question to beta is answered; one to gamma finds nobody.
    let mut number = 0;
    let mut asked = async |robot: usize, answered: bool| {
        until("an answer, or that there is none", async || {
            number += 1;
            let query = QueryId(number);
            a.say(Output::Ask { query, peer: id(&configs[robot]), kind: QueryKind::Sync, bytes: vec![1] });
            let of = |some: bool| move |input: &Input| matches!(input, Input::Answered { query: q, bytes } if *q == query && bytes.is_some() == some);
            until("an end", async || a.has_heard(of(false))).await;
            a.has_heard(of(true)) == answered
        })
        .await;
    };
    asked(1, true).await;
    asked(2, false).await;
    assert!(!a.has_heard(heard(id(&configs[2]), &[66])), "beta spoke as gamma");
    assert!(!a.has_heard(sees(id(&configs[2]), true)), "beta was there as gamma");
    let answers =
        |input: &Input| matches!(input, Input::Answered { query: QueryId(q), bytes: Some(_) } if *q == number);
    assert!(!a.has_heard(answers), "beta answered as gamma");
    session::close(&beta, PATIENCE).await;
    alpha.stop().await.unwrap();
}

/// A router with the file that `keys router` writes, and robots that link with it alone.
#[tokio::test(flavor = "multi_thread")]
async fn a_router_from_the_written_file_passes_on_what_each_says_in_its_own_name() {
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha", "beta", "gamma"]);
    let authority = secured(dir.path(), &mut configs, &[], &["hub"]);
    let endpoint = free_endpoint().replace("tcp/", "tls/");
    let hub = Router { name: name("hub"), listen: vec![endpoint.clone()], connect: Vec::new(), lease_secs: 10.0 };
    let (text, _) = hub.configuration(&authority, &configs[0].members(), 5).unwrap();
    let file = dir.path().join("hub.json5");
    std::fs::write(&file, text).unwrap();
    let mut file = zenoh::Config::from_file(&file).unwrap();
    file.insert_json5("scouting/multicast/enabled", "false").unwrap(); // whoever else is on this host
    let router = zenoh::open(file).await.unwrap();
    for config in &mut configs {
        config.zenoh.mode = Mode::Client;
        config.zenoh.connect = vec![endpoint.clone()];
    }
    let (a, b) = (Puppet::default(), Puppet { answers: true, ..Puppet::default() });
    let alpha = puppet(&configs[0], &a).await;
    let beta = puppet(&configs[1], &b).await;
    talk(&configs, &a, &b).await;
    let key = SecretKey::from_bytes([2; 32]);
    let certificate = authority.issue(&Holder::Robot(name("beta")), &key.public(), 1).unwrap();
    let impostor_of_gamma = plain(&endpoint, &authority, Some((&certificate, &key))).await.unwrap();
    until("beta is heard through the router", async || {
        impostor(&impostor_of_gamma).await;
        a.has_heard(heard(id(&configs[1]), &[77]))
    })
    .await;
    assert!(!a.has_heard(heard(id(&configs[2]), &[66])), "beta spoke as gamma through the router");
    session::close(&impostor_of_gamma, PATIENCE).await;
    beta.stop().await.unwrap();
    alpha.stop().await.unwrap();
    session::close(&router, PATIENCE).await;
}

/// Whoever's certificate ends while linked is parted from.
#[tokio::test(flavor = "multi_thread")]
async fn a_link_closes_when_a_certificate_ends() {
    let _alone = REFUSALS.lock().await;
    let dir = tempfile::tempdir().unwrap();
    let mut configs = swarm(dir.path(), &["alpha", "beta"]);
    let authority = secured(dir.path(), &mut configs, &[], &[]);
    let a = Puppet::default();
    let alpha = puppet(&configs[0], &a).await;
    // A busy host may need more seconds to open the link than the certificate has left: then once more, with twice as
    // many.
    for left in [6, 12, 24, 48] {
        // A day after a time that is a day ago.
        let made = OffsetDateTime::now_utc() - time::Duration::DAY + time::Duration::seconds(left);
        let key = &configs[1].roster[&name("beta")];
        let ending = authority.issue_at(&Holder::Robot(name("beta")), key, made, 1).unwrap();
        std::fs::write(configs[1].zenoh.certificate.as_ref().unwrap(), ending.pem()).unwrap();
        let beta = puppet(&configs[1], &Puppet::default()).await;
        let seen = until("alpha sees beta", async || a.has_heard(sees(id(&configs[1]), true)));
        let seen = tokio::time::timeout(Duration::from_secs(left as u64), seen).await.is_ok();
        if seen {
            until("alpha parts from beta", async || a.has_heard(sees(id(&configs[1]), false))).await;
        }
        beta.stop().await.unwrap();
        if seen {
            alpha.stop().await.unwrap();
            return;
        }
    }
    panic!("no link was opened within 48 s");
}
