//! Bands of seeds, as they are written on a command line, and what is done for each of them.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError, mpsc};

/// Seeds from the first up to, but without, the second.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Band(pub u64, pub u64);

impl Band {
    /// Does `work` for every seed, `jobs` of them at once, and `tell`s of each in their order, as soon as all before it
    /// are done. A job whose work gives nothing begins no other.
    pub fn for_each<T: Send>(self, jobs: usize, work: impl Fn(u64) -> Option<T> + Sync, mut tell: impl FnMut(u64, T)) {
        let seeds = Mutex::new(self.0..self.1);
        let next = || seeds.lock().unwrap_or_else(PoisonError::into_inner).next();
        let (done, finished) = mpsc::channel();
        std::thread::scope(|scope| {
            for _ in 0..jobs {
                let (done, next, work) = (done.clone(), &next, &work);
                scope.spawn(move || {
                    while let Some((seed, result)) = next().and_then(|seed| Some((seed, work(seed)?))) {
                        if done.send((seed, result)).is_err() {
                            return;
                        }
                    }
                });
            }
            drop(done);
            let mut waiting = BTreeMap::new();
            let mut due = self.0;
            for (seed, result) in finished {
                waiting.insert(seed, result);
                while let Some(result) = waiting.remove(&due) {
                    tell(due, result);
                    due += 1;
                }
            }
            // Behind a seed that gave nothing.
            waiting.into_iter().for_each(|(seed, result)| tell(seed, result));
        });
    }
}

/// As many as there are processors, if `asked` for no other number.
pub fn jobs(asked: Option<u16>) -> usize {
    asked.map_or_else(|| std::thread::available_parallelism().map_or(1, usize::from), usize::from)
}

/// Reads `FIRST..END`.
///
/// # Errors
/// What to write instead.
pub fn parse_band(text: &str) -> Result<Band, String> {
    let mend = || format!("{text:?} is no band of seeds: write 0..64");
    let (first, end) = text.split_once("..").ok_or_else(mend)?;
    let band = Band(first.parse().map_err(|_| mend())?, end.parse().map_err(|_| mend())?);
    if band.0 < band.1 { Ok(band) } else { Err(mend()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_seed_is_told_once_and_in_order_and_none_is_begun_after_nothing() {
        for jobs in [1, 2, 7] {
            let mut told = Vec::new();
            // The first ones take longest.
            let work = |seed: u64| {
                std::thread::sleep(std::time::Duration::from_millis(20_u64.saturating_sub(seed)));
                Some(seed * seed)
            };
            Band(3, 23).for_each(jobs, work, |seed, square| told.push((seed, square)));
            assert_eq!(told, (3..23).map(|seed| (seed, seed * seed)).collect::<Vec<_>>(), "{jobs} jobs");
        }
        let mut told = Vec::new();
        Band(u64::MAX - 4, u64::MAX).for_each(1, |seed| (seed % 2 == 0).then_some(()), |seed, ()| told.push(seed));
        assert!(told.is_empty(), "the first gave nothing");
        Band(u64::MAX - 1, u64::MAX).for_each(3, Some, |seed, _| told.push(seed));
        assert_eq!(told, [u64::MAX - 1]);
    }

    #[test]
    fn bands_have_a_first_and_an_end_beyond_it() {
        assert_eq!(parse_band("1000..1064"), Ok(Band(1000, 1064)));
        assert_eq!(parse_band("0..1"), Ok(Band(0, 1)));
        for bad in ["", "5", "5..", "..5", "5..5", "6..5", "a..b", "-1..4", "0..99999999999999999999"] {
            assert!(parse_band(bad).unwrap_err().contains("write 0..64"), "{bad}");
        }
    }
}
