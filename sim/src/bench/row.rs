//! One line of the CSV: what one solver gave on one problem. A wrong answer that was accepted has status `ok`; its
//! errors tell.

use std::fmt;

/// The CSV's first line.
pub const HEADER: &str = "solver,group,N,ratio,seed,status,cpu_s,rot_deg,trans,scale_rel";
/// Largest rotation error of a right answer, °.
const ROTATION_MAX_DEG: f64 = 5.0;
/// Largest translation error of a right answer.
const TRANSLATION_MAX: f64 = 0.1;
/// Largest relative error of scale of a right answer.
const SCALE_MAX: f64 = 0.1;

/// Which problem.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Problem {
    /// `SE3`, `SIM3` or `ALIAS`.
    pub group: String,
    /// Number of matches.
    pub n: u32,
    /// False ones, %.
    pub ratio: u32,
    /// Which of the cell.
    pub seed: u32,
}

/// What became of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Status {
    /// An answer, accepted.
    Ok,
    /// An answer to be confirmed before use.
    Provisional,
    /// Two answers about as good.
    Ambiguous,
    /// No answer.
    None,
}

/// One solver on one problem.
#[derive(Clone, Debug, PartialEq)]
pub struct Row {
    /// The solver's name.
    pub solver: String,
    /// The problem.
    pub problem: Problem,
    /// What became of it.
    pub status: Status,
    /// Processor time, s.
    pub cpu_s: f64,
    /// Rotation error, °; NaN without an answer.
    pub rot_deg: f64,
    /// Translation error; NaN without an answer.
    pub trans: f64,
    /// Relative error of scale; NaN without an answer.
    pub scale_rel: f64,
}

impl Problem {
    /// From a file's name without its extension.
    pub fn of_name(name: &str) -> Option<Self> {
        let mut parts = name.split('_');
        let mut part = |prefix| parts.next()?.strip_prefix(prefix);
        let group = part("")?.to_owned();
        let n = part("N")?.parse().ok()?;
        let ratio = part("o")?.parse().ok().filter(|&percent| percent <= 100)?;
        let seed = part("s")?.parse().ok()?;
        let known = ["SE3", "SIM3", "ALIAS"].contains(&group.as_str()) && parts.next().is_none();
        known.then_some(Self { group, n, ratio, seed })
    }

    /// Of unknown scale.
    pub fn is_similarity(&self) -> bool {
        self.group == "SIM3"
    }
}

impl Status {
    const ALL: [(Self, &str); 4] =
        [(Self::Ok, "ok"), (Self::Provisional, "provisional"), (Self::Ambiguous, "ambiguous"), (Self::None, "none")];

    /// Whether there is an answer.
    pub fn answered(self) -> bool {
        matches!(self, Self::Ok | Self::Provisional)
    }
}

impl Row {
    /// Whether it has an answer within 5°, 0.1 and, for similarities, 10 % of scale.
    pub fn is_right(&self) -> bool {
        self.status.answered()
            && self.rot_deg < ROTATION_MAX_DEG
            && self.trans < TRANSLATION_MAX
            && (!self.problem.is_similarity() || self.scale_rel < SCALE_MAX)
    }

    /// Whether it has an answer, and a wrong one.
    pub fn is_wrong(&self) -> bool {
        self.status.answered() && !self.is_right()
    }

    /// From a line of the CSV.
    pub fn parse(line: &str) -> Option<Self> {
        let fields: Vec<&str> = line.trim().split(',').collect();
        let [solver, group, n, ratio, seed, status, cpu_s, rot_deg, trans, scale_rel] = fields.try_into().ok()?;
        let number = |text: &str| text.parse::<f64>().ok();
        Some(Self {
            solver: solver.to_owned(),
            problem: Problem::of_name(&format!("{group}_N{n}_o{ratio}_s{seed}"))?,
            status: Status::ALL.iter().find(|(_, name)| *name == status)?.0,
            cpu_s: number(cpu_s).filter(|s| *s >= 0.0)?,
            rot_deg: number(rot_deg)?,
            trans: number(trans)?,
            scale_rel: number(scale_rel)?,
        })
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Self::ALL.iter().filter(|(status, _)| status == self).try_for_each(|(_, name)| f.write_str(name))
    }
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Problem { group, n, ratio, seed } = &self.problem;
        write!(
            f,
            "{},{group},{n},{ratio},{seed},{},{:.6},{:.5},{:.6},{:.6}",
            self.solver, self.status, self.cpu_s, self.rot_deg, self.trans, self.scale_rel
        )
    }
}
