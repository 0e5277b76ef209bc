//! Where robots are over time, as far as their radios care, and who is in reach of whom.

use crate::dice::Dice;
use serde::{Deserialize, Serialize};

/// How often places and contacts are looked at, s.
pub const TICK: f64 = 0.5;
/// Reach of a radio on the grid, in its steps: about eight others.
const GRID_REACH: f64 = 1.65;

/// How the robots lie and move.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "layout", rename_all = "snake_case", deny_unknown_fields)]
pub enum Layout {
    /// All in reach of all.
    #[default]
    Mesh,
    /// A jittered grid, in reach of about eight others.
    Grid,
    /// Random waypoints.
    Waypoints {
        /// Side of the field, m.
        side_m: f64,
        /// Reach of a radio, m.
        range_m: f64,
        /// Speed, m/s.
        speed_m_s: f64,
    },
    /// Two groups, and the last robot moves between them.
    Ferry {
        /// There and back, s.
        period_secs: f64,
    },
}

impl Layout {
    /// Every knob's key, value, bounds and remedy, for the scenario's check.
    pub fn ranges(&self) -> Vec<(&'static str, f64, f64, f64, &'static str)> {
        match *self {
            Self::Mesh | Self::Grid => Vec::new(),
            Self::Waypoints { side_m, range_m, speed_m_s } => vec![
                ("radio.side_m", side_m, 1.0, 1e6, "use 1 to 1e6 m"),
                ("radio.range_m", range_m, 0.1, 1e6, "use 0.1 to 1e6 m"),
                ("radio.speed_m_s", speed_m_s, 0.0, 1000.0, "use 0 to 1000 m/s"),
            ],
            Self::Ferry { period_secs } => {
                vec![("radio.period_secs", period_secs, 1.0, 86_400.0, "use 1 s to a day")]
            }
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
    /// So many robots; places and ways are drawn from the seed.
    pub fn new(layout: Layout, robots: usize, seed: u64) -> Self {
        let mut dice = Dice::new(seed, "field");
        let side = (robots as f64).sqrt().ceil() as usize;
        let robots = (0..robots)
            .map(|k| {
                let mut place = |scale: f64| [scale * dice.uniform(), scale * dice.uniform()];
                match layout {
                    Layout::Grid | Layout::Mesh => {
                        let jitter = place(0.3);
                        let at = [(k % side) as f64 + jitter[0], (k / side) as f64 + jitter[1]];
                        Robot { at, goal: at }
                    }
                    Layout::Waypoints { side_m, .. } => Robot { at: place(side_m), goal: place(side_m) },
                    Layout::Ferry { .. } => {
                        let group = if k < robots / 2 { 0.0 } else { 1000.0 };
                        let at = place(10.0);
                        Robot { at: [at[0] + group, at[1]], goal: at }
                    }
                }
            })
            .collect();
        Self { layout, robots, side, dice }
    }

    /// Moves everyone on by `secs` to the time `now`.
    pub fn drive(&mut self, now: f64, secs: f64) {
        match self.layout {
            Layout::Grid | Layout::Mesh => {}
            Layout::Waypoints { side_m, speed_m_s, .. } => {
                for robot in &mut self.robots {
                    let (dx, dy) = (robot.goal[0] - robot.at[0], robot.goal[1] - robot.at[1]);
                    let (left, step) = (libm::hypot(dx, dy), speed_m_s * secs);
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
            Layout::Grid => GRID_REACH,
            Layout::Mesh => f64::INFINITY,
            Layout::Waypoints { range_m, .. } => range_m,
            Layout::Ferry { .. } => 20.0,
        };
        let half = |p: [f64; 2]| p[0] < self.side as f64 / 2.0;
        let (dx, dy) = (p[0] - q[0], p[1] - q[1]);
        dx * dx + dy * dy < range * range && !(cut && half(p) != half(q))
    }

    /// For each of the robots that `place` names the place of, whom it hears, in order. Two at one place are twins, and
    /// hear each other.
    pub fn reach(&self, place: &[usize]) -> Vec<Vec<usize>> {
        let near = |a: usize, b: usize| a != b && self.linked(place[a], place[b], false);
        (0..place.len()).map(|a| (0..place.len()).filter(|b| near(a, *b)).collect()).collect()
    }

    /// Contact returns: where those who run fall into groups that do not hear one another, each group gets into touch
    /// with the nearest of those that are joined already, the largest group being the first of these.
    pub fn join(&self, place: &[usize], runs: &[bool], reach: &mut [Vec<usize>]) {
        let mut groups = groups(reach, runs);
        groups.sort_by_key(|group| core::cmp::Reverse(group.len()));
        let mut groups = groups.into_iter();
        let Some(mut joined) = groups.next() else { return };
        for group in groups {
            let pairs = group.iter().flat_map(|a| joined.iter().map(move |b| (*a, *b)));
            let apart = |&(a, b): &(usize, usize)| {
                let (p, q) = (self.robots[place[a]].at, self.robots[place[b]].at);
                libm::hypot(p[0] - q[0], p[1] - q[1])
            };
            if let Some((a, b)) = pairs.min_by(|one, other| apart(one).total_cmp(&apart(other))) {
                for (hears, heard) in [(a, b), (b, a)] {
                    let at = reach[hears].partition_point(|other| *other < heard);
                    reach[hears].insert(at, heard);
                }
            }
            joined.extend(group);
        }
    }

    /// Whether links change with time.
    pub fn moves(&self) -> bool {
        !matches!(self.layout, Layout::Grid | Layout::Mesh)
    }
}

/// Those who run, in groups within which messages can go from each to each, over others if need be.
fn groups(reach: &[Vec<usize>], runs: &[bool]) -> Vec<Vec<usize>> {
    let mut waits = runs.to_vec();
    let mut groups = Vec::new();
    for first in 0..reach.len() {
        if !core::mem::take(&mut waits[first]) {
            continue;
        }
        let mut group = vec![first];
        let mut next = 0;
        while let Some(&robot) = group.get(next) {
            next += 1;
            group.extend(reach[robot].iter().filter(|other| core::mem::take(&mut waits[**other])));
        }
        groups.push(group);
    }
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn on_a_grid_all_hear_their_neighbours_and_twins_each_other() {
        let field = Field::new(Layout::Grid, 100, 3);
        let mut place: Vec<usize> = (0..100).collect();
        place.push(44);
        let reach = field.reach(&place);
        for (robot, heard) in reach.iter().enumerate().take(100) {
            let others = heard.iter().filter(|other| **other < 100).count();
            assert!((2..=12).contains(&others), "robot {robot} hears {others}");
            assert!(heard.iter().all(|other| reach[*other].contains(&robot)), "both ways");
        }
        assert!(reach[44].contains(&100) && reach[100].contains(&44));
    }

    #[test]
    fn when_contact_returns_all_who_run_can_be_told_and_no_link_is_lost() {
        let layout = Layout::Waypoints { side_m: 100.0, range_m: 8.0, speed_m_s: 5.0 };
        let mut apart = 0;
        for seed in 0..20 {
            let field = Field::new(layout, 60, seed);
            let place: Vec<usize> = (0..60).collect();
            let runs: Vec<bool> = (0..60).map(|robot| robot % 7 != 3).collect();
            let before = field.reach(&place);
            let mut after = before.clone();
            field.join(&place, &runs, &mut after);
            apart += groups(&before, &runs).len() - 1;
            assert_eq!(groups(&after, &runs).len(), 1, "seed {seed}");
            for (robot, heard) in after.iter().enumerate() {
                assert!(heard.is_sorted() && before[robot].iter().all(|other| heard.contains(other)));
                assert!(heard.iter().all(|other| after[*other].contains(&robot)), "both ways");
                assert!(runs[robot] || *heard == before[robot], "the dead carry nothing");
            }
            let links = |reach: &[Vec<usize>]| reach.iter().map(Vec::len).sum::<usize>();
            assert_eq!(links(&after) - links(&before), 2 * (groups(&before, &runs).len() - 1), "no more than needed");
        }
        assert!(apart > 100, "{apart}");
        let mut none: Vec<Vec<usize>> = Vec::new();
        Field::new(layout, 0, 1).join(&[], &[], &mut none);
    }

    #[test]
    fn drivers_change_their_company_and_stay_on_the_field() {
        let layout = Layout::Waypoints { side_m: 100.0, range_m: 20.0, speed_m_s: 5.0 };
        let mut field = Field::new(layout, 30, 1);
        let place: Vec<usize> = (0..30).collect();
        let before = field.reach(&place);
        (0..100).for_each(|tick| field.drive(f64::from(tick) * TICK, TICK));
        assert_ne!(field.reach(&place), before);
        assert!(field.robots.iter().flat_map(|robot| robot.at).all(|x| (0.0..=100.0).contains(&x)));
    }
}
