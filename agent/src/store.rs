//! The thread that owns the store. Batches that arrive while a commit runs, or within a short wait, share the next
//! commit. When the disk refuses, nothing is given up: the agent is told to be receive-only, and the same batches are
//! tried again, ever more seldom, until they are on disk or the agent ends.

use crate::config::{FileConfig, OnDamage};
use merganser_protocol::agent::io::{Input, Record};
use merganser_protocol::ids::RobotId;
use merganser_store::{CommitError, FileMedium, Opened, Owner, Renewed, Report, Store, StoreError};
use rand::TryRng;
use std::collections::VecDeque;
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};
use tracing::{error, info, warn};

/// Bytes of records after which a commit waits for no more of them.
const COMMIT_BYTES_MAX: usize = 4 << 20;
/// Waits between two tries of a commit that failed: the first, and the longest.
const RETRY: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(10)];
/// 2020-01-01 in seconds since 1970: epochs count from there.
const EPOCH_ORIGIN_SECS: u64 = 1_577_836_800;

/// Where no clock tells which epoch to begin, one is drawn up to here: half a year after 2020, below what any clock that
/// goes gives.
const DRAWN_EPOCH_MAX: u32 = 1 << 24;

/// Damaged records named one by one in the log.
const DAMAGE_TOLD_MAX: usize = 10;

/// Whose store this configuration names.
pub fn owner(config: &FileConfig) -> Owner {
    // A configuration that was checked has the robot in its roster.
    let id = config.roster.get(&config.robot).map_or(RobotId([0; 8]), |key| RobotId::of_key(&key.to_bytes()));
    Owner { swarm: config.swarm.clone(), robot: config.robot.clone(), id }
}

/// Opens the store that a configuration names, and says aloud what was wrong with it. One that is too damaged for that is
/// renewed, if the configuration has it so.
///
/// # Errors
/// [`StoreError`].
pub fn open(config: &FileConfig) -> Result<Opened, StoreError> {
    let medium = FileMedium::new(&config.store.path);
    let loose = medium.clone();
    let now = SystemTime::now();
    let opened = match Store::open(medium.clone(), owner(config), fresh_epoch(now)) {
        Err(StoreError::Damaged { .. }) if config.store.on_damage == OnDamage::Renew => {
            let (written, renewals) = medium.past();
            Store::renew(medium, owner(config), epoch_after(written, renewals, now))?
        }
        opened => opened?,
    };
    tell(&opened.report);
    if let Some(mode) = loose.loose_mode() {
        let store = config.store.path.display();
        warn!("the store {store} has mode {mode:04o}: others may read or change it; run `chmod 600 {store}`");
    }
    Ok(opened)
}

/// The epoch of a store that takes the place of one last written then, after so many renewals. It must be none that was
/// used before, even if the file no longer tells which were, the clock went back when the power did, or another one was
/// renewed a moment ago: a file is written after its epoch began, and renewals are counted.
fn epoch_after(written: Option<SystemTime>, renewals: u64, now: SystemTime) -> u32 {
    let renewals = u32::try_from(renewals).unwrap_or(u32::MAX);
    match fresh_epoch(now).max(written.map_or(0, fresh_epoch)) {
        0 => rand::rngs::SysRng.try_next_u32().map_or(1, |drawn| 1 + drawn % DRAWN_EPOCH_MAX),
        last => last.saturating_add(1).saturating_add(renewals),
    }
}

fn tell(report: &Report) {
    let kept = report.kept.as_ref().map_or("nowhere".into(), |path| path.display().to_string());
    if let Some(Renewed { reason, len, last_epoch, epoch }) = &report.renewed {
        error!(
            reason,
            bytes = len,
            moved_to = kept,
            last_epoch,
            epoch,
            "the store was damaged beyond mending: it was moved aside, and this robot begins a new epoch with an empty one. \
             What it published comes back from peers that hold it; what none of them holds, and its own views of \
             submaps so far, are lost. Check the disk; `merganser store stats` shows what has come back"
        );
    }
    if let Some(schema) = report.migrated_from {
        info!(schema, "the store was migrated from an older schema");
    }
    if report.damaged_count == 0 {
        return;
    }
    for damage in report.damaged.iter().take(DAMAGE_TOLD_MAX) {
        error!(table = damage.table, what = damage.what, why = damage.why, "the store is damaged here");
    }
    let (damaged, entries_lost) = (report.damaged_count, report.entries_lost);
    match &report.unmended {
        None => {
            error!(damaged, entries_lost, kept, "the store was damaged: it was written anew without what was not sound")
        }
        Some(reason) => error!(
            damaged,
            entries_lost,
            reason,
            "the store is damaged and cannot be written anew: make room, until then nothing is stored"
        ),
    }
}

/// A batch of records on its way to the disk.
#[derive(Debug)]
struct Batch {
    number: u64,
    records: Vec<Record>,
}

/// The thread. Dropping it waits until all that was given is written, or has been tried once more in vain.
#[derive(Debug)]
pub struct Writer {
    batches: Option<mpsc::Sender<Batch>>,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// Starts the thread. `done` hears [`Input::Persisted`] after each commit, and [`Input::PersistFailed`] when a
    /// commit fails that did not fail before.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn spawn(store: Store, wait: Duration, done: impl Fn(Input) + Send + 'static) -> std::io::Result<Self> {
        let (sender, batches) = mpsc::channel();
        let queue = Queue { batches, waiting: VecDeque::new(), open: true };
        let thread =
            std::thread::Builder::new().name("store".into()).spawn(move || write_all(store, wait, queue, done))?;
        Ok(Self { batches: Some(sender), thread: Some(thread) })
    }

    /// Hands over a batch; its fate is told to `done`. How many are on their way is the core's to bound.
    pub fn persist(&self, number: u64, records: Vec<Record>) {
        if let Some(batches) = &self.batches {
            let _ = batches.send(Batch { number, records }); // the thread ends only when we do
        }
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.batches = None;
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            error!("the store's thread panicked; this is a bug");
        }
    }
}

/// Seconds since 2020; a clock that stands before, or beyond 2156, gives 0 (the core then counts on from what peers
/// know of it).
pub fn fresh_epoch(now: SystemTime) -> u32 {
    let secs = now.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_secs());
    u32::try_from(secs.saturating_sub(EPOCH_ORIGIN_SECS)).unwrap_or(0)
}

fn write_all(mut store: Store, wait: Duration, mut queue: Queue, done: impl Fn(Input)) {
    while queue.fill(wait) {
        let mut pause = RETRY[0];
        let mut told = false;
        while let Err(reason) = store.commit(queue.group().flat_map(|batch| &batch.records)) {
            if !told {
                let batch = queue.waiting.front().map_or(0, |batch| batch.number);
                done(Input::PersistFailed { batch, reason: reason.to_string() });
            }
            told = true;
            if !queue.open {
                let batches = queue.waiting.len();
                error!(%reason, batches, "the agent ends with facts that the disk refuses; they are lost here");
                return;
            }
            warn!(%reason, ?pause, advice = advice(&reason), "the store fails; the same is tried again");
            queue.rest(pause);
            pause = (2 * pause).min(RETRY[1]);
        }
        done(Input::Persisted { up_to: queue.take_group() });
    }
}

fn advice(reason: &CommitError) -> &'static str {
    match reason {
        CommitError::Full(_) => "make room on the disk of store.path",
        CommitError::Failed(_) => "check the disk of store.path; see the kernel's log",
        CommitError::Conflict(_) => "this is a bug; run `merganser store verify` and report what it says",
    }
}

/// Batches to come, and those taken out of the channel already.
struct Queue {
    batches: mpsc::Receiver<Batch>,
    waiting: VecDeque<Batch>,
    /// More may come.
    open: bool,
}

impl Queue {
    /// Waits for a batch, and then for those that come within `wait` of it; false when there will be none.
    fn fill(&mut self, wait: Duration) -> bool {
        if self.waiting.is_empty() {
            match self.batches.recv() {
                Ok(batch) => self.waiting.push_back(batch),
                Err(mpsc::RecvError) => return false,
            }
        }
        self.take_until(Instant::now() + wait, |queue| queue.weight() < COMMIT_BYTES_MAX);
        true
    }

    /// Lets time pass; what comes meanwhile waits.
    fn rest(&mut self, pause: Duration) {
        self.take_until(Instant::now() + pause, |_| true);
    }

    fn take_until(&mut self, deadline: Instant, more: impl Fn(&Self) -> bool) {
        while self.open && more(self) {
            match self.batches.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(batch) => self.waiting.push_back(batch),
                Err(RecvTimeoutError::Timeout) => break,
                Err(RecvTimeoutError::Disconnected) => self.open = false,
            }
        }
    }

    /// The batches that share the next commit: the first, and more up to [`COMMIT_BYTES_MAX`].
    fn group(&self) -> impl Iterator<Item = &Batch> {
        let mut bytes = 0;
        self.waiting.iter().take_while(move |batch| {
            let fits = bytes < COMMIT_BYTES_MAX;
            bytes += weight(batch);
            fits
        })
    }

    /// The group is durable: its last number.
    fn take_group(&mut self) -> u64 {
        let len = self.group().count();
        self.waiting.drain(..len).next_back().map_or(0, |batch| batch.number)
    }

    fn weight(&self) -> usize {
        self.waiting.iter().map(weight).sum()
    }
}

fn weight(batch: &Batch) -> usize {
    let bytes = |record: &Record| match record {
        Record::Entry { bytes, .. } | Record::Blob { bytes, .. } | Record::Private { bytes, .. } => bytes.len(),
        Record::Fork { proof, .. } => proof.iter().map(Vec::len).sum(),
        // A few bytes each.
        Record::EpochClosed { .. }
        | Record::Replaced { .. }
        | Record::Retired { .. }
        | Record::Session { .. }
        | Record::Refused { .. } => 0,
    };
    batch.records.iter().map(bytes).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn epochs_count_from_2020_and_never_fail() {
        let at = |secs| fresh_epoch(SystemTime::UNIX_EPOCH + Duration::from_secs(secs));
        assert_eq!((at(0), at(EPOCH_ORIGIN_SECS), at(EPOCH_ORIGIN_SECS + 9)), (0, 0, 9));
        assert_eq!(at(1 << 40), 0);
    }

    #[test]
    fn a_renewed_store_begins_after_the_old_one_was_written_whatever_the_clock_says() {
        let at = |secs| SystemTime::UNIX_EPOCH + Duration::from_secs(EPOCH_ORIGIN_SECS + secs);
        assert_eq!(epoch_after(Some(at(50)), 0, at(90)), 91);
        assert_eq!(epoch_after(Some(at(90)), 0, at(50)), 91, "the clock went back");
        assert_eq!((epoch_after(None, 0, at(50)), epoch_after(None, 1, at(50))), (51, 52), "in one second");
        let stopped = SystemTime::UNIX_EPOCH;
        let drawn: std::collections::BTreeSet<u32> = (0..20).map(|_| epoch_after(Some(stopped), 3, stopped)).collect();
        assert!(drawn.len() > 15 && drawn.iter().all(|epoch| (1..=DRAWN_EPOCH_MAX).contains(epoch)), "{drawn:?}");
        assert!(DRAWN_EPOCH_MAX < fresh_epoch(at(365 * 86_400)), "below all that clocks give");
    }
}
