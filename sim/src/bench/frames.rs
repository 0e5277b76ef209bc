//! The frame-level consensus on seeded worlds: MATH §5's table with refusals, wrong merges and the covariance's
//! honesty.

use merganser_protocol::estimate::frames::world::{Draw, SimWorld, World};
use merganser_protocol::estimate::frames::{
    FrameConsensusConfig, FrameOutcome, PairAlignment, SimMeasurement, align_frames, align_frames_sim,
};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se2, SimWithCovariance, chi2, se2};
use nalgebra::SVector;
use std::fmt::Write;
use std::ops::Range;

/// What a cell is measured for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Goal {
    /// At least this share of right answers, %, and no wrong merge.
    Right(f64),
    /// At least this share called ambiguous, %, and no wrong merge.
    Ambiguous(f64),
    /// Nothing merged.
    Nothing,
    /// No wrong merge, the mean of the squared normalised error over its degrees of freedom × 6 within 5.6 to 6.4, and
    /// 93 to 97 % of the truths inside the 95 % ellipsoid.
    Honest,
}

/// The unit of the second frame, and where its robots move.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Unit {
    /// Metres.
    Metre,
    /// Metres, in the plane.
    MetreInPlane,
    /// Unknown; each alignment measures it.
    Measured,
    /// Unknown; only the baselines between alignments give it.
    Unmeasured,
}

/// One row: worlds of one kind, one configuration.
#[derive(Clone, Debug)]
pub struct Cell {
    /// Its name.
    pub name: &'static str,
    draw: Draw,
    /// Largest covariance scale tried.
    scale_max: f64,
    unit: Unit,
    /// What must be reached.
    pub goal: Goal,
}

/// How often each outcome came.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tally {
    /// Worlds.
    pub worlds: u32,
    /// Merged within 8° and 3 m of the truth.
    pub merged_right: u32,
    /// Merged on true alignments alone, which are too few or too close together to come that near.
    pub merged_weak: u32,
    /// Merged, and neither.
    pub merged_wrong: u32,
    /// Shown as provisional, and as near.
    pub shown_right: u32,
    /// Shown as provisional, and not.
    pub shown_wrong: u32,
    /// Called ambiguous.
    pub ambiguous: u32,
    /// Refused for want of a baseline that gives the scale.
    pub short: u32,
    /// No set of alignments agreed.
    pub inconsistent: u32,
    /// Merged with a false alignment among those used.
    pub with_false: u32,
    /// Merged or shown right where only the true alignments are given: what no choice among them can surpass by much.
    pub told_right: u32,
    distance_squared: f64,
    inside: u32,
}

/// MATH §5's cells, at both scales, and what else must hold.
pub fn cells() -> Vec<Cell> {
    let draw = |real, aliased, random| Draw { real, aliased, random, under_reported: 1.0 };
    let cell = |name, draw, scale_max, goal| Cell { name, draw, scale_max, unit: Unit::Metre, goal };
    let under_reported = Draw { under_reported: 3.0, ..draw(4, 0, 16) };
    let similar = |name, draw, goal| Cell { name, draw, scale_max: 3.0, unit: Unit::Measured, goal };
    let planar = |name, draw, goal| Cell { name, draw, scale_max: 3.0, unit: Unit::MetreInPlane, goal };
    let unscaled = |name, draw, goal| Cell { name, draw, scale_max: 3.0, unit: Unit::Unmeasured, goal };
    vec![
        cell("80 % false", draw(4, 0, 16), 1.0, Goal::Right(100.0)),
        cell("80 % false", draw(4, 0, 16), 3.0, Goal::Right(100.0)),
        cell("85 % false", draw(3, 0, 17), 3.0, Goal::Right(94.0)),
        cell("90 % false", draw(2, 0, 18), 1.0, Goal::Right(94.0)),
        cell("90 % false", draw(2, 0, 18), 3.0, Goal::Right(94.0)),
        cell("10 true v 5 of one lie", draw(10, 5, 5), 1.0, Goal::Right(100.0)),
        cell("10 true v 5 of one lie", draw(10, 5, 5), 3.0, Goal::Right(100.0)),
        cell("4 true v 3 of one lie", draw(4, 3, 13), 1.0, Goal::Right(95.0)),
        cell("4 true v 3 of one lie", draw(4, 3, 13), 3.0, Goal::Right(99.0)),
        cell("4 true v 4 of one lie", draw(4, 4, 12), 1.0, Goal::Ambiguous(95.0)),
        cell("4 true v 4 of one lie", draw(4, 4, 12), 3.0, Goal::Ambiguous(95.0)),
        cell("covariances under-reported 3x", under_reported, 1.0, Goal::Right(0.0)),
        cell("covariances under-reported 3x", under_reported, 3.0, Goal::Right(99.0)),
        cell("all 20 false", draw(0, 0, 20), 3.0, Goal::Nothing),
        cell("all 60 false", draw(0, 0, 60), 3.0, Goal::Nothing),
        cell("10 true", draw(10, 0, 0), 1.0, Goal::Honest),
        cell("10 true", draw(10, 0, 0), 3.0, Goal::Honest),
        cell("10 true of 50", draw(10, 0, 40), 3.0, Goal::Honest),
        planar("SE(2), 80 % false", draw(4, 0, 16), Goal::Right(99.0)),
        planar("SE(2), 85 % false", draw(3, 0, 17), Goal::Right(70.0)),
        planar("SE(2), 10 true v 5 of one lie", draw(10, 5, 5), Goal::Right(99.0)),
        planar("SE(2), 4 true v 3 of one lie", draw(4, 3, 13), Goal::Right(95.0)),
        planar("SE(2), 4 true v 4 of one lie", draw(4, 4, 12), Goal::Ambiguous(95.0)),
        planar("SE(2), under-reported 3x", under_reported, Goal::Right(75.0)),
        planar("SE(2), all 20 false", draw(0, 0, 20), Goal::Nothing),
        planar("SE(2), all 60 false", draw(0, 0, 60), Goal::Nothing),
        planar("SE(2), 10 true", draw(10, 0, 0), Goal::Honest),
        planar("SE(2), 10 true of 50", draw(10, 0, 40), Goal::Honest),
        similar("SIM(3), 80 % false", draw(4, 0, 16), Goal::Right(99.0)),
        similar("SIM(3), 10 true", draw(10, 0, 0), Goal::Honest),
        unscaled("SIM(3) by baselines, 80 % false", draw(4, 0, 16), Goal::Right(99.0)),
        unscaled("SIM(3) by baselines, 50 % false", draw(10, 0, 10), Goal::Honest),
        unscaled("SIM(3) by baselines, 10 true", draw(10, 0, 0), Goal::Honest),
        unscaled("SIM(3) by baselines, all false", draw(0, 0, 20), Goal::Nothing),
    ]
}

/// Runs one cell; calls `done` after each world.
pub fn measure(cell: &Cell, seeds: Range<u64>, mut done: impl FnMut()) -> Tally {
    let config = FrameConsensusConfig { covariance_scale_max: cell.scale_max, ..FrameConsensusConfig::default() };
    let mut tally = Tally::default();
    for seed in seeds {
        let world = match cell.unit {
            Unit::MetreInPlane => World::planar(seed, cell.draw),
            _ => World::new(seed, cell.draw),
        };
        match cell.unit {
            Unit::Metre => {
                let outcome = align_frames(&world.alpha, &world.beta, &world.alignments, &config);
                let judge = |t: &PoseWithCovariance| (world.is_right(&t.pose), t.pose.local(&world.t_alpha_beta));
                tally.add(&world, outcome, |t| t.covariance, judge);
                let told = align_frames(&world.alpha, &world.beta, &true_ones(&world, &world.alignments), &config);
                tally.add_told(&told, |t| world.is_right(&t.pose));
            }
            Unit::MetreInPlane => {
                let outcome = align_frames(&world.alpha, &world.beta, &world.alignments, &config);
                let flat = |t: &PoseWithCovariance| Covariance::new_or_wider(se2::in_plane(t.covariance.matrix()));
                let judge = |t: &PoseWithCovariance| {
                    let error = Se2::of(&t.pose).local(&Se2::of(&world.t_alpha_beta));
                    (world.is_right(&t.pose), error)
                };
                tally.add(&world, outcome, flat, judge);
                let told = align_frames(&world.alpha, &world.beta, &true_ones(&world, &world.alignments), &config);
                tally.add_told(&told, |t| world.is_right(&t.pose));
            }
            Unit::Measured => tally.add_sim(&world, &world.with_unknown_scale(seed), &config),
            Unit::Unmeasured => tally.add_sim(&world, &world.with_unmeasured_scale(seed), &config),
        }
        done();
    }
    tally
}

fn true_ones<T: Copy>(world: &World, alignments: &[PairAlignment<T>]) -> Vec<PairAlignment<T>> {
    alignments.iter().zip(&world.real).filter(|(_, real)| **real).map(|(alignment, _)| *alignment).collect()
}

impl Tally {
    fn add_sim<T: Copy + Into<SimMeasurement>>(
        &mut self,
        world: &World,
        sim: &SimWorld<T>,
        config: &FrameConsensusConfig,
    ) {
        let outcome = align_frames_sim(&sim.alpha, &sim.beta, &sim.alignments, config);
        let judge = |t: &SimWithCovariance| (sim.is_right(&t.sim), t.sim.local(&sim.t_alpha_beta));
        self.add(world, outcome, |t| t.covariance, judge);
        let told = align_frames_sim(&sim.alpha, &sim.beta, &true_ones(world, &sim.alignments), config);
        self.add_told(&told, |t| sim.is_right(&t.sim));
    }

    fn add_told<T>(&mut self, outcome: &FrameOutcome<T>, is_right: impl Fn(&T) -> bool) {
        if let FrameOutcome::Merged(c) | FrameOutcome::Provisional(c) = outcome {
            self.told_right += u32::from(is_right(&c.t_alpha_beta));
        }
    }

    fn add<const N: usize, T>(
        &mut self,
        world: &World,
        outcome: FrameOutcome<T>,
        covariance: impl Fn(&T) -> Covariance<N>,
        judge: impl Fn(&T) -> (bool, SVector<f64, N>),
    ) {
        self.worlds += 1;
        match outcome {
            FrameOutcome::Merged(c) => {
                let (right, error) = judge(&c.t_alpha_beta);
                let distance_squared = covariance(&c.t_alpha_beta).mahalanobis_squared(&error);
                let with_false = c.used.iter().any(|&k| !world.real[k]);
                *match (right, with_false) {
                    (true, _) => &mut self.merged_right,
                    (false, false) => &mut self.merged_weak,
                    (false, true) => &mut self.merged_wrong,
                } += 1;
                self.with_false += u32::from(with_false);
                self.distance_squared += distance_squared * 6.0 / N as f64;
                self.inside += u32::from(distance_squared < chi2::P95[N - 1]);
            }
            FrameOutcome::Provisional(c) => {
                let (right, _) = judge(&c.t_alpha_beta);
                *(if right { &mut self.shown_right } else { &mut self.shown_wrong }) += 1;
            }
            FrameOutcome::Ambiguous { .. } => self.ambiguous += 1,
            FrameOutcome::BaselineTooShort { .. } => self.short += 1,
            FrameOutcome::Inconsistent | FrameOutcome::None => self.inconsistent += 1,
        }
    }

    fn percent(&self, count: u32) -> f64 {
        100.0 * f64::from(count) / f64::from(self.worlds.max(1))
    }

    fn merged(&self) -> f64 {
        f64::from(self.merged_right + self.merged_weak + self.merged_wrong)
    }

    /// Mean squared normalised error of merged frames, × 6 / degrees of freedom; NaN if none merged.
    pub fn anees(&self) -> f64 {
        self.distance_squared / self.merged()
    }

    /// Share of merged frames whose truth lies in the 95 % ellipsoid, %; NaN if none merged.
    pub fn coverage(&self) -> f64 {
        100.0 * f64::from(self.inside) / self.merged()
    }
}

impl Cell {
    /// What the tally lacks of the goal.
    pub fn shortfall(&self, tally: &Tally) -> Option<String> {
        let right = tally.percent(tally.merged_right + tally.shown_right);
        let ambiguous = tally.percent(tally.ambiguous);
        if tally.merged_wrong > 0 {
            return Some(format!("{} merged wrongly", tally.merged_wrong));
        }
        match self.goal {
            Goal::Right(least) if right < least => Some(format!("{:.1} below {least}", least - right)),
            Goal::Ambiguous(least) if ambiguous < least => Some(format!("{:.1} below {least}", least - ambiguous)),
            Goal::Nothing if tally.merged() > 0.0 => Some(format!("{} merged", tally.merged())),
            Goal::Honest if !(5.6..=6.4).contains(&tally.anees()) => Some("ANEES outside 5.6 to 6.4".to_owned()),
            Goal::Honest if !(93.0..=97.0).contains(&tally.coverage()) => {
                Some("coverage outside 93 to 97 %".to_owned())
            }
            _ => None,
        }
    }
}

/// The table.
pub fn table(cells: &[Cell], measured: &[Tally]) -> String {
    let mut text = format!(
        "{:<32} {:>3} {:>12} {:>6} {:>6} {:>7} {:>6} {:>6} {:>6} {:>6} {:>6} {:>6} {:>6} {:>6} {:>6}\n",
        "%",
        "f",
        "goal",
        "right",
        "told",
        "merged",
        "weak",
        "WRONG",
        "false",
        "shown",
        "ambig.",
        "short",
        "none",
        "ANEES",
        "in 95"
    );
    for (cell, tally) in cells.iter().zip(measured) {
        let goal = match cell.goal {
            Goal::Right(least) => format!("right {least}"),
            Goal::Ambiguous(least) => format!("ambig. {least}"),
            Goal::Nothing => "none merged".to_owned(),
            Goal::Honest => "honest".to_owned(),
        };
        let p = |count| format!("{:.1}", tally.percent(count));
        let _ = writeln!(
            text,
            "{:<32} {:>3} {goal:>12} {:>6} {:>6} {:>7} {:>6} {:>6} {:>6} {:>6} {:>6} {:>6} {:>6} {:>6.2} {:>6.1}  {}",
            cell.name,
            cell.scale_max,
            p(tally.merged_right + tally.shown_right),
            p(tally.told_right),
            p(tally.merged_right),
            p(tally.merged_weak),
            p(tally.merged_wrong),
            p(tally.with_false),
            p(tally.shown_wrong),
            p(tally.ambiguous),
            p(tally.short),
            p(tally.inconsistent),
            tally.anees(),
            tally.coverage(),
            cell.shortfall(tally).map_or("reached".to_owned(), |lack| format!("MISSED: {lack}"))
        );
    }
    text + "\nright: within 8° and 3 m, merged or (with fewer alignments than a merge needs) shown as provisional\n\
            told:  right where only the true alignments are given\n\
            weak:  merged further off, on true alignments alone; WRONG: merged further off, and not on those alone\n\
            false: merged with a false alignment among those used; shown: provisional and further off\n\
            short: refused, baseline too short for the scale\n"
}
