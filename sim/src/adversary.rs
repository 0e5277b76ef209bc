//! Members that have a valid key and lie with it, each in one way. What they state is well-formed and signed: only the
//! others' measurements speak against it.

use serde::{Deserialize, Serialize};

/// How a member lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Adversary {
    /// Restates the clouds of others as its own, at places of its own.
    Mirror,
    /// Its odometry has it drive farther than it does, and says that it does not err.
    Forger,
    /// Its clouds move slowly away from where it saw them.
    Shifter,
    /// What it states is true, but a hundred times less certain than it says.
    Boaster,
    /// Agrees to the same lies about their relation with others that collude.
    Colluder,
}

impl Adversary {
    /// All ways.
    pub const ALL: [Self; 5] = [Self::Mirror, Self::Forger, Self::Shifter, Self::Boaster, Self::Colluder];

    /// By what its odometry stretches the way.
    pub fn stretch(self) -> f64 {
        if self == Self::Forger { 1.3 } else { 1.0 }
    }

    /// By what it scales the variances of its odometry.
    pub fn claims(self) -> f64 {
        if matches!(self, Self::Forger | Self::Boaster) { 1e-4 } else { 1.0 }
    }

    /// How much farther each of its clouds lies from where it was seen than the one before, m.
    pub fn shift_m(self) -> f64 {
        if self == Self::Shifter { 0.3 } else { 0.0 }
    }
}
