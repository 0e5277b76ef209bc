//! Keyframes that were lost and the gaps in the odometry that they left, counted by cause; of each cause the first gap
//! is told.

use super::super::context::Context;
use super::super::io::Event;
use crate::submap::Loss;
use std::collections::{BTreeMap, BTreeSet};

/// Counters since start.
#[derive(Debug, Default)]
pub(in super::super) struct Losses {
    keyframes: BTreeMap<Loss, u64>,
    gaps: u64,
    told: BTreeSet<Loss>,
}

impl Losses {
    pub(super) fn lose(&mut self, why: Loss, count: u64) {
        let lost = self.keyframes.entry(why).or_default();
        *lost = lost.saturating_add(count);
    }

    /// A keyframe was taken whose motion had to be widened.
    pub(super) fn cross(&mut self, context: &mut Context, why: Loss) {
        self.gaps += 1;
        if why == Loss::Unseen {
            self.lose(why, 1); // at least
        }
        if self.told.insert(why) {
            context.event(Event::OdometryGap { frame: context.frame(), why });
        }
    }

    /// Keyframes lost, by cause.
    pub(in super::super) fn keyframes(&self) -> BTreeMap<String, u64> {
        self.keyframes.iter().map(|(why, count)| (why.name().to_owned(), *count)).collect()
    }

    /// Motions that were made less certain.
    pub(in super::super) fn gaps(&self) -> u64 {
        self.gaps
    }
}
