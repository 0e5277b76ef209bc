//! The set of facts one robot holds: a signed, hash-chained log per frame (DESIGN §3, §4). It decides what is taken in,
//! what is advertised, and what a neighbour lacks.
//!
//! - A log is held as a prefix without holes. An entry that comes before its predecessor waits in a bounded buffer that
//!   is neither stored nor advertised ([`Ingested::Early`]).
//! - Only entries marked durable are advertised, counted, hashed or served.
//! - Two histories of one log are a fork: the log is quarantined on every robot that sees the proof (two signed entries
//!   that contradict each other), its facts vanish from [`Replica::facts`], and the proof is passed on.
//! - Equal sets of durable entries have equal [`Replica::have`], [`Replica::root`] and [`Replica::digest`], whatever
//!   the order, duplication or batching in which they came.

mod append;
mod delta;
#[cfg(test)]
mod floor_tests;
mod fork;
mod have;
mod log;
mod restore;
mod set;
mod shares;
#[cfg(test)]
mod shares_tests;
#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;

pub use append::AppendError;
pub use fork::ForkProof;
pub use have::{Have, VectorForm};
pub use restore::{Damage, RestoreError};
pub use set::{EARLY_PER_ROBOT_MAX, IngestError, Ingested, MEMBERS_MAX, Replica, RosterError};
