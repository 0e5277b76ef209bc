//! What was handed to one robot's disk and is not on it yet: the memory that checks of durable things share.

/// Things by the batch they went out with.
#[derive(Debug)]
pub(super) struct Pending<T>(Vec<(u64, T)>);

impl<T> Default for Pending<T> {
    fn default() -> Self {
        Self(Vec::new())
    }
}

impl<T> Pending<T> {
    /// These went out with this batch.
    pub fn hand_over(&mut self, batch: u64, things: impl IntoIterator<Item = T>) {
        self.0.extend(things.into_iter().map(|thing| (batch, thing)));
    }

    /// All batches up to this one are on disk: what came with them, in the order it was handed over.
    pub fn durable(&mut self, batch: u64) -> Vec<T> {
        self.0.extract_if(.., |(number, _)| *number <= batch).map(|(_, thing)| thing).collect()
    }

    /// The process died, and these with it.
    pub fn lose(&mut self) {
        self.0.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_was_handed_over_and_did_not_die_becomes_durable() {
        let mut pending = Pending::default();
        pending.hand_over(1, ["a", "b"]);
        pending.hand_over(2, ["c"]);
        assert_eq!(pending.durable(1), ["a", "b"]);
        assert!(pending.durable(1).is_empty());
        pending.lose();
        assert!(pending.durable(2).is_empty());
    }
}
