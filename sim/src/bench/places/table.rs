//! What was measured, as text, and whether it is good enough.

use super::candidates::ranking;
use super::measure::{At, OVERLAP_FOUND, OVERLAP_NONE, Tried, place};
use super::peer::Peer;
use super::sets::{Place, Set};
use core::fmt::{Display, Formatter, Result};
use merganser_protocol::config::Sensor;
use merganser_protocol::submap::features::DESCRIPTOR_LEN;

/// Pairs that overlap a little, too little to be sure: by set and names.
const HARD: [(&str, &str, &str); 2] = [("kitti00", "94", "198"), ("kitti00", "5", "94")];
/// Processor time to describe a LiDAR keyframe of about 20,000 points at most, ms.
const DENSE_MS_MAX: f64 = 20.0;
/// 95 % quantile of χ² with 6 degrees of freedom.
const CHI2_6_95: f64 = 12.592;

/// All that one run gave.
pub(super) struct Outcome<'a> {
    pub seed: u64,
    pub sets: &'a [Set],
    pub tried: &'a [Tried],
    pub peers: &'a [Peer],
    /// A LiDAR turn of about as many points as the goal for describing is stated of.
    pub dense: &'a Place,
}

/// Whether a pair is one of those to be refused though they overlap.
pub(super) fn is_hard(sets: &[Set], tried: &Tried) -> bool {
    let (a, b) = (place(sets, tried.their), place(sets, tried.mine));
    let named = |(set, x, y): &(&str, &str, &str)| {
        sets[tried.their.0].name == *set && ((a.name == *x && b.name == *y) || (a.name == *y && b.name == *x))
    };
    tried.their.0 == tried.mine.0 && HARD.iter().any(named)
}

impl Outcome<'_> {
    /// As much found as promised, and no more wrong.
    pub(super) fn is_good(&self) -> bool {
        let wrong = |k: usize| self.tried.iter().filter(|t| t.their.0 == k && t.answer.is_ok() && !t.is_right).count();
        let found = |(k, set): (usize, &Set)| {
            self.to_find(k).filter(|t| t.is_right).count() >= set.found_min && wrong(k) <= set.wrong_max
        };
        self.tried.iter().all(|t| t.answer.is_err() || !is_hard(self.sets, t))
            && self.sets.iter().enumerate().all(found)
    }

    fn to_find(&self, set: usize) -> impl Iterator<Item = &Tried> {
        self.tried.iter().filter(move |t| t.their.0 == set && t.mine.0 == set && t.overlap >= OVERLAP_FOUND)
    }

    fn alignments(&self, f: &mut Formatter<'_>) -> Result {
        writeln!(
            f,
            "{:<9} {:>5} {:>5} {:>5} {:>5} {:>8} {:>8} {:>8} {:>9} {:>6} {:>8} {:>8}",
            "overlap",
            "tried",
            "found",
            "wrong",
            "none",
            "recall",
            "rot °",
            "trans m",
            "NEES",
            "in 95%",
            "cpu ms",
            "max"
        )?;
        for (k, set) in self.sets.iter().enumerate() {
            self.row(f, set.name, &self.to_find(k).collect::<Vec<_>>())?;
        }
        let in_plane = |t: &&Tried| self.sets[t.their.0].sensor == Sensor::Laser2d;
        let (plane, space): (Vec<&Tried>, Vec<&Tried>) = self.tried.iter().partition(in_plane);
        for (names, all) in [(["little", "none"], space), (["little 2d", "none 2d"], plane)] {
            let below = |least: f64, most: f64| -> Vec<&Tried> {
                all.iter().filter(|t| t.overlap >= least && t.overlap < most).copied().collect()
            };
            self.row(f, names[0], &below(OVERLAP_NONE, OVERLAP_FOUND))?;
            self.row(f, names[1], &below(0.0, OVERLAP_NONE))?;
        }
        let strangers =
            self.tried.iter().filter(|t| t.overlap < OVERLAP_FOUND && place(self.sets, t.their).scan.is_some());
        let strangers: Vec<_> = strangers.collect();
        let wrong = strangers.iter().filter(|t| t.answer.is_ok() && !t.is_right).count();
        writeln!(f, "LiDAR pairs below a quarter: {} tried, {wrong} wrongly accepted", strangers.len())?;
        for t in self.tried.iter().filter(|t| is_hard(self.sets, t)) {
            let (a, b) = (&place(self.sets, t.their).name, &place(self.sets, t.mine).name);
            let said = t.answer.as_ref().map_or_else(|reason| format!("refused: {reason}"), |_| "ACCEPTED".into());
            writeln!(f, "  {a}–{b}, {:.0} % overlap: {said}", 100.0 * t.overlap)?;
        }
        for t in self.tried.iter().filter(|t| !t.is_right && (t.overlap >= OVERLAP_FOUND || t.answer.is_ok())) {
            let named = |at: At| format!("{} {}", self.sets[at.0].name, place(self.sets, at).name);
            let said = match &t.answer {
                Err(reason) => format!("missed: {reason}"),
                Ok(found) => format!(
                    "WRONG{}: score {:.0}, support {:.0}, fit {:.2}, contradiction {:.3}",
                    t.error.map_or_else(String::new, |(deg, m)| format!(" by {deg:.1}° and {m:.2} m")),
                    found.score,
                    found.support,
                    found.fit,
                    found.contradiction
                ),
            };
            writeln!(f, "  {} – {}, {:.0} % overlap: {said}", named(t.their), named(t.mine), 100.0 * t.overlap)?;
        }
        Ok(())
    }

    fn row(&self, f: &mut Formatter<'_>, name: &str, of: &[&Tried]) -> Result {
        let found: Vec<_> = of.iter().filter(|t| t.is_right).collect();
        let wrong = of.iter().filter(|t| t.answer.is_ok() && !t.is_right).count();
        let of_found = |value: fn(&Tried) -> Option<f64>| found.iter().filter_map(|t| value(t)).collect::<Vec<f64>>();
        let nees = of_found(|t| t.nees);
        let inside = nees.iter().filter(|&&n| n <= CHI2_6_95).count();
        let seconds: Vec<f64> = of.iter().map(|t| t.seconds * 1e3).collect();
        writeln!(
            f,
            "{name:<9} {:>5} {:>5} {wrong:>5} {:>5} {:>7.1}% {:>8.2} {:>8.3} {:>9.2} {:>5.0}% {:>8.0} {:>8.0}",
            of.len(),
            found.len(),
            of.len() - found.len() - wrong,
            percent(found.len(), of.len()),
            median(&of_found(|t| Some(t.error?.0))),
            median(&of_found(|t| Some(t.error?.1))),
            nees.iter().sum::<f64>() / nees.len() as f64,
            percent(inside, nees.len()),
            median(&seconds),
            seconds.iter().fold(0.0, |a: f64, &b| a.max(b)),
        )
    }

    fn candidates(&self, f: &mut Formatter<'_>) -> Result {
        let streets: Vec<usize> =
            (0..self.sets.len()).filter(|&k| self.sets[k].places.iter().all(|p| p.scan.is_some())).collect();
        let each = self.sets.iter().enumerate().map(|(k, set)| (set.name, vec![k]));
        writeln!(f, "candidates  pairs  to find  recall at 100 % precision  precision–recall area (chance)")?;
        for (name, of) in each.chain([("all streets", streets)]) {
            let r = ranking(self.sets, self.tried, &of);
            let all = r.positives + r.negatives;
            writeln!(
                f,
                "{name:<11} {all:>5} {:>8} {:>26.2} {:>22.2} ({:.2})",
                r.positives,
                r.recall_at_full_precision,
                r.area,
                r.positives as f64 / all.max(1) as f64
            )?;
        }
        Ok(())
    }

    fn costs(&self, f: &mut Formatter<'_>) -> Result {
        writeln!(
            f,
            "submaps    points  keyframes  summary B  blob B  of it descriptors B  CPU ms a keyframe: thin  describe  \
             µs a point"
        )?;
        for set in self.sets {
            cost(f, set.name, &set.places.iter().collect::<Vec<_>>())?;
        }
        cost(f, "dense", &[self.dense])?;
        writeln!(f, "dense: a LiDAR turn thinned to about 20,000 points; goal {DENSE_MS_MAX:.0} ms to describe it")
    }

    fn compared(&self, f: &mut Formatter<'_>) -> Result {
        if self.peers.is_empty() {
            return Ok(());
        }
        writeln!(f, "KITTI pair      ours rot ° trans m   cpu ms | KISS-Matcher rot ° trans m   cpu ms  wall ms")?;
        for peer in self.peers {
            let (a, b) = peer.pair;
            let name = format!("{} {}–{}", self.sets[a.0].name, place(self.sets, a).name, place(self.sets, b).name);
            let Some(ours) = self.ours(peer) else { continue };
            let error = |error: Option<(f64, f64)>| {
                error.map_or_else(|| format!("{:>10} {:>7}", "refused", ""), |(deg, m)| format!("{deg:>10.2} {m:>7.3}"))
            };
            let said = error(peer.valid.then_some(peer.error));
            writeln!(
                f,
                "{name:<15} {} {:>8.0} | {said:>31} {:>8.0} {:>8.0}",
                error(ours.error),
                self.cpu_s(ours) * 1e3,
                peer.cpu_s * 1e3,
                peer.wall_s * 1e3,
            )?;
        }
        let pairs: Vec<_> = self.peers.iter().filter_map(|peer| Some((self.ours(peer)?, peer))).collect();
        let to_find: Vec<_> = pairs.iter().filter(|(t, _)| !is_hard(self.sets, t)).collect();
        let rule = |t: &Tried| &self.sets[t.their.0];
        let is_right = |t: &Tried, peer: &Peer| {
            peer.valid && peer.error.0 < rule(t).rotation_deg && peer.error.1 < rule(t).translation_m
        };
        let theirs = to_find.iter().filter(|(t, peer)| is_right(t, peer));
        // Where both found the pair.
        let both: Vec<_> =
            theirs.clone().filter_map(|(t, peer)| Some((t.error.filter(|_| t.is_right)?, peer.error))).collect();
        let of = |value: fn(&Both) -> f64| median(&both.iter().map(value).collect::<Vec<_>>());
        writeln!(
            f,
            "to find {}: ours {}, theirs {}; median error where both do: ours {:.2}° and {:.3} m, theirs {:.2}° and \
             {:.3} m; processor time, median ratio theirs to ours: {:.1}",
            to_find.len(),
            to_find.iter().filter(|(t, _)| t.is_right).count(),
            theirs.count(),
            of(|b| b.0.0),
            of(|b| b.0.1),
            of(|b| b.1.0),
            of(|b| b.1.1),
            median(&pairs.iter().map(|(t, peer)| peer.cpu_s / self.cpu_s(t)).collect::<Vec<_>>())
        )
    }

    /// The same pair, by us.
    fn ours(&self, peer: &Peer) -> Option<&Tried> {
        self.tried.iter().find(|t| (t.their, t.mine) == peer.pair)
    }

    /// Processor time from two raw clouds to an answer, s.
    fn cpu_s(&self, t: &Tried) -> f64 {
        self.both_described(t.their, t.mine) + t.seconds
    }

    /// Time from two raw clouds to two descriptions, s.
    fn both_described(&self, a: At, b: At) -> f64 {
        [a, b].map(|at| place(self.sets, at)).iter().map(|p| p.thin_s + p.describe_s).sum()
    }
}

impl Display for Outcome<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> Result {
        writeln!(f, "seed {}", self.seed)?;
        self.alignments(f)?;
        self.candidates(f)?;
        self.costs(f)?;
        self.compared(f)
    }
}

/// Rotation (°) and translation (m) off the truth: ours, and a peer's.
type Both = ((f64, f64), (f64, f64));

fn cost(f: &mut Formatter<'_>, name: &str, places: &[&Place]) -> Result {
    let of = |value: fn(&Place) -> f64| median(&places.iter().map(|place| value(place)).collect::<Vec<f64>>());
    writeln!(
        f,
        "{name:<9} {:>7.0} {:>10.0} {:>10.0} {:>7.0} {:>20.0} {:>24.1} {:>9.1} {:>11.2}",
        of(|p| p.described.features.len() as f64),
        of(|p| p.keyframes as f64),
        of(|p| p.described.summary.encode().len() as f64),
        of(|p| p.described.keypoints.encode().len() as f64),
        of(|p| (p.described.keypoints.len() * DESCRIPTOR_LEN) as f64),
        of(|p| p.thin_s * 1e3 / p.keyframes as f64),
        of(|p| p.describe_s * 1e3 / p.keyframes as f64),
        of(|p| p.describe_s * 1e6 / p.described.features.len() as f64),
    )
}

fn percent(part: usize, of: usize) -> f64 {
    100.0 * part as f64 / of.max(1) as f64
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}
