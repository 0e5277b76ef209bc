//! The task that owns the core and keeps its contract: hand it one input, drain its outputs, wait until its timeout or
//! the next input. Time is what has passed since the process began; heavy jobs run on blocking threads and come back as
//! inputs; everything that reaches the core is written to the journal first, if there is one.

use crate::journal::{self, Frame, StoredInput};
use crate::queue::{Inbox, Outbox};
use crate::store;
use crate::vain::{self, Vain};
use merganser_protocol::agent::Core;
use merganser_protocol::agent::io::{AskToken, Channel, Command, Event, Input, JobId, Output, QueryId, QueryKind};
use merganser_protocol::agent::job::Job;
use merganser_protocol::ids::{Hash, RobotId};
use merganser_protocol::kinds::PairStatus;
use merganser_protocol::snapshot::Snapshot;
use merganser_protocol::submap::{Keyframe, Loss};
use merganser_protocol::time::Instant;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{Semaphore, mpsc, oneshot};
use tracing::{debug, error, info, warn};

/// Shortest wait between two timeouts, should the core ask for one that lies in the past.
const TIMEOUT_STEP: Duration = Duration::from_millis(1);
/// Longest time that journal frames stay in memory.
const JOURNAL_FLUSH: Duration = Duration::from_millis(500);
/// Longest that an orderly end waits for the last submap to be described and stored.
const PARKING: Duration = Duration::from_secs(5);
/// Requests for snapshots that may wait.
const VIEWS_WAITING: usize = 16;

/// What the core wants sent. Sending never blocks: a network that cannot keep up drops and counts.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outgoing {
    /// See [`Output::Publish`].
    Publish(Channel, Vec<u8>),
    /// See [`Output::Ask`]; answered through [`Inbox::deliver`] in any case.
    Ask(QueryId, RobotId, QueryKind, Vec<u8>),
    /// See [`Output::Answer`].
    Answer(AskToken, Vec<u8>),
}

/// The way out: Zenoh, or a stand-in of a test.
pub trait Network: Send + 'static {
    /// Sends, or drops and counts. Must not block.
    fn send(&mut self, outgoing: Outgoing);
}

/// The clock: monotonic, from an origin at its making.
#[derive(Clone, Copy, Debug)]
pub struct Clock(tokio::time::Instant);

impl Clock {
    /// A clock that shows zero now.
    pub fn start() -> Self {
        Self(tokio::time::Instant::now())
    }

    /// Now.
    pub fn now(&self) -> Instant {
        Instant::ZERO.after(self.0.elapsed())
    }

    async fn reach(&self, moment: Instant) {
        match self.0.checked_add(moment.since(Instant::ZERO)) {
            Some(moment) => tokio::time::sleep_until(moment).await,
            None => std::future::pending().await,
        }
    }
}

/// Asks the driver for snapshots.
#[derive(Clone, Debug)]
pub struct Snapshots(mpsc::Sender<SnapshotRequest>);

#[derive(Debug)]
struct SnapshotRequest {
    map: bool,
    reply: oneshot::Sender<Snapshot>,
}

impl Snapshots {
    /// What the core believes now; `None` when the driver has ended.
    pub async fn take(&self) -> Option<Snapshot> {
        self.ask(true).await
    }

    /// The same with an empty map.
    pub async fn overview(&self) -> Option<Snapshot> {
        self.ask(false).await
    }

    async fn ask(&self, map: bool) -> Option<Snapshot> {
        let (reply, answer) = oneshot::channel();
        self.0.send(SnapshotRequest { map, reply }).await.ok()?;
        answer.await.ok()
    }
}

/// What a driver is made of.
#[derive(Debug)]
pub struct Parts<C, N> {
    /// The core.
    pub core: C,
    /// The way out.
    pub network: N,
    /// The disk.
    pub store: store::Writer,
    /// The journal, its start already written.
    pub journal: Option<journal::Writer>,
    /// The queue's receiving end.
    pub outbox: Outbox,
    /// The queue's sending end, for results of jobs.
    pub inbox: Inbox,
    /// The clock that the core was started with.
    pub clock: Clock,
    /// Jobs run at once.
    pub jobs: usize,
}

/// What a run came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Finished {
    /// The digest of the core's set of facts.
    pub digest: Hash,
    /// Inputs handled.
    pub inputs: u64,
}

/// See the module.
#[derive(Debug)]
pub struct Driver<C, N> {
    parts: Parts<C, N>,
    workers: Arc<Semaphore>,
    views: mpsc::Receiver<SnapshotRequest>,
    journal_flushed: Instant,
    inputs: u64,
    vain: Vain,
    told_vain: vain::Told,
}

impl<C: Core + Send + 'static, N: Network> Driver<C, N> {
    /// A driver, and the way to ask it for snapshots.
    pub fn new(parts: Parts<C, N>) -> (Self, Snapshots) {
        let (sender, views) = mpsc::channel(VIEWS_WAITING);
        let workers = Arc::new(Semaphore::new(parts.jobs.max(1)));
        (
            Self {
                parts,
                workers,
                views,
                journal_flushed: Instant::ZERO,
                inputs: 0,
                vain: Vain::default(),
                told_vain: vain::Told::new(),
            },
            Snapshots(sender),
        )
    }

    /// Runs until `stop` comes, then closes the open submap. All batches handed to the store are on disk when it
    /// returns.
    pub async fn run(mut self, stop: impl Future<Output = ()>) -> Finished {
        let mut stop = std::pin::pin!(stop);
        let mut after_timeout = false;
        self.drain();
        loop {
            let due = self.due(after_timeout);
            let clock = self.parts.clock;
            let input = tokio::select! {
                biased;
                () = &mut stop => break,
                () = clock.reach(due) => Some(Input::Timeout),
                Some(SnapshotRequest { map, reply }) = self.views.recv() => {
                    let core = &self.parts.core;
                    let seen = if map { core.snapshot(clock.now()) } else { core.overview(clock.now()) };
                    if let Some(seen) = seen {
                        let _ = reply.send(seen); // whoever asked may have gone
                    }
                    None
                }
                input = self.parts.outbox.next() => input,
            };
            if let Some(input) = input {
                after_timeout = matches!(input, Input::Timeout);
                self.handle(input);
            }
        }
        self.park().await;
        self.finish()
    }

    /// Closes the open submap and goes on until it is stated and durable, for [`PARKING`] at most.
    async fn park(&mut self) {
        let clock = self.parts.clock;
        let deadline = clock.now().after(PARKING);
        self.handle(Input::Command(Command::Flush));
        while self.parts.core.is_saving() {
            let input = tokio::select! {
                biased;
                () = clock.reach(deadline) => {
                    warn!(?PARKING, "the last submap could not be saved in time");
                    return;
                }
                input = self.parts.outbox.next() => input,
            };
            if let Some(input) = input {
                self.handle(input);
            }
        }
    }

    /// When to send [`Input::Timeout`]. Right after one, not at once: inputs must have their turn.
    fn due(&self, after_timeout: bool) -> Instant {
        let wanted = self.parts.core.poll_timeout().unwrap_or(Instant::MAX);
        if after_timeout { wanted.max(self.parts.clock.now().after(TIMEOUT_STEP)) } else { wanted }
    }

    fn handle(&mut self, input: Input) {
        let now = self.parts.clock.now();
        let input = if self.parts.journal.is_some() { self.journalled(now, input) } else { input };
        self.inputs += 1;
        self.parts.core.handle(now, input);
        self.drain();
    }

    fn drain(&mut self) {
        let mut is_vain = false;
        while let Some(output) = self.parts.core.poll_output() {
            match output {
                Output::Persist { batch, records } => self.parts.store.persist(batch, records),
                Output::Publish { channel, bytes } => self.parts.network.send(Outgoing::Publish(channel, bytes)),
                Output::Ask { query, peer, kind, bytes } => {
                    self.parts.network.send(Outgoing::Ask(query, peer, kind, bytes));
                }
                Output::Answer { token, bytes } => self.parts.network.send(Outgoing::Answer(token, bytes)),
                Output::Run { id, job } => self.start(id, job),
                Output::Event(event) => {
                    tell(&event);
                    if let Event::AlignmentTried { i, j, found, .. } = event {
                        is_vain |= self.vain.note(i.frame, j.frame, found);
                    }
                }
            }
        }
        let seen = if is_vain { self.parts.core.overview(self.parts.clock.now()) } else { None };
        for told in seen.iter().flat_map(|seen| vain::told(&seen.frames, &mut self.told_vain)) {
            info!("{told}");
        }
    }

    fn start(&self, id: JobId, job: Job) {
        let (workers, inbox) = (self.workers.clone(), self.parts.inbox.clone());
        tokio::spawn(async move {
            let Ok(_permit) = workers.acquire_owned().await else { return };
            let kind = job.kind();
            match tokio::task::spawn_blocking(move || job.run()).await {
                Ok(result) => inbox.deliver(Input::JobDone { job: id, result }),
                Err(panic) => error!(job = id.0, kind, %panic, "a job panicked; this is a bug, its result is missing"),
            }
        });
    }

    /// Writes the input down and gives back what the replay will see: a keyframe goes through its written form, so that
    /// both runs handle the same bits.
    fn journalled(&mut self, now: Instant, input: Input) -> Input {
        let stored = StoredInput::from(&input);
        let input = match &stored {
            StoredInput::Keyframe(message) => match Keyframe::try_from((**message).clone()) {
                Ok(keyframe) => Input::Keyframe(keyframe),
                Err(reason) => {
                    warn!(%reason, "keyframe refused: it cannot be written to the journal");
                    return self.journalled(now, Input::KeyframesLost { why: Loss::Unreadable, count: 1 });
                }
            },
            _ => input,
        };
        self.write(&Frame::Input(now, Box::new(stored)));
        if now.since(self.journal_flushed) >= JOURNAL_FLUSH {
            self.journal_flushed = now;
            self.with_journal(journal::Writer::flush);
        }
        input
    }

    fn finish(mut self) -> Finished {
        let digest = self.parts.core.digest();
        self.write(&Frame::End(self.parts.clock.now(), digest));
        self.with_journal(journal::Writer::flush);
        Finished { digest, inputs: self.inputs }
    }

    fn write(&mut self, frame: &Frame) {
        self.with_journal(|journal| journal.write(frame));
    }

    fn with_journal(&mut self, work: impl FnOnce(&mut journal::Writer) -> std::io::Result<()>) {
        if let Some(Err(reason)) = self.parts.journal.as_mut().map(work) {
            error!(%reason, "the journal ends here: it cannot be written");
            self.parts.journal = None;
        }
    }
}

/// Logs an event: WARN for what an operator should look into, ERROR for what needs him.
fn tell(event: &Event) {
    match event {
        Event::Rejected { name, reason, suppressed, .. } => warn!(peer = name, reason, suppressed, "refused input"),
        Event::ReceiveOnly { reason } => error!(reason, "receive-only: nothing new of this robot is written"),
        Event::StoreHealed => warn!("the store works again; nothing was lost"),
        Event::Merged { frame } => info!(%frame, "merged"),
        Event::Unmerged { frame } => warn!(%frame, "no longer merged"),
        Event::PairMoved { a, b, by } => warn!(a, b, by, "a merged pair moved by more than was claimed at 99.9 %"),
        Event::PairUnmerged { a, b, status } => warn!(
            a,
            b,
            now = status.map_or("without any alignment that counts", PairStatus::name),
            "a merged pair is no longer merged"
        ),
        Event::PairsContradict { robots, certain: true } => warn!(
            "what {} states contradicts what others measured of one another: nothing is merged with it",
            robots.join(", ")
        ),
        Event::PairsContradict { robots, certain: false } => warn!(
            "merged pairs contradict one another, and at least one of {} is wrong: nothing is merged on the strength of \
             these pairs",
            robots.join(", ")
        ),
        Event::RobotDoesNotFit { robot, others } => warn!(
            others,
            "what {robot} states does not fit together as others see it: its odometry is wrong, or less certain than it \
             says"
        ),
        Event::EpochsRetired { robot, first, count } => warn!(
            robot,
            first,
            count,
            "it began more epochs than gossip.epochs_per_robot_max or its share of gossip.facts_bytes_max allow: its oldest \
             are gone with their maps; if its SLAM does not restart that often, see that one process alone runs \
             under its key"
        ),
        Event::EpochBegan { frame, reason } => info!(%frame, reason = reason.text(), "a new epoch begins"),
        Event::Condensed { frame, parts, submaps_gone, bytes: [before, after] } => {
            info!(%frame, parts, submaps_gone, before, after, "log condensed");
        }
        Event::ViewsDisagree { frame, misfit_voxels } => warn!(
            %frame,
            misfit_voxels,
            "views of one submap do not fit together: check the camera's intrinsics, units, extrinsics and the odometry"
        ),
        Event::OdometryGap { frame, why } => warn!(
            %frame,
            why = why.name(),
            "keyframes {}: the motion across the gap counts as known to submap.gap_sigma_per_m only; further gaps of this \
             kind are counted in view/status",
            why.text()
        ),
        Event::InputOdd { frame, oddity } => warn!(%frame, "{oddity}"),
        Event::SubmapFinished { submap, keypoints } => info!(%submap, keypoints, "submap finished"),
        Event::AlignmentAgreed { i, j } => info!(%i, %j, "alignment agreed"),
        Event::AlignmentDisputed { i, j } => warn!(%i, %j, "alignment disputed"),
        Event::LookedAgain { i, j, found } => debug!(%i, %j, found, "looked again with further keypoints"),
        Event::AlignmentTried { i, j, expected, found } => debug!(%i, %j, expected, found, "alignment tried"),
        Event::AlignmentProposed { i, j, support } => debug!(%i, %j, support, "alignment proposed"),
    }
}
