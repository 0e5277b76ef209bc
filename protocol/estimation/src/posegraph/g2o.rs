//! g2o text files (Kümmerle et al. 2011): decides which lines make a sound pose graph.
//!
//! Read: `VERTEX_SE3:QUAT`, `EDGE_SE3:QUAT`, `VERTEX_SE2`, `EDGE_SE2`, `FIX`, comments; `PARAMS_*` is skipped. The
//! information of rotations is taken on the rotation vector, as GTSAM and SE-Sync do. Planar measurements become
//! spatial ones that hold the plane: their information out of the plane is as large as the largest within it, and its
//! value does not matter to the estimate, because nothing in the plane pulls out of it.

use super::fault::PoseName;
use super::identity::Owners;
pub use super::identity::Shared;
use super::lines::{Files, without_mark};
use super::{MEASUREMENTS_MAX, Measurement, POSES_MAX, PoseGraph, isotropic_weights, printed_matrix};
use crate::geometry::so3::So3;
use crate::geometry::{Se3, se3};
use crate::ids::Hash;
use core::fmt;
use nalgebra::{Matrix3, Matrix6, Vector3};
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::fmt::Write as _;
use thiserror::Error;

/// Longest line, in bytes.
pub const LINE_MAX: usize = 4096;
/// Largest number that a pose has among its robot's.
pub const NUMBER_MAX: u64 = (1 << 56) - 1;
/// How far a quaternion's norm may be from 1 before it is no rounding.
const QUATERNION_NORM_SLACK: f64 = 1e-2;
/// Longest coordinate, m: beyond it a double does not tell a tenth of a millimetre, and squares soon overflow.
pub const LENGTH_MAX: f64 = 1e12;

/// A line that cannot be part of a pose graph.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("line {line}: {what}")]
pub struct G2oError {
    /// Which line, from 1.
    pub line: usize,
    /// What is wrong with it, and how to mend it.
    pub what: Fault,
}

/// What is wrong with a line.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum Fault {
    /// A tag this format does not have here.
    #[error("unknown tag {0:?}; pose graphs hold VERTEX_SE3:QUAT, EDGE_SE3:QUAT, VERTEX_SE2 and EDGE_SE2 lines")]
    Tag(String),
    /// Too few or too many fields.
    #[error("{got} fields after the tag, {want} wanted")]
    Fields {
        /// As they should be.
        want: usize,
        /// As they are.
        got: usize,
    },
    /// A field that is no number.
    #[error("{0:?} is no finite number")]
    Number(String),
    /// A coordinate that is out of range.
    #[error("{0:e} m is more than {LENGTH_MAX:e} m; check its unit")]
    Far(f64),
    /// A pose's name that is no whole number.
    #[error("{0:?} is no pose id; ids are whole numbers from 0")]
    Id(String),
    /// A quaternion that is none.
    #[error("the quaternion has norm {0:.3}, not 1; write it as x y z w of norm 1")]
    Quaternion(f64),
    /// An information matrix that is none.
    #[error(
        "the information matrix has a singular block; give directions that are not measured a small positive value"
    )]
    Information,
    /// Both ends are one pose.
    #[error("measures pose {0} against itself; leave the line out")]
    SelfLoop(u64),
    /// A pose told twice.
    #[error("pose {0} is told twice, with two values; leave one out")]
    Twice(u64),
    /// Another file states otherwise what one robot alone states.
    #[error(
        "{} otherwise than an earlier file: two robots that number their poses alike? Give each robot's ids a letter \
         of its own in the top byte; parts of one robot's graph put into one file",
        Stated(*.0)
    )]
    Otherwise([u64; 2], usize),
    /// Planar and spatial lines in one file.
    #[error("mixes planar and spatial lines; keep to one of SE2 and SE3:QUAT")]
    Mixed,
    /// Lines that do not end as text files' do.
    #[error("lines end in CR alone; make them end in LF, for example with `tr '\\r' '\\n'`")]
    CarriageReturn,
    /// Bytes that are no text.
    #[error("this is no UTF-8 text; save the file as UTF-8")]
    Text,
    /// A line that is too long.
    #[error("longer than {LINE_MAX} bytes")]
    Long,
    /// Too many poses.
    #[error("more than {POSES_MAX} poses; split the graph")]
    Poses,
    /// Too many measurements.
    #[error("more than {MEASUREMENTS_MAX} measurements; split the graph")]
    Measurements,
}

/// What a line states, by its two poses; a value has its pose for both.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stated(pub [u64; 2]);

impl fmt::Display for Stated {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            [i, j] if i == j => write!(f, "states {}", PoseName(i)),
            [i, j] => write!(f, "measures {} from {}", PoseName(j), PoseName(i)),
        }
    }
}

/// Measurements that a file repeats to the bit. Each counts, as if it had been made so often.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Repeated {
    /// How many repeat another.
    pub count: usize,
    /// The first such [`Measurement::line`].
    pub line: usize,
}

/// Reads a file line by line.
#[derive(Clone, Debug, Default)]
pub struct Parser {
    graph: PoseGraph,
    files: Files,
    /// Measurements of the files before this one.
    earlier: usize,
    /// The first of the measurements that are equal, by their [`digest`].
    seen: BTreeMap<[u8; 16], usize>,
    repeated: Option<Repeated>,
    owners: Owners,
    planar: Option<bool>,
}

impl Parser {
    /// Begins the next file of the same graph: lines count from 1 again. A measurement between two robots stands in the
    /// files of both; what an earlier file holds to the bit is not taken again.
    pub fn begin(&mut self) {
        self.files.begin();
        self.owners.begin();
        self.earlier = self.graph.measurements.len();
    }

    /// Takes the next line.
    ///
    /// # Errors
    /// [`G2oError`] with its number; nothing of the line is taken then.
    pub fn line(&mut self, text: &str) -> Result<(), G2oError> {
        let line = self.files.advance();
        self.take(without_mark(text, line)).map_err(|what| G2oError { line, what })
    }

    /// Where the lines are that measurements name.
    pub fn files(&self) -> &Files {
        &self.files
    }

    /// Whether a file holds a measurement more than once.
    pub fn repeated(&self) -> Option<Repeated> {
        self.repeated
    }

    /// Of a robot (the top byte of its poses' ids, 0 where there is no letter), the poses of which several files say
    /// something. They are taken for the same.
    pub fn shared(&self, robot: u8) -> Option<Shared> {
        self.owners.shared(robot)
    }

    /// The graph so far.
    pub fn finish(mut self) -> PoseGraph {
        self.graph.planar = self.planar.unwrap_or_default();
        self.graph
    }

    fn take(&mut self, text: &str) -> Result<(), Fault> {
        if text.trim_end().contains('\r') {
            return Err(Fault::CarriageReturn);
        }
        if text.len() > LINE_MAX {
            return Err(Fault::Long);
        }
        let mut words = text.split_whitespace();
        let Some(tag) = words.next() else { return Ok(()) };
        let fields: Vec<&str> = words.collect();
        match tag {
            _ if tag.starts_with('#') || tag.starts_with("PARAMS_") => Ok(()),
            "FIX" => {
                let ids = fields.iter().map(|text| text.parse().map_err(|_| Fault::Id(cut(text))));
                let ids = ids.collect::<Result<Vec<u64>, Fault>>()?;
                if self.graph.fixed.len() + ids.len() > POSES_MAX {
                    return Err(Fault::Poses);
                }
                self.graph.fixed.extend(ids);
                Ok(())
            }
            "VERTEX_SE3:QUAT" => {
                let ([id], numbers) = parsed::<1, 7>(&fields)?;
                self.pose(id, pose(&numbers)?, false)
            }
            "VERTEX_SE2" => {
                let ([id], numbers) = parsed::<1, 3>(&fields)?;
                self.pose(id, planar_pose(&numbers)?, true)
            }
            "EDGE_SE3:QUAT" => {
                let (ends, numbers) = parsed::<2, 28>(&fields)?;
                let information = symmetric::<6>(&numbers[7..]);
                let (kappa, tau) = isotropic_weights(&information).ok_or(Fault::Information)?;
                let printed = printed_matrix([numbers[3], numbers[4], numbers[5], numbers[6]]);
                self.measurement(ends, (pose(&numbers)?, printed), information, (kappa, tau), false)
            }
            "EDGE_SE2" => {
                let (ends, numbers) = parsed::<2, 9>(&fields)?;
                let (information, weights) = from_plane(&symmetric::<3>(&numbers[3..])).ok_or(Fault::Information)?;
                let t_i_j = planar_pose(&numbers)?;
                self.measurement(ends, (t_i_j, t_i_j.rotation.matrix()), information, weights, true)
            }
            _ if tag.contains(['\0', char::REPLACEMENT_CHARACTER]) => Err(Fault::Text),
            _ => Err(Fault::Tag(cut(tag))),
        }
    }

    fn pose(&mut self, id: u64, value: Se3, planar: bool) -> Result<(), Fault> {
        self.of_kind(planar)?;
        self.room_for(&[id])?;
        let earlier = self.owners.value(id, self.files.last());
        match self.graph.poses.get(&id).copied().flatten() {
            Some(known) if known == value => return Ok(()),
            Some(_) => {
                self.owners.name(&[id]);
                return Err(earlier.map_or(Fault::Twice(id), |line| Fault::Otherwise([id, id], line)));
            }
            None => self.owners.name(&[id]),
        }
        self.graph.poses.insert(id, Some(value));
        Ok(())
    }

    fn measurement(
        &mut self,
        [i, j]: [u64; 2],
        (t_i_j, printed): (Se3, Matrix3<f64>),
        information: Matrix6<f64>,
        (kappa, tau): (f64, f64),
        planar: bool,
    ) -> Result<(), Fault> {
        self.of_kind(planar)?;
        if i == j {
            return Err(Fault::SelfLoop(i));
        }
        if self.graph.measurements.len() == MEASUREMENTS_MAX {
            return Err(Fault::Measurements);
        }
        self.room_for(&[i, j])?;
        let (seen, line) = (self.seen.entry(digest([i, j], &t_i_j, &information)), self.files.last());
        if matches!(&seen, Entry::Occupied(first) if *first.get() < self.earlier) {
            return Ok(());
        }
        self.owners.name(&[i, j]);
        if let Some(earlier) = self.owners.measurement([i, j], line) {
            return Err(Fault::Otherwise([i, j], earlier));
        }
        match seen {
            Entry::Occupied(_) => self.repeated.get_or_insert(Repeated { count: 0, line }).count += 1,
            Entry::Vacant(first) => _ = first.insert(self.graph.measurements.len()),
        }
        self.graph.poses.entry(i).or_default();
        self.graph.poses.entry(j).or_default();
        self.graph.measurements.push(Measurement { i, j, t_i_j, printed, information, kappa, tau, line });
        Ok(())
    }

    fn of_kind(&mut self, planar: bool) -> Result<(), Fault> {
        if *self.planar.get_or_insert(planar) == planar { Ok(()) } else { Err(Fault::Mixed) }
    }

    fn room_for(&self, ids: &[u64]) -> Result<(), Fault> {
        let new = ids.iter().filter(|id| !self.graph.poses.contains_key(id)).count();
        if self.graph.poses.len() + new > POSES_MAX { Err(Fault::Poses) } else { Ok(()) }
    }
}

/// What tells a measurement from others: half a BLAKE3 hash of its ends and numbers. A file may hold any number between
/// the same two poses.
fn digest(ends: [u64; 2], t_i_j: &Se3, information: &Matrix6<f64>) -> [u8; 16] {
    let (at, turn) = (t_i_j.translation, t_i_j.rotation.xyzw());
    let numbers = at.iter().chain(&turn).chain(information).copied();
    let mut bytes: Vec<u8> = ends.into_iter().flat_map(u64::to_le_bytes).collect();
    // A negative zero equals zero.
    for number in numbers.map(|number: f64| number + 0.0) {
        bytes.extend(number.to_le_bytes());
    }
    let Hash(hash) = Hash::of(&bytes);
    core::array::from_fn(|k| hash[k])
}

/// Ids, then numbers.
fn parsed<const I: usize, const N: usize>(fields: &[&str]) -> Result<([u64; I], [f64; N]), Fault> {
    if fields.len() != I + N {
        return Err(Fault::Fields { want: I + N, got: fields.len() });
    }
    let (mut ids, mut numbers) = ([0; I], [0.0; N]);
    for (out, text) in ids.iter_mut().zip(fields) {
        *out = text.parse().map_err(|_| Fault::Id(cut(text)))?;
    }
    for (out, text) in numbers.iter_mut().zip(&fields[I..]) {
        let number = text.parse::<f64>().ok().filter(|x| x.is_finite());
        *out = number.ok_or_else(|| Fault::Number(cut(text)))?;
    }
    Ok((ids, numbers))
}

fn cut(text: &str) -> String {
    text.chars().take(40).collect()
}

fn pose(numbers: &[f64]) -> Result<Se3, Fault> {
    let xyzw = [numbers[3], numbers[4], numbers[5], numbers[6]];
    let norm = xyzw.iter().map(|x| x * x).sum::<f64>().sqrt();
    if (norm - 1.0).abs() > QUATERNION_NORM_SLACK {
        return Err(Fault::Quaternion(norm));
    }
    in_range(&numbers[..3])?;
    Se3::from_xyzw(xyzw.map(|x| x / norm), [numbers[0], numbers[1], numbers[2]]).ok_or(Fault::Quaternion(norm))
}

fn planar_pose(numbers: &[f64]) -> Result<Se3, Fault> {
    in_range(&numbers[..2])?;
    Ok(Se3::new(So3::exp(&Vector3::new(0.0, 0.0, numbers[2])), Vector3::new(numbers[0], numbers[1], 0.0)))
}

fn in_range(coordinates: &[f64]) -> Result<(), Fault> {
    let far = coordinates.iter().find(|x| x.abs() > LENGTH_MAX);
    far.map_or(Ok(()), |&x| Err(Fault::Far(x)))
}

/// A symmetric matrix from its upper triangle, row by row.
fn symmetric<const N: usize>(upper: &[f64]) -> nalgebra::SMatrix<f64, N, N> {
    let mut out = nalgebra::SMatrix::zeros();
    let cells = (0..N).flat_map(|r| (r..N).map(move |c| (r, c)));
    for ((r, c), &x) in cells.zip(upper) {
        out[(r, c)] = x;
        out[(c, r)] = x;
    }
    out
}

/// The spatial information and SE-Sync's weights (κ, τ) of planar information in (x, y, θ): `τ = 2/tr(Σ_t)`, κ the
/// information of the angle.
fn from_plane(planar: &Matrix3<f64>) -> Option<(Matrix6<f64>, (f64, f64))> {
    planar.cholesky()?;
    let trace = planar.fixed_view::<2, 2>(0, 0).into_owned().try_inverse()?.trace();
    let (stiff_t, stiff_r) = (planar[(0, 0)].max(planar[(1, 1)]), planar[(2, 2)]);
    let mut out =
        Matrix6::from_diagonal(&se3::join(&Vector3::new(0.0, 0.0, stiff_t), &Vector3::new(stiff_r, stiff_r, 0.0)));
    let places = [0, 1, 5];
    for (r, &row) in places.iter().enumerate() {
        for (c, &column) in places.iter().enumerate() {
            out[(row, column)] = planar[(r, c)];
        }
    }
    let (kappa, tau) = (planar[(2, 2)], 2.0 / trace);
    // As of spatial ones: a variance that overflows leaves no weight.
    (kappa.is_finite() && tau.is_finite() && kappa > 0.0 && tau > 0.0).then_some((out, (kappa, tau)))
}

/// A graph as a g2o file: poses with a value, those that are fixed, then measurements. Planar graphs are written as
/// such.
pub fn write(graph: &PoseGraph) -> String {
    let mut out = String::new();
    for (id, value) in &graph.poses {
        if let Some(value) = value {
            let _ = if graph.planar {
                writeln!(out, "VERTEX_SE2 {id} {}", plane_numbers(value))
            } else {
                writeln!(out, "VERTEX_SE3:QUAT {id} {}", pose_numbers(value))
            };
        }
    }
    for id in graph.fixed.iter().filter(|id| graph.poses.contains_key(id)) {
        let _ = writeln!(out, "FIX {id}");
    }
    for m in &graph.measurements {
        let places: &[usize] = if graph.planar { &[0, 1, 5] } else { &[0, 1, 2, 3, 4, 5] };
        let (tag, numbers) = match graph.planar {
            true => ("EDGE_SE2", plane_numbers(&m.t_i_j)),
            false => ("EDGE_SE3:QUAT", pose_numbers(&m.t_i_j)),
        };
        let _ = write!(out, "{tag} {} {} {numbers}", m.i, m.j);
        for (k, &r) in places.iter().enumerate() {
            for &c in &places[k..] {
                let _ = write!(out, " {}", m.information[(r, c)]);
            }
        }
        out.push('\n');
    }
    out
}

/// Poses of one robot as a TUM trajectory, in place of the time the number of the pose: its id without the robot's
/// byte, with which it would be no number that a double holds.
pub fn write_tum<'a>(poses: impl IntoIterator<Item = (&'a u64, &'a Se3)>) -> String {
    let mut out = String::new();
    for (id, value) in poses {
        let _ = writeln!(out, "{} {}", number_of(*id), pose_numbers(value));
    }
    out
}

/// The number of a pose among its robot's: its id without the top byte.
pub fn number_of(id: u64) -> u64 {
    id & NUMBER_MAX
}

/// `x y z qx qy qz qw`.
fn pose_numbers(t: &Se3) -> String {
    let (p, [x, y, z, w]) = (t.translation, t.rotation.xyzw());
    format!("{} {} {} {x} {y} {z} {w}", p.x, p.y, p.z)
}

/// `x y θ`.
fn plane_numbers(t: &Se3) -> String {
    format!("{} {} {}", t.translation.x, t.translation.y, t.rotation.log().z)
}
