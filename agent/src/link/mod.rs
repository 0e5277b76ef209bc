//! Zenoh on one side, the core's inputs and outputs on the other. Callbacks only copy into our bounded queue and
//! return, because an undrained handler blocks the whole link; what is sent leaves from a thread of its own, because
//! sending may wait for a slow neighbour; every question ends in exactly one `Input::Answered` without bytes.

pub mod access;
mod allowance;
mod door;
mod hear;
pub mod overhear;
pub mod refusals;
mod say;
pub mod scouting;
pub mod session;
mod views;

use crate::certificates::{Certificate, expiry};
use crate::config::FileConfig;
use crate::driver::{Network, Outgoing, Snapshots};
use crate::keys;
use crate::queue::{Drops, Inbox};
use door::Door;
use merganser_protocol::agent::io::{AskToken, QueryKind};
use merganser_protocol::ids::{Name, RobotId};
use session::{Guard, LinkError};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::Semaphore;
use tokio::task::JoinHandle;
use zenoh::Session;
use zenoh::bytes::Encoding;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::Query;

/// Peers' questions that may wait for the core at once.
const QUESTIONS_MAX: usize = 256;
/// Answers on their way out at once: each may be held up by a slow asker.
const ANSWERS_MAX: usize = 16;

/// This robot's place on the network.
#[derive(Debug)]
pub struct Link {
    session: Session,
    door: Option<Session>,
    token: Option<LivelinessToken>,
    tasks: Vec<JoinHandle<()>>,
    close_wait: Duration,
}

/// What the parts of a link share.
#[derive(Debug)]
struct Shared {
    session: Session,
    /// Where the robot's own SLAM comes in.
    door: Door,
    swarm: Name,
    robot: Name,
    /// By which others know it, if links are by TLS.
    certificate: Option<Certificate>,
    inbox: Inbox,
    ids: BTreeMap<Name, RobotId>,
    names: BTreeMap<RobotId, Name>,
    questions: Mutex<BTreeMap<AskToken, (QueryKind, Query)>>,
    answering: Arc<Semaphore>,
    /// Largest message of the robot's own SLAM.
    input_bytes_max: usize,
    /// Largest answer of a peer.
    message_bytes_max: usize,
}

/// The way out, for the driver.
#[derive(Debug)]
pub struct Sender(std::sync::mpsc::SyncSender<Outgoing>, Arc<Shared>);

impl Link {
    /// Opens the session of the robots with the way out, and the door for the robot's own SLAM. Nothing is heard or served before [`Opened::start`].
    ///
    /// # Errors
    /// [`LinkError`].
    pub async fn open(config: &FileConfig, guard: Option<&Guard>, inbox: Inbox) -> Result<(Opened, Sender), LinkError> {
        let session = session::open_guarded(&config.zenoh, session::Role::Robot, guard).await?;
        let door = Door::open(config).await?;
        let ids = config.roster.iter().map(|(name, key)| (name.clone(), RobotId::of_key(&key.to_bytes())));
        let ids: BTreeMap<Name, RobotId> = ids.collect();
        let shared = Arc::new(Shared {
            session,
            door,
            swarm: config.swarm.clone(),
            robot: config.robot.clone(),
            certificate: guard.map(|guard| guard.credentials.certificate.clone()),
            inbox,
            names: ids.iter().map(|(name, id)| (*id, name.clone())).collect(),
            ids,
            questions: Mutex::default(),
            answering: Arc::new(Semaphore::new(ANSWERS_MAX)),
            input_bytes_max: config.zenoh.input_bytes_max,
            message_bytes_max: config.zenoh.message_bytes_max,
        });
        let outgoing = say::start(shared.clone(), Duration::from_secs_f64(config.core.gossip.answer_secs))?;
        let opened = Opened { shared: shared.clone(), config: config.clone() };
        Ok((opened, Sender(outgoing, shared)))
    }

    /// Withdraws the liveliness token and closes the session, in bounded time.
    pub async fn close(mut self) {
        for task in &self.tasks {
            task.abort();
        }
        if let Some(token) = self.token.take() {
            let _ = token.undeclare().await; // closing withdraws it too
        }
        if let Some(door) = &self.door {
            session::close(door, self.close_wait).await;
        }
        session::close(&self.session, self.close_wait).await;
    }
}

/// A session that is open but serves nothing yet.
#[derive(Debug)]
pub struct Opened {
    shared: Arc<Shared>,
    config: FileConfig,
}

impl Opened {
    /// Hears and serves all of DESIGN §5's keys, then shows the liveliness token.
    ///
    /// # Errors
    /// [`LinkError::Declare`].
    pub async fn start(self, snapshots: Snapshots) -> Result<Link, LinkError> {
        let Self { shared, config } = self;
        let mut tasks = vec![hear::start(&shared).await?];
        if let Some(session) = &shared.door.session {
            tasks.push(tokio::spawn(door::watch(session.clone(), config.zenoh.clone())));
        }
        if let Some(certificate) = &shared.certificate {
            tasks.push(tokio::spawn(expiry::watch(certificate.clone())));
        }
        tasks.push(views::start(shared.clone(), snapshots, &config.debug, config.zenoh.message_bytes_max).await?);
        let key = keys::of(&shared.swarm, &shared.robot, keys::ALIVE);
        let token = shared.session.liveliness().declare_token(key.clone()).await.map_err(refused(key))?;
        let close_wait = Duration::from_secs_f64(config.zenoh.close_secs);
        Ok(Link {
            session: shared.session.clone(),
            door: shared.door.session.clone(),
            token: Some(token),
            tasks,
            close_wait,
        })
    }
}

impl Network for Sender {
    fn send(&mut self, outgoing: Outgoing) {
        if let Outgoing::Answer(token, bytes) = outgoing {
            return say::answer(&self.1, token, bytes);
        }
        if let Err(error) = self.0.try_send(outgoing) {
            say::unsent(&self.1, error);
        }
    }
}

impl Shared {
    fn drops(&self) -> &Drops {
        &self.inbox.drops
    }

    fn own(&self, rest: &str) -> String {
        keys::of(&self.swarm, &self.robot, rest)
    }

    /// Remembers a question under `token`; false if there are too many.
    fn remember(&self, token: AskToken, question: (QueryKind, Query)) -> bool {
        let mut questions = self.questions.lock().unwrap_or_else(PoisonError::into_inner);
        if questions.len() >= QUESTIONS_MAX {
            return false;
        }
        questions.insert(token, question);
        true
    }

    fn recall(&self, token: AskToken) -> Option<(QueryKind, Query)> {
        self.questions.lock().unwrap_or_else(PoisonError::into_inner).remove(&token)
    }

    /// Replies on a blocking thread, because a slow asker may hold it up for seconds.
    fn reply(&self, question: Query, key: String, bytes: Vec<u8>, encoding: Encoding) {
        let Ok(permit) = self.answering.clone().try_acquire_owned() else {
            return self.drops().count("answer dropped: too many on their way");
        };
        tokio::task::spawn_blocking(move || {
            use zenoh::Wait as _;
            if let Err(reason) = question.reply(key, bytes).encoding(encoding).wait() {
                tracing::debug!(%reason, "an answer did not leave");
            }
            drop(permit);
        });
    }

    /// Replies with an error in words.
    fn reply_error(&self, question: Query, told: String) {
        let Ok(permit) = self.answering.clone().try_acquire_owned() else {
            return self.drops().count("answer dropped: too many on their way");
        };
        tokio::task::spawn_blocking(move || {
            use zenoh::Wait as _;
            if let Err(reason) = question.reply_err(told).encoding(Encoding::TEXT_PLAIN).wait() {
                tracing::debug!(%reason, "an answer did not leave");
            }
            drop(permit);
        });
    }
}

fn refused<E: std::fmt::Display>(key: String) -> impl FnOnce(E) -> LinkError {
    move |error| LinkError::Declare { key, reason: session::in_words(error) }
}
