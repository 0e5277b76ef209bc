//! Blobs by their address. The oldest goes first: the two blobs of one look are fetched one after the other, and
//! neither must displace the other.

use crate::ids::Hash;
use std::collections::BTreeMap;

/// See the module. The caller holds the limit.
#[derive(Debug)]
pub struct Recent<T> {
    kept: BTreeMap<Hash, (u64, T)>,
    count: u64,
}

impl<T> Default for Recent<T> {
    fn default() -> Self {
        Self { kept: BTreeMap::new(), count: 0 }
    }
}

impl<T> Recent<T> {
    /// Keeps one; what is there already is as old as it was.
    pub fn insert(&mut self, hash: Hash, one: T) {
        self.count += 1;
        self.kept.entry(hash).or_insert((self.count, one));
    }

    /// What is kept at an address.
    pub fn get(&self, hash: Hash) -> Option<&T> {
        self.kept.get(&hash).map(|(_, one)| one)
    }

    /// How many are kept.
    pub fn len(&self) -> usize {
        self.kept.len()
    }

    /// Drops the oldest of those that may go. False if none may.
    pub fn drop_oldest(&mut self, may_go: impl Fn(&Hash) -> bool) -> bool {
        let ages = self.kept.iter().filter(|(hash, _)| may_go(hash)).map(|(hash, (age, _))| (*age, *hash));
        let oldest = ages.min();
        oldest.is_some_and(|(_, hash)| self.kept.remove(&hash).is_some())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_that_may_go_goes() {
        let address = |k: u8| Hash([k; 32]);
        let mut recent = Recent::default();
        [7, 1, 5, 3, 7].into_iter().for_each(|k| recent.insert(address(k), k));
        assert_eq!((recent.len(), recent.get(address(1)), recent.get(address(2))), (4, Some(&1), None));
        assert!(recent.drop_oldest(|hash| *hash != address(7)));
        assert_eq!((recent.len(), recent.get(address(1))), (3, None));
        assert!(recent.drop_oldest(|_| true));
        assert_eq!((recent.len(), recent.get(address(7))), (2, None));
        assert!(!recent.drop_oldest(|_| false));
    }
}
