//! `merganser-sim bench liars`: what members with a valid key come to that lie of themselves, one to three of eight. The
//! same swarm runs without and with them. A pair of honest robots that measured one another must end as certain and as
//! right as without liars, or unmerged; liars that touch the honest are to be named, and nobody else may be.

use crate::adversary::Adversary;
use crate::bar::progress_bar;
use crate::scenario::Scenario;
use crate::swarm::{Outcome, Swarm};
use crate::truth::nees;
use anyhow::Context;
use clap::Args;
use merganser_protocol::agent::Agent;
use merganser_protocol::kinds::PairStatus;
use merganser_protocol::snapshot::{FramesView, PairView};
use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;

const SCENARIO: &str = include_str!("swarm.toml");
/// χ² of six degrees of freedom at 99.9 %.
const WITHIN: f64 = 22.46;
/// Share of the liars that touch honest frames to be named: aimed at, and not reached by those who lie of their own place
/// alone.
const NAMED_MIN: f64 = 0.95;
/// Share of honest pairs that may be farther off than they say: what 99.9 % leaves, and as much for chance.
const OFF_MAX: f64 = 0.002;

/// `bench liars`.
#[derive(Debug, Args)]
pub struct Liars {
    /// How they lie; each way in turn, and a mix, if absent
    #[arg(long, value_enum)]
    way: Vec<Way>,
    /// Swarms of each
    #[arg(long, default_value_t = 170, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    seeds: u64,
    /// The first swarm's seed
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..1 << 62))]
    first: u64,
}

/// How the liars of a swarm lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Way {
    /// Others' clouds are stated as their own
    Mirror,
    /// The odometry is stretched
    Forger,
    /// Clouds move away from where they were seen
    Shifter,
    /// What is stated is far less certain than it says
    Boaster,
    /// They agree to lies about their relation
    Colluder,
    /// Each in a way of its own
    Mix,
}

/// What swarms came to.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tally {
    /// How many.
    pub swarms: u64,
    /// Pairs of honest robots that are merged without liars.
    pub pairs: u64,
    /// Of these with liars: merged, and within what they claim.
    pub held: u64,
    /// Merged, and farther off than they claim.
    pub off: u64,
    /// The same without liars.
    pub off_without: u64,
    /// Not merged, for what they measured is contradicted.
    pub parted: u64,
    /// Not merged, for they measured too little: whom a robot aligns depends on who else is there.
    pub unmet: u64,
    /// Liars that honest robots are merged with, and place wrongly by what these claim, or suspect.
    pub touching: u64,
    /// Of these, such as are suspected.
    pub named: u64,
    /// Honest robots of which an honest one says for certain that they are wrong.
    pub slandered: u64,
}

impl Tally {
    /// Whether fewer liars are named than is aimed at.
    pub fn names_too_few(&self) -> bool {
        (self.named as f64) < NAMED_MIN * self.touching as f64
    }

    /// What falls short of what is promised; `None` if nothing does.
    pub fn shortfall(&self) -> Option<String> {
        let share = |part: u64, whole: u64| part as f64 / whole.max(1) as f64;
        let mut short = Vec::new();
        if share(self.off, self.held + self.off) > OFF_MAX + share(self.off_without, self.pairs) {
            short.push(format!("{} of {} honest pairs are farther off than they say", self.off, self.held + self.off));
        }
        if self.slandered > 0 {
            short.push(format!("{} honest robots are named", self.slandered));
        }
        (!short.is_empty()).then(|| short.join("; "))
    }
}

impl Way {
    const ALL: [Self; 6] = [Self::Mirror, Self::Forger, Self::Shifter, Self::Boaster, Self::Colluder, Self::Mix];

    /// How the liar of this number lies, in the swarm of this seed.
    fn of(self, number: usize, seed: u64) -> Adversary {
        match self {
            Self::Mirror => Adversary::Mirror,
            Self::Forger => Adversary::Forger,
            Self::Shifter => Adversary::Shifter,
            Self::Boaster => Adversary::Boaster,
            Self::Colluder => Adversary::Colluder,
            Self::Mix => Adversary::ALL[(number + seed as usize) % Adversary::ALL.len()],
        }
    }
}

/// Measures and prints. Returns whether everything promised holds.
///
/// # Errors
/// A run that cannot be made or broke an invariant; standard output that cannot be written.
pub fn run(options: &Liars) -> anyhow::Result<bool> {
    let ways = if options.way.is_empty() { Way::ALL.to_vec() } else { options.way.clone() };
    let bar = progress_bar(ways.len() as u64 * options.seeds, "swarms")?;
    let mut out = std::io::stdout().lock();
    let mut all = true;
    let heads = ["swarms", "pairs", "held", "off", "without", "parted", "unmet", "touching", "named", "slandered"];
    writeln!(out, "{:<9}{}", "", heads.map(|head| format!("{head:>10}")).concat())?;
    for way in ways {
        let mut tally = Tally::default();
        for seed in options.first..options.first + options.seeds {
            tally.add(way, seed).with_context(|| format!("{way:?} seed {seed}"))?;
            bar.inc(1);
        }
        let Tally { swarms, pairs, held, off, off_without, parted, unmet, touching, named, slandered } = tally;
        let row = [swarms, pairs, held, off, off_without, parted, unmet, touching, named, slandered];
        let name = format!("{way:?}").to_lowercase();
        let shortfall = tally.shortfall();
        all &= shortfall.is_none();
        bar.suspend(|| {
            writeln!(out, "{name:<9}{}", row.map(|count| format!("{count:>10}")).concat())?;
            shortfall.map_or(Ok(()), |shortfall| writeln!(out, "  ! {shortfall}"))?;
            if tally.names_too_few() { writeln!(out, "  fewer liars are named than the 95 % aimed at") } else { Ok(()) }
        })?;
    }
    bar.finish_and_clear();
    writeln!(
        out,
        "eight robots, one to three of them liars; pairs of honest robots that merge without liars, and with them hold \
         (within 99.9 % of what they claim), are off, are parted by contradictions, or measured too little; liars that touch \
         honest robots, and are named by them; honest robots that are named"
    )?;
    Ok(all)
}

impl Tally {
    /// Runs the swarm of a seed without and with liars.
    ///
    /// # Errors
    /// A run that cannot be made or broke an invariant.
    pub fn add(&mut self, way: Way, seed: u64) -> anyhow::Result<()> {
        let mut scenario = Scenario::parse(SCENARIO)?;
        let honest = play(scenario.clone(), seed)?;
        let liars = 1 + (seed % 3) as usize + usize::from(way == Way::Colluder && seed.is_multiple_of(3));
        let names = scenario.names();
        let lying = (0..liars).map(|k| (names[(seed as usize + 3 * k) % names.len()].clone(), way.of(k, seed)));
        let lying: BTreeMap<String, Adversary> = lying.collect();
        scenario.summary.as_mut().context("no summary")?.adversaries = lying.clone();
        let lied_to = play(scenario, seed)?;
        let is_honest = |name: &str| !lying.contains_key(name);
        self.swarms += 1;
        for (name, with) in views(&lied_to).filter(|(name, _)| is_honest(name)) {
            let Some((_, without)) = views(&honest).find(|(other, _)| *other == name) else { continue };
            for pair in merged(without).filter(|pair| other_end(without, pair).is_some_and(|end| is_honest(robot(end))))
            {
                self.pairs += 1;
                self.off_without += u64::from(is_off(&honest, without, pair));
                self.judge(&lied_to, with, pair);
            }
            let suspects: BTreeSet<&str> = with.suspects.iter().map(|suspect| suspect.robot.as_str()).collect();
            let certain = with.suspects.iter().filter(|suspect| suspect.certain);
            self.slandered += certain.filter(|suspect| is_honest(&suspect.robot)).count() as u64;
            for liar in lying.keys() {
                let is_merged = merged(with).any(|pair| other_end(with, pair).is_some_and(|end| robot(end) == liar));
                let is_suspect = suspects.contains(liar.as_str());
                self.touching += u64::from((is_merged && !is_harmless(&lied_to, with, liar)) || is_suspect);
                self.named += u64::from(is_suspect);
            }
        }
        Ok(())
    }

    /// What became, among liars, of a pair that is merged without them.
    fn judge(&mut self, outcome: &Outcome<Agent>, view: &FramesView, pair: &PairView) {
        let ends = BTreeSet::from([robot(&pair.a), robot(&pair.b)]);
        let now = view.pairs.iter().find(|now| BTreeSet::from([robot(&now.a), robot(&now.b)]) == ends);
        match now {
            Some(now) if now.status == PairStatus::Merged => {
                let off = is_off(outcome, view, now);
                self.off += u64::from(off);
                self.held += u64::from(!off);
            }
            Some(now) if now.status != PairStatus::Provisional => self.parted += 1,
            _ => self.unmet += 1,
        }
    }
}

fn play(scenario: Scenario, seed: u64) -> anyhow::Result<Outcome<Agent>> {
    let outcome = Swarm::<Agent>::new(scenario, seed)?.run(|_| {})?;
    match &outcome.violation {
        Some(violation) => anyhow::bail!("{} at {:.1} s: {}", violation.invariant, violation.at_secs, violation.what),
        None => Ok(outcome),
    }
}

/// What each robot says of frames at the end.
fn views(outcome: &Outcome<Agent>) -> impl Iterator<Item = (&str, &FramesView)> {
    outcome.robots.iter().filter_map(|robot| Some((robot.name.as_str(), &robot.snapshot.as_ref()?.frames)))
}

/// Merged pairs of a robot's own frame.
fn merged(view: &FramesView) -> impl Iterator<Item = &PairView> {
    view.pairs.iter().filter(|pair| pair.status == PairStatus::Merged && other_end(view, pair).is_some())
}

fn other_end<'a>(view: &FramesView, pair: &'a PairView) -> Option<&'a str> {
    match (pair.a == view.own, pair.b == view.own) {
        (true, _) => Some(&pair.b),
        (_, true) => Some(&pair.a),
        _ => None,
    }
}

fn robot(frame: &str) -> &str {
    frame.split('/').next().unwrap_or_default()
}

/// Whether a merged pair lies farther from the truth than it says at 99.9 %.
fn is_off(outcome: &Outcome<Agent>, view: &FramesView, pair: &PairView) -> bool {
    let Some(other) = other_end(view, pair) else { return false };
    let relation = view.frames.iter().find(|frame| frame.frame == other).and_then(|frame| frame.t_own_frame.as_ref());
    let truth = outcome.truth.get(&view.own).zip(outcome.truth.get(other));
    let d2 =
        relation.zip(truth).map(|(relation, (own, other))| nees(relation, &(own.to_se3().inverse() * other.to_se3())));
    // What cannot be judged must not pass.
    d2.is_none_or(|d2| d2.is_nan() || d2 > WITHIN)
}

/// A liar whom the honest place where it truly is, as it says: it fooled nobody.
fn is_harmless(outcome: &Outcome<Agent>, view: &FramesView, liar: &str) -> bool {
    let mut pairs = merged(view).filter(|pair| other_end(view, pair).is_some_and(|end| robot(end) == liar));
    pairs.all(|pair| !is_off(outcome, view, pair))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_promise_is_held_against_what_came() {
        let good = Tally { swarms: 9, pairs: 90, held: 80, parted: 10, touching: 20, named: 19, ..Tally::default() };
        assert_eq!(good.shortfall(), None);
        let short = |change: fn(&mut Tally)| {
            let mut tally = good.clone();
            change(&mut tally);
            tally.shortfall().is_some()
        };
        assert!(short(|tally| tally.off = 1));
        assert!(short(|tally| tally.slandered = 1) && !good.names_too_few());
        assert!(Tally { named: 18, ..good.clone() }.names_too_few());
    }

    /// A sibling of the bench's thousand: every way once.
    #[test]
    fn liars_move_no_honest_pair_and_slander_nobody() {
        let mut tally = Tally::default();
        for (seed, way) in (1..).zip(Way::ALL) {
            tally.add(way, seed).unwrap();
        }
        assert!(tally.pairs > 50 && tally.held > 0, "{tally:?}");
        assert_eq!((tally.off, tally.slandered), (0, 0), "{tally:?}");
    }
}
