//! Questions of others about what is held here, and the answers to them.

use super::Replication;
use crate::agent::context::Context;
use crate::agent::io::{AskToken, Output, QueryKind};
use crate::gossip::Class;
use crate::time::Instant;
use crate::wire::messages::Message;

impl Replication {
    /// A question of another, if it can be read and is of the kind that it claims to be.
    pub(in crate::agent) fn on_asked(&self, context: &mut Context, kind: QueryKind, bytes: &[u8]) -> Option<Message> {
        let question = match Message::decode(bytes) {
            Ok(question) => question,
            Err(error) => {
                context.reject(None, error.reason(), &error.to_string());
                return None;
            }
        };
        context.count().received(question.kind(), bytes.len());
        let is_of_kind = matches!(
            (kind, &question),
            (QueryKind::Sync, Message::SyncRequest(_))
                | (QueryKind::Blob, Message::BlobRequest { .. })
                | (QueryKind::Align, Message::AlignRequest { .. })
                | (QueryKind::Life, Message::LifeRequest { .. })
        );
        if !is_of_kind {
            context.reject(None, "wrong question", question.kind());
        }
        is_of_kind.then_some(question)
    }

    /// The answer to a question about what is held here.
    pub(in crate::agent) fn answer_to(&mut self, context: &mut Context, question: Message) -> Option<Message> {
        match question {
            Message::SyncRequest(have) => {
                let have = self.replica.read_have(&have)?;
                self.gossip.spread.on_asked(context.now(), &self.replica, &have);
                Some(Message::SyncReply(self.repair(context, &have)))
            }
            Message::BlobRequest { hash, offset, len } => self.piece(context, hash, offset as usize, len as usize),
            Message::LifeRequest { nonce } => self.prove_life(context, nonce),
            _ => None,
        }
    }

    /// Whether what others wish may be answered: it takes what is left, so that nobody's wishes keep us from repairing.
    pub(in crate::agent) fn may_answer_wish(&self, now: Instant) -> bool {
        self.gossip.traffic.may(now, Class::Blob)
    }

    /// Every question is answered exactly once; an empty answer says "I cannot".
    pub(in crate::agent) fn answer(
        &mut self,
        context: &mut Context,
        token: AskToken,
        kind: QueryKind,
        answer: Option<&Message>,
    ) {
        let class = match kind {
            QueryKind::Sync => Class::Repair,
            QueryKind::Blob => Class::Blob,
            QueryKind::Align | QueryKind::Life => Class::Have,
        };
        let bytes = answer.map_or_else(Vec::new, |message| self.pay_for_answer(context, class, message));
        context.put(Output::Answer { token, bytes });
    }
}
