//! The Merganser core on a virtual network, in virtual time.

pub mod dice;
pub mod queue;
pub mod world;
