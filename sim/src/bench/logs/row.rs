//! What is printed of one play: a paragraph, and a row of the CSV.

use super::super::table::median;
use super::errors::errors;
use super::find::{Set, TruthFile, is_planar};
use super::judge::{Errors, Judge, Judged, PairFate, TRUTH};
use super::{Played, Prepared};
use std::io::Write;

/// Names of the columns.
pub const COLUMNS: [&str; 28] = [
    "set",
    "wires",
    "robots",
    "keyframes",
    "stated",
    "agreed",
    "used",
    "false_agreed",
    "false_used",
    "overlapping",
    "merged",
    "seconds",
    "fell_apart",
    "wrong",
    "wrong_secs",
    "worst_m",
    "unjudged",
    "within_m",
    "within_deg",
    "between_m",
    "between_deg",
    "nees_pairs",
    "nees_anchors",
    "beyond_claim",
    "used_unjudged",
    "bytes",
    "cpu_s",
    "verdict",
];

/// What the words mean.
pub const NOTE: &str = "wrong: a stated relation of two robots was off by more than 1 m or its claimed 99.9 % (the truth \
                        of logs counts as uncertain by 0.05 m and 0.01 rad); merged: of pairs with 10 m of common way \
                        or more, at the end, by both; errors: means";

/// What is printed of one play.
pub struct Row {
    set: String,
    wires: String,
    robots: Vec<String>,
    keyframes: usize,
    judged: Judged,
    cpu_s: f64,
}

impl Row {
    /// Judges a play.
    pub fn of(set: &Set, loss: Option<f64>, prepared: &Prepared, played: &Played) -> Self {
        let Prepared { recordings, reference, tracks, .. } = prepared;
        let truth = if set.truth == TruthFile::Recorded { (0.0, 0.0) } else { TRUTH };
        let judge = Judge { tracks, planar: recordings.iter().all(is_planar), truth };
        let (mut judged, views) = judge.judge(&played.wires);
        [judged.within, judged.between] = errors(tracks, reference.as_ref(), &views);
        Self {
            set: set.name.clone(),
            wires: loss.map_or_else(|| "perfect".into(), |loss| format!("{:.0} % lost", 100.0 * loss)),
            robots: tracks.iter().map(|track| track.robot.clone()).collect(),
            keyframes: tracks.iter().map(|track| track.stamps.len()).sum(),
            judged,
            cpu_s: played.cpu_s,
        }
    }

    /// Pairs that truly overlap, and those of them that are merged.
    fn overlapping(&self) -> [usize; 2] {
        let pairs = || self.judged.pairs.values().filter(|pair| pair.overlap_secs.is_some());
        [pairs().count(), pairs().filter(|pair| pair.merged).count()]
    }

    fn wrong(&self) -> usize {
        self.judged.pairs.values().map(|pair| pair.wrong).sum()
    }

    fn fell_apart(&self) -> usize {
        self.judged.pairs.values().map(|pair| pair.fell_apart).sum()
    }

    /// Nothing was ever wrong, no false alignment is used, and all merged that should.
    pub fn is_good(&self) -> bool {
        let [overlapping, merged] = self.overlapping();
        self.wrong() == 0 && self.judged.beyond_claim == 0 && merged == overlapping
    }

    fn verdict(&self) -> &'static str {
        let [overlapping, merged] = self.overlapping();
        match (self.is_good(), merged == overlapping) {
            (true, _) => "good",
            (false, true) => "WRONG",
            (false, false) if self.wrong() > 0 || self.judged.beyond_claim > 0 => "WRONG, in pieces",
            (false, false) => "in pieces",
        }
    }

    fn wrong_secs(&self) -> f64 {
        self.judged.pairs.values().map(|pair| pair.wrong_secs).sum()
    }

    fn worst_m(&self) -> f64 {
        self.judged.pairs.values().map(|pair| pair.worst_m).fold(0.0, f64::max)
    }

    /// From enough of a common way until the pair is called merged, s.
    fn wait(&self) -> f64 {
        let pairs = self.judged.pairs.values();
        median(pairs.filter_map(|pair| Some((pair.merged_secs? - pair.overlap_secs?).max(0.0))).collect())
    }

    /// In the order of [`COLUMNS`].
    pub fn fields(&self) -> Vec<String> {
        let Judged { alignments, falsely, unjudged, within, between, nees_pairs, nees_anchors, bytes, .. } =
            &self.judged;
        let counts = [self.robots.len(), self.keyframes].into_iter().chain(*alignments).chain(*falsely);
        let mut fields = vec![self.set.clone(), self.wires.clone()];
        fields.extend(counts.chain(self.overlapping()).map(|n| n.to_string()));
        fields.push(format!("{:.0}", self.wait()));
        fields.extend([self.fell_apart(), self.wrong()].map(|n| n.to_string()));
        fields.extend([format!("{:.0}", self.wrong_secs()), format!("{:.2}", self.worst_m()), unjudged.to_string()]);
        for [metres, degrees] in [within, between].map(means) {
            fields.extend([format!("{metres:.3}"), format!("{degrees:.2}")]);
        }
        fields.extend([nees_pairs, nees_anchors].map(|all| format!("{:.2}", mean(all))));
        fields.extend([self.judged.beyond_claim.to_string(), self.judged.used_unjudged.to_string(), bytes.to_string()]);
        fields.extend([format!("{:.1}", self.cpu_s), self.verdict().into()]);
        fields
    }

    /// In words.
    pub fn print(&self, out: &mut impl Write) -> std::io::Result<()> {
        let Self { set, wires, keyframes, cpu_s, judged, .. } = self;
        let [[within_m, within_deg], [between_m, between_deg]] = [&judged.within, &judged.between]
            .map(means)
            .map(|[metres, degrees]| [number(metres, 3), number(degrees, 2)]);
        let [overlapping, merged] = self.overlapping();
        let ([stated, agreed, used], [false_agreed, false_used]) = (judged.alignments, judged.falsely);
        let beyond = judged.beyond_claim;
        writeln!(out, "{set} ({wires}): {}", self.verdict())?;
        writeln!(
            out,
            "  {keyframes} keyframes of {} robots, {} bytes sent, {cpu_s:.1} s of one core",
            self.robots.len(),
            judged.bytes
        )?;
        writeln!(
            out,
            "  alignments: {stated} stated, {agreed} agreed ({false_agreed} false), {used} used ({false_used} false, \
             {beyond} of them beyond what they claim; {} not judged)",
            judged.used_unjudged
        )?;
        writeln!(
            out,
            "  pairs that overlap: {overlapping}, merged {merged}, {} s later (median); fell apart {} times",
            number(self.wait(), 0),
            self.fell_apart()
        )?;
        writeln!(
            out,
            "  ever wrong: {} statements, {:.0} s in all, {:.2} m at worst ({} not judged)",
            self.wrong(),
            self.wrong_secs(),
            self.worst_m(),
            judged.unjudged
        )?;
        writeln!(
            out,
            "  relations: within one robot {within_m} m {within_deg} deg of {}, between robots {between_m} m \
             {between_deg} deg of {}",
            judged.within.len(),
            judged.between.len()
        )?;
        let [pairs, anchors] = [&judged.nees_pairs, &judged.nees_anchors];
        writeln!(
            out,
            "  NEES per degree of freedom: pairs {} of {}, anchors {} of {}",
            number(mean(pairs), 2),
            pairs.len(),
            number(mean(anchors), 2),
            anchors.len()
        )?;
        judged.pairs.iter().try_for_each(|((a, b), pair)| self.print_pair(out, [*a, *b], pair))?;
        judged.false_ones.iter().try_for_each(|one| writeln!(out, "    false: {one}"))?;
        out.flush()
    }

    fn print_pair(&self, out: &mut impl Write, [a, b]: [usize; 2], pair: &PairFate) -> std::io::Result<()> {
        let secs = |secs: Option<f64>| secs.map_or_else(|| "never".into(), |secs| format!("{secs:.0} s"));
        writeln!(
            out,
            "    {} {}: overlap {}, merged {}, {} at the end; wrong {} times, {:.0} s; at worst {:.2} m, {:.1} deg, \
             {:.2} of the claimed 99.9 %",
            self.robots[a],
            self.robots[b],
            secs(pair.overlap_secs),
            secs(pair.merged_secs),
            pair.status.map_or_else(|| "no alignment".into(), |status| format!("{status:?}").to_lowercase()),
            pair.wrong,
            pair.wrong_secs,
            pair.worst_m,
            pair.worst_deg,
            pair.worst_claim,
        )
    }
}

/// A figure, or that there is none.
fn number(value: f64, digits: usize) -> String {
    if value.is_finite() { format!("{value:.digits$}") } else { "–".into() }
}

fn mean(all: &[f64]) -> f64 {
    all.iter().sum::<f64>() / all.len() as f64
}

fn means(errors: &Errors) -> [f64; 2] {
    let of = |pick: fn(&(f64, f64)) -> f64| errors.iter().map(pick).sum::<f64>() / errors.len() as f64;
    [of(|error| error.0), of(|error| error.1)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    fn row(pair: PairFate, falsely: [usize; 2], beyond_claim: usize) -> Row {
        let judged = Judged { pairs: BTreeMap::from([((0, 1), pair)]), falsely, beyond_claim, ..Judged::default() };
        let robots = vec!["a".into(), "b".into()];
        Row { set: "log".into(), wires: "perfect".into(), robots, keyframes: 7, judged, cpu_s: 1.0 }
    }

    #[test]
    fn what_was_not_found_is_no_number() {
        assert_eq!((number(0.126, 2), number(f64::NAN, 2)), ("0.13".into(), "–".into()));
        let mut printed = Vec::new();
        row(PairFate::default(), [0, 0], 0).print(&mut printed).unwrap();
        let printed = String::from_utf8(printed).unwrap();
        assert!(printed.contains("– m – deg of 0") && !printed.contains("NaN"), "{printed}");
    }

    #[test]
    fn each_shortfall_fails() {
        let overlapping = PairFate { overlap_secs: Some(5.0), merged_secs: Some(9.0), ..PairFate::default() };
        let merged = PairFate { merged: true, ..overlapping.clone() };
        let wrong = PairFate { wrong: 1, ..merged.clone() };
        let cases = [
            (merged.clone(), [0, 0], 0, "good"),
            (PairFate { overlap_secs: None, ..overlapping.clone() }, [0, 0], 0, "good"),
            (overlapping.clone(), [0, 0], 0, "in pieces"),
            (wrong, [0, 0], 0, "WRONG"),
            // Vague, and it says so.
            (merged.clone(), [1, 1], 0, "good"),
            (merged, [1, 1], 1, "WRONG"),
            (overlapping, [1, 1], 1, "WRONG, in pieces"),
        ];
        for (pair, falsely, beyond_claim, verdict) in cases {
            let row = row(pair, falsely, beyond_claim);
            assert_eq!((row.verdict(), row.is_good()), (verdict, verdict == "good"));
            let (fields, mut text) = (row.fields(), Vec::new());
            assert_eq!(fields.len(), COLUMNS.len());
            row.print(&mut text).unwrap();
            assert!(String::from_utf8(text).unwrap().starts_with(&format!("log (perfect): {verdict}\n")));
        }
    }
}
