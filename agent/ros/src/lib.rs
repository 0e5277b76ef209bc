//! What Merganser reads of ROS, with no ROS installed: its messages ([`msg`]) as ROS 2 and ROS 1 write them ([`wire`]),
//! the bags they are kept in ([`bag`]), the tree of transforms ([`tf`]), and clouds joined with poses by stamp
//! ([`join`]). Everything that is read has a bound ([`limits`]), and what cannot be used is counted or refused by name.

pub mod bag;
pub mod join;
pub mod limits;
pub mod msg;
mod order;
pub mod tf;
pub mod wire;
