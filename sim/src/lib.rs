//! The Merganser core on a virtual network, in virtual time.

pub mod dice;
pub mod faults;
pub mod network;
pub mod queue;
pub mod record;
pub mod scenario;
pub mod stage;
pub mod world;
