//! A robot's disk: the store that real agents use, over a disk in memory that fails as it is told. What waits for one
//! commit shares it, as in the agent's own writer; a commit that the disk refuses is tried again, ever more seldom.

use core::time::Duration;
use merganser_protocol::agent::io::Record;
use merganser_store::simulated::{Cut, Disk, Picture};
use merganser_store::{CommitError, Opened, Owner, StoreError};
use std::collections::VecDeque;

/// Waits between two tries of a commit that failed: the first, and the longest.
const RETRY: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(10)];

/// One robot's disk.
#[derive(Debug)]
pub struct Store {
    disk: Disk,
    owner: Owner,
    open: Option<merganser_store::Store>,
    waiting: VecDeque<(u64, Vec<Record>)>,
    pause: Duration,
    refusing: bool,
    /// A commit is on its way.
    pub busy: bool,
}

/// What became of a commit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Committed {
    /// Nothing waited.
    Nothing,
    /// Everything up to this batch is durable; it had been refused before.
    Durable(u64, bool),
    /// The disk refuses: from which batch on, why, whether that is news, and when to try again.
    Refused(u64, String, bool, Duration),
    /// The store holds another entry in this place: a sequence number was used twice.
    Conflict(String),
    /// The power went in the middle of it.
    PowerGone,
}

impl Store {
    /// An empty disk.
    pub fn new(owner: Owner) -> Self {
        Self {
            disk: Disk::default(),
            owner,
            open: None,
            waiting: VecDeque::new(),
            pause: RETRY[0],
            refusing: false,
            busy: false,
        }
    }

    /// Opens it, as a process does at its start.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn boot(&mut self, fresh_epoch: u32) -> Result<(Vec<Record>, u32, merganser_store::Report), StoreError> {
        self.open = None;
        let Opened { store, restored, report } =
            merganser_store::Store::open(self.disk.clone(), self.owner.clone(), fresh_epoch)?;
        self.open = Some(store);
        Ok((restored.records, restored.fresh_epoch, report))
    }

    /// Takes a batch that is not durable yet.
    pub fn accept(&mut self, batch: u64, records: Vec<Record>) {
        self.waiting.push_back((batch, records));
    }

    /// Commits all that waits.
    pub fn commit(&mut self) -> Committed {
        let (Some(store), Some(&(first, _)), Some(&(last, _))) =
            (&mut self.open, self.waiting.front(), self.waiting.back())
        else {
            return Committed::Nothing;
        };
        match store.commit(self.waiting.iter().flat_map(|(_, records)| records)) {
            Ok(()) => {
                self.waiting.clear();
                self.pause = RETRY[0];
                Committed::Durable(last, core::mem::take(&mut self.refusing))
            }
            Err(_) if self.disk.with_faults(|faults| faults.died) => Committed::PowerGone,
            Err(error @ CommitError::Conflict(_)) => Committed::Conflict(error.to_string()),
            Err(error) => {
                let pause = self.pause;
                self.pause = (2 * pause).min(RETRY[1]);
                let news = !core::mem::replace(&mut self.refusing, true);
                Committed::Refused(first, error.to_string(), news, pause)
            }
        }
    }

    /// The process is killed; the machine runs on. Returns the number of records that were waiting.
    pub fn crash(&mut self) -> usize {
        self.disk.let_go();
        self.forget()
    }

    /// The power goes.
    pub fn cut(&mut self, seed: u64) -> (usize, Cut) {
        let cut = self.disk.cut(seed);
        (self.forget(), cut)
    }

    fn forget(&mut self) -> usize {
        self.open = None;
        (self.pause, self.refusing, self.busy) = (RETRY[0], false, false);
        self.disk.with_faults(|faults| faults.dies_after = None);
        self.waiting.drain(..).map(|(_, records)| records.len()).sum()
    }

    /// The disk is replaced by an empty one.
    pub fn wipe(&mut self) {
        self.forget();
        self.disk.wipe();
    }

    /// What is on it for sure.
    pub fn picture(&self) -> Picture {
        self.disk.picture()
    }

    /// An image is put on it.
    pub fn restore(&mut self, picture: &Picture) {
        self.forget();
        self.disk.restore(picture);
    }

    /// The disk itself.
    pub fn disk(&self) -> &Disk {
        &self.disk
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::ids::{Hash, Name, RobotId};

    fn blob(byte: u8) -> Record {
        Record::Blob { hash: Hash::of(&[byte]), bytes: vec![byte] }
    }

    fn store() -> Store {
        let name = |text| Name::new(text).unwrap();
        Store::new(Owner { swarm: name("sim"), robot: name("alpha"), id: RobotId([1; 8]) })
    }

    #[test]
    fn only_what_was_committed_survives() {
        let mut store = store();
        assert_eq!(store.boot(3).unwrap().0, []);
        store.accept(1, vec![blob(1)]);
        assert_eq!(store.commit(), Committed::Durable(1, false));
        store.accept(2, vec![blob(2), blob(3)]);
        assert_eq!(store.crash(), 2);
        assert_eq!(store.commit(), Committed::Nothing);
        assert_eq!(store.boot(3).unwrap().0, [blob(1)]);
        assert_eq!(store.cut(1).0, 0);
        assert_eq!(store.boot(3).unwrap().0, [blob(1)]);
        store.wipe();
        assert!(store.boot(3).unwrap().0.is_empty());
    }

    #[test]
    fn what_was_refused_comes_with_what_follows_it() {
        let mut store = store();
        store.boot(3).unwrap();
        store.disk().with_faults(|faults| faults.full = true);
        store.accept(1, vec![blob(1)]);
        assert!(matches!(store.commit(), Committed::Refused(1, _, true, _)));
        store.accept(2, vec![blob(2)]);
        assert!(matches!(store.commit(), Committed::Refused(1, _, false, pause) if pause > RETRY[0]));
        store.disk().with_faults(|faults| faults.full = false);
        assert_eq!(store.commit(), Committed::Durable(2, true));
        store.cut(5);
        assert_eq!(store.boot(3).unwrap().0.len(), 2);
    }

    #[test]
    fn power_can_go_in_the_middle_of_a_commit() {
        let mut store = store();
        store.boot(3).unwrap();
        store.disk().with_faults(|faults| faults.dies_after = Some(2));
        store.accept(1, vec![blob(1)]);
        assert_eq!(store.commit(), Committed::PowerGone);
        store.cut(5);
        assert!(store.boot(3).unwrap().0.is_empty());
    }
}
