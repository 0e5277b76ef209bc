//! What leaves: broadcasts and questions, one after the other, from a thread of their own. Zenoh drops what a congested
//! link cannot take; we drop what this thread cannot take, and count it. Repair catches up on both.

use super::session::LinkError;
use super::{Shared, refused};
use crate::driver::Outgoing;
use crate::keys;
use merganser_protocol::agent::io::{AskToken, Channel, Input, QueryId, QueryKind};
use merganser_protocol::ids::RobotId;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::time::Duration;
use zenoh::Wait;
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, QueryTarget, Reply};
use zenoh::sample::Locality;

/// Messages that may wait to be sent.
const WAITING_MAX: usize = 512;

/// Starts the thread; it ends when the sender is gone.
pub(super) fn start(shared: Arc<Shared>, answer_wait: Duration) -> Result<SyncSender<Outgoing>, LinkError> {
    let mut publishers = BTreeMap::new();
    for channel in keys::CHANNELS {
        let key = shared.own(keys::channel(channel));
        let publisher = shared.session.declare_publisher(key.clone());
        let publisher = publisher
            .congestion_control(CongestionControl::Drop)
            .priority(keys::priority(channel))
            .express(channel == Channel::Pose) // small and urgent: not held back to fill a batch
            .encoding(keys::encoding(channel))
            .allowed_destination(Locality::Remote);
        publishers.insert(channel, publisher.wait().map_err(refused(key))?);
    }
    let (sender, receiver) = sync_channel(WAITING_MAX);
    let name = std::thread::Builder::new().name("link".into());
    let thread = name.spawn(move || send_all(&shared, &publishers, answer_wait, &receiver));
    thread.map(|_| sender).map_err(refused("the link's thread".into()))
}

/// What to do with a message that did not find room: the core waits for an answer to each question.
pub(super) fn unsent(shared: &Shared, error: TrySendError<Outgoing>) {
    let (TrySendError::Full(outgoing) | TrySendError::Disconnected(outgoing)) = error;
    match outgoing {
        Outgoing::Publish(channel, _) => {
            shared.drops().count(format!("not sent, too many waiting: {}", keys::channel(channel)));
        }
        Outgoing::Ask(query, ..) => {
            shared.drops().count("not asked, too many waiting");
            shared.inbox.deliver(Input::Answered { query, bytes: None });
        }
        Outgoing::Answer(..) => {}
    }
}

/// Answers a peer's question.
pub(super) fn answer(shared: &Shared, token: AskToken, bytes: Vec<u8>) {
    match shared.recall(token) {
        Some((kind, question)) => {
            shared.reply(question, shared.own(keys::query(kind)), bytes, keys::query_encoding(kind));
        }
        None => tracing::error!(token = token.0, "the core answered a question twice; this is a bug"),
    }
}

fn send_all(
    shared: &Shared,
    publishers: &BTreeMap<Channel, Publisher<'_>>,
    answer_wait: Duration,
    receiver: &Receiver<Outgoing>,
) {
    while let Ok(outgoing) = receiver.recv() {
        match outgoing {
            Outgoing::Publish(channel, bytes) => {
                let sent = publishers.get(&channel).map(|publisher| publisher.put(bytes).wait());
                if let Some(Err(reason)) = sent {
                    shared.drops().count(format!("not sent: {}", keys::channel(channel)));
                    tracing::debug!(%reason, "a broadcast did not leave");
                }
            }
            Outgoing::Ask(query, peer, kind, bytes) => ask(shared, query, peer, kind, bytes, answer_wait),
            Outgoing::Answer(token, bytes) => answer(shared, token, bytes),
        }
    }
}

fn ask(shared: &Shared, query: QueryId, peer: RobotId, kind: QueryKind, bytes: Vec<u8>, wait: Duration) {
    let bytes_max = shared.message_bytes_max;
    let outcome = Outcome { query, bytes_max, inbox: shared.inbox.clone() };
    let Some(name) = shared.names.get(&peer) else {
        return shared.drops().count("not asked: nobody in the roster has this id"); // `outcome` says so to the core
    };
    let key = keys::of(&shared.swarm, name, keys::query(kind));
    let asked = shared
        .session
        .get(key)
        .payload(bytes)
        .encoding(keys::query_encoding(kind))
        .congestion_control(CongestionControl::Drop)
        .priority(keys::query_priority(kind))
        .consolidation(ConsolidationMode::None)
        .target(QueryTarget::All) // else whoever calls himself complete is asked alone
        .allowed_destination(Locality::Remote)
        .timeout(wait)
        .callback(move |reply| outcome.take(&reply))
        .wait();
    if let Err(reason) = asked {
        tracing::debug!(%reason, "a question did not leave");
    }
}

/// Tells the core each answer to one question, and at the end, when Zenoh lets go of the callback (all have answered, nobody
/// is there, or it is too late), that there will be no more. Anyone may answer; the core knows which answer is good.
struct Outcome {
    query: QueryId,
    bytes_max: usize,
    inbox: crate::queue::Inbox,
}

impl Outcome {
    fn take(&self, reply: &Reply) {
        if let Ok(sample) = reply.result() {
            if sample.payload().len() > self.bytes_max {
                let reason = "refused: an answer larger than zenoh.message_bytes_max";
                return self.inbox.drops.count(reason);
            }
            self.inbox.answer(self.query, sample.payload().to_bytes().into_owned());
        }
    }
}

impl Drop for Outcome {
    fn drop(&mut self) {
        self.inbox.deliver(Input::Answered { query: self.query, bytes: None });
    }
}
