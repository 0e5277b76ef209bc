//! What arrives: broadcasts of robots of the roster, their questions, their coming and going, and what the robot's own
//! SLAM sends. Callbacks check size and sender, copy, and return.

use super::session::LinkError;
use super::{Shared, refused};
use crate::keys;
use crate::observation::{self, Format};
use crate::queue::Source;
use merganser_protocol::agent::io::{AskToken, Channel, Input, QueryKind};
use merganser_protocol::ids::{Name, RobotId};
use merganser_protocol::submap::Loss;
use merganser_protocol::wire::limits::{MESSAGE_LEN_MAX, MESSAGE_OVERHEAD_MAX};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use zenoh::bytes::Encoding;
use zenoh::query::Query;
use zenoh::sample::{Locality, Sample, SampleKind};

/// Largest message of a peer that is handed to the core, in bytes.
const PEER_BYTES_MAX: usize = MESSAGE_LEN_MAX + MESSAGE_OVERHEAD_MAX;

/// Declares everything; the task tells the core who is there.
pub(super) async fn start(shared: &Arc<Shared>) -> Result<JoinHandle<()>, LinkError> {
    let (present, presence) = watch::channel(BTreeSet::new());
    let present = Arc::new(present);
    for channel in keys::CHANNELS {
        let key = keys::of_all(&shared.swarm, keys::channel(channel));
        let (s, p) = (shared.clone(), present.clone());
        let subscriber = shared.session.declare_subscriber(key.clone()).allowed_origin(Locality::Remote);
        let heard = move |sample: Sample| broadcast(&s, &p, channel, &sample);
        subscriber.callback(heard).background().await.map_err(refused(key))?;
    }
    let tokens = Arc::new(AtomicU64::new(0));
    for kind in keys::QUERIES {
        let key = shared.own(keys::query(kind));
        let (s, tokens) = (shared.clone(), tokens.clone());
        let queryable = shared.session.declare_queryable(key.clone()).allowed_origin(Locality::Remote);
        let asked = move |query: Query| question(&s, &tokens, kind, query);
        queryable.callback(asked).background().await.map_err(refused(key))?;
    }
    for input in keys::INPUTS {
        let key = shared.own(&format!("in/{input}"));
        if let Some(door) = &shared.door.session {
            let s = shared.clone();
            let subscriber = door.declare_subscriber(key.clone()).callback(move |sample| own(&s, input, &sample));
            subscriber.background().await.map_err(refused(key.clone()))?;
        }
        let (s, feeds) = (shared.clone(), !shared.door.interfaces.is_empty());
        let heard = move |sample: Sample| if feeds { own(&s, input, &sample) } else { from_anyone(&s, input) };
        let subscriber = shared.session.declare_subscriber(key.clone()).callback(heard);
        subscriber.background().await.map_err(refused(key))?;
    }
    let key = keys::of_all(&shared.swarm, keys::ALIVE);
    let (s, p) = (shared.clone(), present);
    let liveliness = shared.session.liveliness();
    let seen = move |sample: Sample| alive(&s, &p, &sample);
    liveliness.declare_subscriber(key.clone()).history(true).callback(seen).background().await.map_err(refused(key))?;
    Ok(tokio::spawn(tell_neighbours(shared.clone(), presence)))
}

fn broadcast(shared: &Shared, present: &watch::Sender<BTreeSet<RobotId>>, channel: Channel, sample: &Sample) {
    let Some((name, from)) = sender(shared, sample) else {
        let reason = format!("refused: broadcast of {}, who is not in the roster", stranger(sample));
        return shared.drops().count_named(reason, "refused: broadcast of others who are not in the roster");
    };
    if sample.payload().len() > PEER_BYTES_MAX {
        let reason = format!("refused: {name} broadcast more than {PEER_BYTES_MAX} bytes");
        return shared.drops().count_named(reason, "refused: others broadcast too much at once");
    }
    if from != shared.ids[&shared.robot] {
        present.send_if_modified(|robots| robots.insert(from)); // who speaks is there
    }
    let bytes = sample.payload().to_bytes().into_owned();
    shared.inbox.offer(Source::Robot(name), Input::Received { from, channel, bytes });
}

fn question(shared: &Shared, tokens: &AtomicU64, kind: QueryKind, query: Query) {
    let Some(payload) = query.payload().filter(|payload| payload.len() <= PEER_BYTES_MAX) else {
        return shared.drops().count("refused: a question without a payload, or with too large a one");
    };
    let bytes = payload.to_bytes().into_owned();
    let token = AskToken(tokens.fetch_add(1, Relaxed));
    if !shared.remember(token, (kind, query)) {
        return shared.drops().count("refused: too many questions at once");
    }
    if !shared.inbox.offer(Source::Questions, Input::Asked { token, kind, bytes }) {
        drop(shared.recall(token)); // Zenoh tells the asker that nothing will come
    }
}

fn own(shared: &Shared, input: &'static str, sample: &Sample) {
    match parse(input, sample, shared.input_bytes_max) {
        Ok(observed) => {
            shared.inbox.offer(Source::Own, observed);
        }
        Err(Unfit { loss, kind, reason }) => {
            lose(shared, input, loss);
            refuse(shared, input, &kind, &reason);
        }
    }
}

/// Why what came for an input is none.
pub(super) struct Unfit {
    loss: Loss,
    /// To count by.
    kind: String,
    pub(super) reason: String,
}

/// Reads what came for an input.
pub(super) fn parse(input: &str, sample: &Sample, bytes_max: usize) -> Result<Input, Unfit> {
    let Some(format) = format_of(sample.encoding()) else {
        let (stated, cure) = (sample.encoding(), "state application/json, or application/octet-stream for postcard");
        return Err(Unfit {
            loss: Loss::Unreadable,
            kind: "neither application/json nor octet-stream".into(),
            reason: format!("the encoding {stated} is not read; {cure}"),
        });
    };
    let length = sample.payload().len();
    if length > bytes_max {
        let kind =
            format!("larger than zenoh.input_bytes_max = {bytes_max}: raise it (to 16777216 at most) or thin the data");
        return Err(Unfit { loss: Loss::TooLarge, reason: format!("{length} bytes, {kind}"), kind });
    }
    let bytes = sample.payload().to_bytes();
    let parsed = match input {
        "keyframe" => observation::keyframe(format, &bytes).map(Input::Keyframe),
        "sighting" => observation::sighting(format, &bytes).map(Input::Sighting),
        _ => observation::position(format, &bytes).map(Input::Position),
    };
    parsed.map_err(|error| {
        let reason = error.to_string();
        Unfit { loss: Loss::Unreadable, kind: first_words(&reason).into(), reason }
    })
}

/// Refuses input that came by the session of the robots, where anyone may have sent it. It leaves no gap in the odometry:
/// else anyone could make one.
fn from_anyone(shared: &Shared, input: &str) {
    if shared.drops().count_first(format!("refused: in/{input} from the network of the robots")) {
        let cure = shared.door.cure();
        tracing::warn!(
            input,
            cure,
            "refused input that came by the network of the robots, where anyone can send; the next is only counted"
        );
    }
}

/// A keyframe that the core will not see leaves a gap in the odometry, of which it must know. Other inputs leave none.
fn lose(shared: &Shared, input: &str, why: Loss) {
    if input == "keyframe" {
        shared.inbox.lose(why);
    }
}

/// Counts an input of our own SLAM that is refused, and tells the whole story of the first of each kind.
fn refuse(shared: &Shared, input: &str, kind: &str, reason: &str) {
    if shared.drops().count_first(format!("refused: in/{input}: {kind}")) {
        tracing::warn!(input, reason, "refused what our own SLAM sent; the next ones of this kind are only counted");
    } else {
        tracing::debug!(input, reason, "refused what our own SLAM sent");
    }
}

fn alive(shared: &Shared, present: &watch::Sender<BTreeSet<RobotId>>, sample: &Sample) {
    let Some((name, robot)) = sender(shared, sample) else {
        let reason = format!("ignored: {} is alive, who is not in the roster", stranger(sample));
        return shared.drops().count_named(reason, "ignored: others are alive who are not in the roster");
    };
    if name != shared.robot {
        present.send_if_modified(|robots| match sample.kind() {
            SampleKind::Put => robots.insert(robot),
            SampleKind::Delete => robots.remove(&robot),
        });
    }
}

/// Tells the core who came and who went. Quick changes melt together; the last state always arrives.
async fn tell_neighbours(shared: Arc<Shared>, mut presence: watch::Receiver<BTreeSet<RobotId>>) {
    let mut told = BTreeSet::new();
    loop {
        let now = presence.borrow_and_update().clone();
        for (robot, up) in told.difference(&now).map(|r| (*r, false)).chain(now.difference(&told).map(|r| (*r, true))) {
            if !shared.inbox.feed(Input::Neighbour { robot, up }).await {
                return;
            }
        }
        told = now;
        if presence.changed().await.is_err() {
            return;
        }
    }
}

fn sender(shared: &Shared, sample: &Sample) -> Option<(Name, RobotId)> {
    let (name, _) = keys::split(sample.key_expr().as_str())?;
    let id = *shared.ids.get(&name)?;
    Some((name, id))
}

/// What a sender outside the roster calls itself. Names are short; how many are told apart is bounded where they are
/// counted.
fn stranger(sample: &Sample) -> String {
    keys::split(sample.key_expr().as_str()).map_or_else(|| "somebody".to_owned(), |(name, _)| name.to_string())
}

/// JSON or postcard. A sample of no stated encoding is taken for postcard.
fn format_of(encoding: &Encoding) -> Option<Format> {
    let text = encoding.to_string();
    match text.split(';').next().unwrap_or_default() {
        "application/json" | "text/json" => Some(Format::Json),
        "application/octet-stream" | "zenoh/bytes" => Some(Format::Postcard),
        _ => None,
    }
}

/// Enough of a reason to count by: numbers in it would make each one different.
fn first_words(reason: &str) -> &str {
    reason.split(|c: char| c.is_ascii_digit()).next().unwrap_or(reason).trim_end_matches([' ', ':', ','])
}
