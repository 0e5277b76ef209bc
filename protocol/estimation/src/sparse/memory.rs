//! What a factorisation will take, counted from the pattern alone: decides which maps are too densely tied to be
//! solved.
//!
//! Where everything is tied to everything, the factor is a dense matrix: that of 5,000 poses takes 7 GB. A process that
//! asks for more than there is gets killed, whoever sent the map; so the bytes are counted before any are asked for.
//! Counting saturates, and what saturates is refused.

use super::order::Elimination;
use crate::solve_error::SolveError;

/// Bytes that solving one component may take: its factor twice (the inverse is drawn from panels of its own, which may
/// be as many), with the updates on the stack or what the inverse keeps and works on beside. For whoever solves a graph
/// of his own; an agent, whose map others write, takes less ([`solve_map`](crate::solve_map)).
pub const FACTOR_BYTES_MAX: u64 = 4 << 30;

/// So many numbers are kept for each of the factor.
const COPIES: u64 = 2;

/// Numbers that an elimination is made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Needs {
    /// Of the factor.
    pub(super) values: u64,
    /// Of the updates that wait for their parents, at most at a time.
    pub(super) updates: u64,
    /// Of the largest square and panel that the inverse takes beside.
    pub(super) inverse: u64,
    /// Of the blocks of the inverse that are kept: at most those that `H` has.
    pub(super) blocks: u64,
}

impl Needs {
    /// What an elimination of variables of these sizes will take, given each one's neighbours of smaller index.
    pub(super) fn of(elimination: &Elimination, sizes: &[usize], below: &[Vec<usize>]) -> Self {
        let Elimination { order, supernodes } = elimination;
        let scalars =
            |places: &mut dyn Iterator<Item = usize>| -> u64 { places.map(|place| sizes[order[place]] as u64).sum() };
        let mut needs = Self::default();
        for (&size, neighbours) in sizes.iter().zip(below) {
            let row = neighbours.iter().fold(size as u64, |sum, &other| sum.saturating_add(sizes[other] as u64));
            needs.blocks = needs.blocks.saturating_add(row.saturating_mul(size as u64));
        }
        let mut given = vec![0; supernodes.len()];
        let mut waiting = 0u64;
        for (k, node) in supernodes.iter().enumerate() {
            let columns = scalars(&mut node.pivots.clone());
            let depth = scalars(&mut node.below.iter().copied());
            let (panel, square) = ((columns + depth).saturating_mul(columns), depth.saturating_mul(depth));
            needs.values = needs.values.saturating_add(panel);
            needs.updates = needs.updates.max(waiting.saturating_add(square));
            needs.inverse = needs.inverse.max(panel.saturating_add(square));
            waiting = waiting.saturating_sub(given[k]).saturating_add(square);
            if let Some(parent) = node.parent {
                given[parent] = square.saturating_add(given[parent]);
            }
        }
        needs
    }

    /// Bytes in all, at most at a time.
    pub(super) fn bytes(self) -> u64 {
        let beside = self.updates.max(self.inverse.saturating_add(self.blocks));
        bytes(self.values.saturating_mul(COPIES).saturating_add(beside))
    }
}

/// Bytes of so many numbers.
pub(super) fn bytes(numbers: u64) -> u64 {
    numbers.saturating_mul(size_of::<f64>() as u64)
}

/// Refuses what takes more than `limit` bytes.
///
/// # Errors
/// [`SolveError::TooDense`].
pub(super) fn within(bytes: u64, limit: u64) -> Result<(), SolveError> {
    if bytes <= limit { Ok(()) } else { Err(SolveError::TooDense { bytes, limit }) }
}

/// Counts a factor column by column while its structure is still being found, so that not even that outgrows the limit.
pub(super) struct Count {
    limit: u64,
    numbers: u64,
}

impl Count {
    pub(super) fn new(limit: u64) -> Self {
        Self { limit, numbers: 0 }
    }

    /// A variable of `size` scalars above `below` others.
    ///
    /// # Errors
    /// [`SolveError::TooDense`] with the bytes so far.
    pub(super) fn add(&mut self, size: usize, below: usize) -> Result<(), SolveError> {
        let (size, below) = (size as u64, below as u64);
        self.numbers = self.numbers.saturating_add(size.saturating_mul(size.saturating_add(below)));
        within(bytes(self.numbers.saturating_mul(COPIES)), self.limit)
    }
}

/// Makes `values` so many zeros.
///
/// # Errors
/// [`SolveError::OutOfMemory`] instead of the process's end.
pub(crate) fn zeroed(values: &mut Vec<f64>, count: usize) -> Result<(), SolveError> {
    values.clear();
    values.try_reserve_exact(count).map_err(|_| SolveError::OutOfMemory)?;
    values.resize(count, 0.0);
    Ok(())
}
