//! What every layer of the core knows: names and ids, instants and stamps, the options of a robot, and the words in
//! which layers tell one another what became of a thing. Nothing here decides anything.

pub mod config;
pub mod ids;
pub mod kinds;
pub mod time;
