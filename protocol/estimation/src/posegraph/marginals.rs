//! Poses with their covariances as a table (CSV): decides which rows are sound estimates, and what two such tables say
//! together whose makers may have used the same measurements.
//!
//! Columns: `id, origin, x, y, z, qx, qy, qz, qw`, then the upper triangle of the covariance of the local perturbation
//! (ρ, φ), row by row, `c11` to `c66`. It is the pose's covariance given where `origin` is, a pose of the same
//! connected part, which therefore tells parts apart. Lengths are metres, angles radians; lines that begin with `#` are
//! comments.

use super::POSES_MAX;
use super::fault::PoseName;
use super::g2o::LINE_MAX;
use super::lines::without_mark;
use crate::geometry::split_ci::{FuseError, SplitError, SplitEstimate};
use crate::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3};
use nalgebra::Matrix6;
use std::collections::BTreeMap;
use std::fmt::Write;
use thiserror::Error;

/// The first line of a table.
const HEADER: &str = "id,origin,x,y,z,qx,qy,qz,qw,c11,c12,c13,c14,c15,c16,c22,c23,c24,c25,c26,c33,c34,c35,c36,c44,c45,\
                      c46,c55,c56,c66";
/// Numbers in a row after both ids.
const NUMBERS: usize = 7 + 21;
/// How far a quaternion's norm may be from 1 before it is no rounding.
const QUATERNION_NORM_SLACK: f64 = 1e-6;
/// How far an origin may be from where the other table has it (m, rad): what rounding and printing leave.
const ORIGIN_SLACK: f64 = 1e-6;

/// A pose with its covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Marginal {
    /// The pose's name.
    pub id: u64,
    /// The pose that the covariance is relative to.
    pub origin: u64,
    /// `t_world_pose`, and its covariance given `t_world_origin`.
    pub estimate: PoseWithCovariance,
    /// Its line in the table it was read from, from 1; 0 if it was not.
    pub line: usize,
}

/// A row that is no estimate of a pose.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("line {line}: {what}")]
pub struct MarginalError {
    /// Which line, from 1.
    pub line: usize,
    /// What is wrong with it, and how to mend it.
    pub what: MarginalFault,
}

/// What is wrong with a row.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum MarginalFault {
    /// The first line is not that of such a table.
    #[error("the first line is not `id,origin,x,y,z,qx,qy,qz,qw,c11,…,c66`; write the table with --marginals")]
    Header,
    /// Too few or too many fields.
    #[error("{0} fields, {want} wanted", want = NUMBERS + 2)]
    Fields(usize),
    /// A field that is no finite number.
    #[error("{0:?} is no finite number")]
    Number(String),
    /// A name that is no whole number.
    #[error("{0:?} is no pose id; ids are whole numbers from 0")]
    Id(String),
    /// A quaternion that is none.
    #[error("the quaternion has norm {0:.6}, not 1; write it as x, y, z, w of norm 1")]
    Quaternion(f64),
    /// A covariance that is none.
    #[error(transparent)]
    Covariance(#[from] CovarianceError),
    /// A pose told twice.
    #[error("{} is told twice, first in line {}; leave one out", PoseName(*.0), .1)]
    Twice(u64, usize),
    /// A line that is too long.
    #[error("longer than {LINE_MAX} bytes")]
    Long,
    /// Too many poses.
    #[error("more than {POSES_MAX} poses; split the table")]
    Poses,
}

/// Reads a table line by line.
#[derive(Clone, Debug, Default)]
pub struct Reader {
    rows: BTreeMap<u64, Marginal>,
    line: usize,
    headed: bool,
}

impl Reader {
    /// Takes the next line.
    ///
    /// # Errors
    /// [`MarginalError`] with its number; nothing of the line is taken then.
    pub fn line(&mut self, text: &str) -> Result<(), MarginalError> {
        self.line += 1;
        self.take(without_mark(text, self.line)).map_err(|what| MarginalError { line: self.line, what })
    }

    /// The rows by their poses.
    pub fn finish(self) -> BTreeMap<u64, Marginal> {
        self.rows
    }

    fn take(&mut self, text: &str) -> Result<(), MarginalFault> {
        if text.len() > LINE_MAX {
            return Err(MarginalFault::Long);
        }
        let text = text.trim();
        if text.is_empty() || text.starts_with('#') {
            return Ok(());
        }
        let fields: Vec<&str> = text.split(',').map(str::trim).collect();
        if !self.headed {
            self.headed = fields.iter().copied().eq(HEADER.split(','));
            return if self.headed { Ok(()) } else { Err(MarginalFault::Header) };
        }
        let row = row(&fields, self.line)?;
        if let Some(known) = self.rows.get(&row.id) {
            return Err(MarginalFault::Twice(row.id, known.line));
        }
        if self.rows.len() == POSES_MAX {
            return Err(MarginalFault::Poses);
        }
        self.rows.insert(row.id, row);
        Ok(())
    }
}

fn row(fields: &[&str], line: usize) -> Result<Marginal, MarginalFault> {
    let [id, origin, numbers @ ..] = fields else { return Err(MarginalFault::Fields(fields.len())) };
    if numbers.len() != NUMBERS {
        return Err(MarginalFault::Fields(fields.len()));
    }
    let cut = |text: &str| text.chars().take(40).collect::<String>();
    let name = |text: &str| text.parse::<u64>().map_err(|_| MarginalFault::Id(cut(text)));
    let (id, origin) = (name(id)?, name(origin)?);
    let mut values = [0.0; NUMBERS];
    for (out, text) in values.iter_mut().zip(numbers) {
        let number = text.parse::<f64>().ok().filter(|x| x.is_finite());
        *out = number.ok_or_else(|| MarginalFault::Number(cut(text)))?;
    }
    let [x, y, z, qx, qy, qz, qw, upper @ ..] = values;
    let norm = [qx, qy, qz, qw].iter().map(|q| q * q).sum::<f64>().sqrt();
    let pose = Se3::from_xyzw([qx, qy, qz, qw].map(|q| q / norm), [x, y, z]);
    let is_unit = (norm - 1.0).abs() <= QUATERNION_NORM_SLACK;
    let pose = pose.filter(|_| is_unit).ok_or(MarginalFault::Quaternion(norm))?;
    let mut covariance = Matrix6::zeros();
    for ((r, c), value) in upper_triangle().zip(upper) {
        covariance[(r, c)] = value;
        covariance[(c, r)] = value;
    }
    let estimate = PoseWithCovariance { pose, covariance: Covariance::new(covariance)? };
    Ok(Marginal { id, origin, estimate, line })
}

/// Rows and columns of the upper triangle, row by row.
fn upper_triangle() -> impl Iterator<Item = (usize, usize)> {
    (0..6).flat_map(|r| (r..6).map(move |c| (r, c)))
}

/// The table of these rows, in their order.
pub fn write<'a>(rows: impl IntoIterator<Item = &'a Marginal>) -> String {
    let mut out = format!("{HEADER}\n");
    for row in rows {
        let (p, [x, y, z, w]) = (row.estimate.pose.translation, row.estimate.pose.rotation.xyzw());
        let _ = write!(out, "{},{},{},{},{},{x},{y},{z},{w}", row.id, row.origin, p.x, p.y, p.z);
        for (r, c) in upper_triangle() {
            let _ = write!(out, ",{:e}", row.estimate.covariance.matrix()[(r, c)]);
        }
        out.push('\n');
    }
    out
}

/// Two tables that were not fused, because of one pose.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("{}: {what}", PoseName(*.id))]
pub struct TablesError {
    /// The pose.
    pub id: u64,
    /// Its lines in both tables.
    pub lines: [usize; 2],
    /// What is wrong with it.
    pub what: TablesFault,
}

/// Why a pose of two tables cannot be fused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum TablesFault {
    /// The estimates contradict each other.
    #[error(transparent)]
    Fuse(#[from] FuseError),
    /// The share of the covariance that is independent is none.
    #[error(transparent)]
    Share(#[from] SplitError),
    /// Covariances relative to different poses.
    #[error(
        "its covariances are relative to different poses, {} and {}; solve both graphs with the same pose fixed",
        PoseName(*.0), PoseName(*.1)
    )]
    Origins(u64, u64),
    /// The pose that all others are relative to lies elsewhere.
    #[error(
        "all others are relative to it, and the tables have it {0:.1e} (m, rad) apart; bring both into one frame first"
    )]
    Apart(f64),
}

/// What became of two tables.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tables {
    /// The poses of either, by their names.
    pub rows: Vec<Marginal>,
    /// How many are in both, and were fused or are their common origin.
    pub both: usize,
    /// How many only the first and only the second has, and are as they were.
    pub only: [usize; 2],
}

/// Fuses two tables, pose by pose, by split covariance intersection ([`crate::geometry::split_ci`]): of each covariance
/// a share is independent of the other table, the rest may be correlated with it in any way.
///
/// # Errors
/// [`TablesError`] for the first pose of which the tables cannot both be right.
pub fn fuse(a: &BTreeMap<u64, Marginal>, b: &BTreeMap<u64, Marginal>, independent: f64) -> Result<Tables, TablesError> {
    let mut out = Tables::default();
    let mut rows = b.clone();
    for (&id, of_a) in a {
        let row = match rows.remove(&id) {
            None => {
                out.only[0] += 1;
                *of_a
            }
            Some(of_b) => {
                out.both += 1;
                let fused = fused(of_a, &of_b, independent);
                fused.map_err(|what| TablesError { id, lines: [of_a.line, of_b.line], what })?
            }
        };
        out.rows.push(row);
    }
    out.only[1] = rows.len();
    out.rows.extend(rows.into_values());
    out.rows.sort_by_key(|row| row.id);
    Ok(out)
}

fn fused(a: &Marginal, b: &Marginal, independent: f64) -> Result<Marginal, TablesFault> {
    if a.origin != b.origin {
        return Err(TablesFault::Origins(a.origin, b.origin));
    }
    if a.id == a.origin {
        // Its covariance is none: it says where the others are measured from.
        let apart = a.estimate.pose.local(&b.estimate.pose).norm();
        return if apart <= ORIGIN_SLACK { Ok(*a) } else { Err(TablesFault::Apart(apart)) };
    }
    let split = |one: &Marginal| SplitEstimate::with_share(&one.estimate, independent);
    let fused = split(a)?.fuse(&split(b)?)?;
    Ok(Marginal { estimate: fused.estimate.estimate(), line: 0, ..*a })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sampling::{covariance, draw, pose, rng};

    fn table(seed: u64, poses: u64) -> BTreeMap<u64, Marginal> {
        let rng = &mut rng(seed);
        let row = |k: u64| {
            let estimate = PoseWithCovariance { pose: pose(rng), covariance: covariance(rng) };
            (10 + k, Marginal { id: 10 + k, origin: 10, estimate, line: 2 + k as usize })
        };
        (0..poses).map(row).collect()
    }

    fn read(text: &str) -> Result<BTreeMap<u64, Marginal>, MarginalError> {
        let mut reader = Reader::default();
        text.lines().try_for_each(|line| reader.line(line))?;
        Ok(reader.finish())
    }

    #[test]
    fn a_table_reads_back() {
        let rows = table(1, 5);
        let text = write(rows.values());
        assert_eq!(text.lines().next().unwrap().split(',').count(), NUMBERS + 2);
        let again = read(&text).unwrap();
        for (a, b) in rows.values().zip(again.values()) {
            assert_eq!((a.id, a.origin, a.line), (b.id, b.origin, b.line));
            assert_eq!(a.estimate.covariance, b.estimate.covariance, "to the bit");
            assert!(a.estimate.pose.local(&b.estimate.pose).norm() < 1e-14);
        }
        assert_eq!(read(&format!("\u{feff}{text}")).unwrap(), again);
        assert!(read("# nothing\n\n").unwrap().is_empty());
    }

    #[test]
    fn faults_name_their_line_and_what_to_do() {
        let text = write(table(2, 2).values());
        let line = text.lines().nth(2).unwrap();
        let fields: Vec<&str> = line.split(',').collect();
        let with = |k: usize, field: &str| {
            let mut fields = fields.clone();
            fields[k] = field;
            let error = read(&text.replace(line, &fields.join(","))).unwrap_err();
            assert_eq!(error.line, 3);
            error.what
        };
        assert_eq!(with(0, "-1"), MarginalFault::Id("-1".into()));
        assert_eq!(with(0, "10"), MarginalFault::Twice(10, 2));
        assert_eq!(with(1, "x"), MarginalFault::Id("x".into()));
        assert_eq!(with(3, "NaN"), MarginalFault::Number("NaN".into()));
        assert!(matches!(with(8, "2"), MarginalFault::Quaternion(_)));
        assert_eq!(with(9, "-1"), MarginalFault::Covariance(CovarianceError::OutOfRange));
        assert_eq!(with(10, "1,1"), MarginalFault::Fields(31));
        assert_eq!(read("10,10,1").unwrap_err(), MarginalError { line: 1, what: MarginalFault::Header });
        assert_eq!(read(&"x".repeat(LINE_MAX + 1)).unwrap_err().what, MarginalFault::Long);
    }

    #[test]
    fn tables_are_fused_by_their_poses() {
        let rng = &mut rng(3);
        let all = table(3, 6);
        let moved = |row: &Marginal| match row.id {
            10 => *row,
            _ => {
                let pose = row.estimate.pose.retract(&draw(rng, &row.estimate.covariance));
                Marginal { estimate: PoseWithCovariance { pose, ..row.estimate }, ..*row }
            }
        };
        let mut other: BTreeMap<u64, Marginal> = all.values().map(moved).map(|row| (row.id, row)).collect();
        let mut one = all.clone();
        one.remove(&15);
        other.remove(&12);
        let out = fuse(&one, &other, 0.0).unwrap();
        assert_eq!((out.both, out.only), (4, [1, 1]));
        assert!(out.rows.iter().map(|row| row.id).eq(10..16));
        assert_eq!((out.rows[0], out.rows[2]), (one[&10], one[&12]));
        assert_eq!(out.rows[5], other[&15]);
        // Equal covariances: in common, nothing is gained; independent, half is.
        for (share, gain) in [(0.0, 1.0), (1.0, 0.5)] {
            let out = fuse(&one, &other, share).unwrap();
            let (got, want) = (out.rows[1].estimate.covariance, one[&11].estimate.covariance);
            let ratio = got.matrix().determinant() / want.matrix().determinant();
            assert!((libm::pow(ratio, 1.0 / 6.0) / gain - 1.0).abs() < 0.1, "{ratio}");
        }
    }

    #[test]
    fn tables_that_contradict_each_other_are_refused() {
        let one = table(4, 3);
        let with = |id: u64, change: &dyn Fn(&mut Marginal)| {
            let mut other = one.clone();
            change(other.get_mut(&id).unwrap());
            fuse(&one, &other, 0.0).unwrap_err()
        };
        let far = nalgebra::Vector6::new(0.0, 0.0, 50.0, 0.0, 0.0, 0.0);
        let moved = |row: &mut Marginal| row.estimate.pose = row.estimate.pose.retract(&far);
        assert!(matches!(
            with(12, &moved),
            TablesError { id: 12, lines: [4, 4], what: TablesFault::Fuse(FuseError::Disagree(_)) }
        ));
        assert!(matches!(with(10, &moved).what, TablesFault::Apart(_)));
        assert_eq!(with(11, &|row| row.origin = 11).what, TablesFault::Origins(10, 11));
        assert!(matches!(fuse(&one, &one, 2.0).unwrap_err().what, TablesFault::Share(_)));
    }
}
