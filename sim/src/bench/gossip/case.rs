//! The worlds that gossip is measured in.

use crate::field::Layout;
use clap::ValueEnum;

/// What happens to the swarm.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Case {
    /// 100 robots on a field, 10 % loss; split in halves for 3 minutes while all write facts, then healed
    Split,
    /// The same at 30 % loss
    SplitLossy,
    /// As split, but every robot hears every other of its half
    Mesh,
    /// 1,000 robots drive about with short radios, 10 % loss; each has written three facts
    Mobile,
    /// Two groups of 20 out of reach of each other, and one robot that drives between them every 200 s
    Ferry,
    /// 100 robots that hold the same facts, nothing new, for 20 minutes
    Steady,
}

/// A kind of world.
#[derive(Clone, Debug)]
pub struct World {
    pub name: &'static str,
    pub robots: usize,
    /// Share of messages lost, each way.
    pub loss: f64,
    pub layout: Layout,
    /// Facts each robot writes at the start.
    pub facts: u32,
    /// Mean time between further facts of one robot, until `heal_at`; 0: none.
    pub fact_every_secs: f64,
    /// When the cut heals; before, halves do not hear each other. 0: no cut.
    pub heal_at: f64,
    /// Given up then.
    pub until: f64,
}

impl Case {
    /// Those measured when none is named.
    pub fn usual() -> Vec<Self> {
        vec![Self::Split, Self::SplitLossy, Self::Ferry, Self::Steady]
    }

    /// Its world.
    pub fn world(self) -> World {
        let split = World {
            name: "split",
            robots: 100,
            loss: 0.1,
            layout: Layout::Grid,
            facts: 1,
            fact_every_secs: 10.0,
            heal_at: 180.0,
            until: 600.0,
        };
        match self {
            Self::Split => split,
            Self::SplitLossy => World { name: "split, lossy", loss: 0.3, ..split },
            Self::Mesh => World { name: "mesh", layout: Layout::Mesh, ..split },
            Self::Mobile => World {
                name: "mobile",
                robots: 1000,
                layout: Layout::Waypoints { side_m: 2000.0, range_m: 50.0, speed_m_s: 2.0 },
                facts: 3,
                fact_every_secs: 0.0,
                heal_at: 0.0,
                until: 2000.0,
                ..split
            },
            Self::Ferry => World {
                name: "ferry",
                robots: 41,
                layout: Layout::Ferry { period_secs: 200.0 },
                facts: 10,
                fact_every_secs: 0.0,
                heal_at: 0.0,
                until: 2000.0,
                ..split
            },
            Self::Steady => World { name: "steady", fact_every_secs: 0.0, heal_at: 0.0, until: 1260.0, ..split },
        }
    }
}
