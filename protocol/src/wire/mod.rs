//! What travels and what is stored: framed, versioned, strictly decoded messages, and facts parsed once into checked
//! domain types. Form is checked here (limits, whole input, canonical bytes, finite values, positive definiteness);
//! who may say what, and in which order, is the replica's business.

pub mod beacon;
mod condensed;
pub mod entry;
pub mod fact;
pub mod frame;
#[cfg(test)]
mod golden;
pub mod have;
mod json;
mod lattice;
pub mod life;
pub mod limits;
#[cfg(test)]
mod limits_tests;
pub mod messages;
pub mod payload;
pub mod pose;
pub mod roster;
#[cfg(test)]
pub(crate) mod roster_tests;
#[cfg(test)]
pub(crate) mod samples;
pub mod slice;
#[cfg(test)]
mod tests;

pub use beacon::{Beacon, BeaconContent};
pub use entry::{Entry, EntryBytes, EntryContent, EntryError, SwarmTag};
pub use fact::Fact;
pub use frame::WireError;
pub use have::{HaveRoot, HaveVector, Head, Members};
pub use life::{BeaconAge, Life, LifeContent, Nonce};
pub use messages::{AlignStatus, Delta, Message};
pub use payload::FactError;
pub use roster::{Roster, RosterContent, RosterHead};
