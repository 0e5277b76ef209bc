//! Where the robots are and who hears whom.

use crate::dice::Dice;
use clap::ValueEnum;

/// How often places and contacts are looked at, s.
pub const TICK: f64 = 0.5;

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

/// How the robots lie and move.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Layout {
    /// A jittered grid, in reach of about eight others.
    Grid,
    /// All in reach of all.
    Mesh,
    /// Random waypoints: side of the field, radio range, speed.
    Waypoints { side_m: f64, range_m: f64, speed_m_s: f64 },
    /// Two groups, and the last robot moves between them with this period.
    Ferry { period_secs: f64 },
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

/// The robots' places over time.
pub struct Field {
    layout: Layout,
    robots: Vec<Robot>,
    side: usize,
    dice: Dice,
}

#[derive(Clone, Copy)]
struct Robot {
    at: [f64; 2],
    goal: [f64; 2],
}

impl Field {
    pub fn new(world: &World, seed: u64) -> Self {
        let mut dice = Dice::new(seed, "field");
        let side = (world.robots as f64).sqrt().ceil() as usize;
        let robots = (0..world.robots)
            .map(|k| {
                let mut place = |scale: f64| [scale * dice.uniform(), scale * dice.uniform()];
                match world.layout {
                    Layout::Grid | Layout::Mesh => {
                        let jitter = place(0.3);
                        let at = [(k % side) as f64 + jitter[0], (k / side) as f64 + jitter[1]];
                        Robot { at, goal: at }
                    }
                    Layout::Waypoints { side_m, .. } => Robot { at: place(side_m), goal: place(side_m) },
                    Layout::Ferry { .. } => {
                        let group = if k < world.robots / 2 { 0.0 } else { 1000.0 };
                        let at = place(10.0);
                        Robot { at: [at[0] + group, at[1]], goal: at }
                    }
                }
            })
            .collect();
        Self { layout: world.layout, robots, side, dice }
    }

    /// Moves everyone on by `secs` to the time `now`.
    pub fn drive(&mut self, now: f64, secs: f64) {
        match self.layout {
            Layout::Grid | Layout::Mesh => {}
            Layout::Waypoints { side_m, speed_m_s, .. } => {
                for robot in &mut self.robots {
                    let (dx, dy) = (robot.goal[0] - robot.at[0], robot.goal[1] - robot.at[1]);
                    let (left, step) = (dx.hypot(dy), speed_m_s * secs);
                    if left <= step {
                        robot.at = robot.goal;
                        robot.goal = [side_m * self.dice.uniform(), side_m * self.dice.uniform()];
                    } else {
                        robot.at = [robot.at[0] + dx * step / left, robot.at[1] + dy * step / left];
                    }
                }
            }
            Layout::Ferry { period_secs } => {
                // A fifth of the time at each end.
                let phase = (now / period_secs).fract();
                let along = match phase {
                    p if p < 0.2 => 0.0,
                    p if p < 0.5 => (p - 0.2) / 0.3,
                    p if p < 0.7 => 1.0,
                    p => 1.0 - (p - 0.7) / 0.3,
                };
                if let Some(ferry) = self.robots.last_mut() {
                    ferry.at = [1000.0 * along + 5.0, 5.0];
                }
            }
        }
    }

    /// Whether `a` and `b` hear each other; `cut`: the halves of the grid do not.
    pub fn linked(&self, a: usize, b: usize, cut: bool) -> bool {
        let (p, q) = (self.robots[a].at, self.robots[b].at);
        let range = match self.layout {
            Layout::Grid => 1.65,
            Layout::Mesh => f64::INFINITY,
            Layout::Waypoints { range_m, .. } => range_m,
            Layout::Ferry { .. } => 20.0,
        };
        let half = |p: [f64; 2]| p[0] < self.side as f64 / 2.0;
        let (dx, dy) = (p[0] - q[0], p[1] - q[1]);
        dx * dx + dy * dy < range * range && !(cut && half(p) != half(q))
    }

    /// Whether links change with time.
    pub fn moves(&self) -> bool {
        !matches!(self.layout, Layout::Grid | Layout::Mesh)
    }
}
