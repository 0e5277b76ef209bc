//! A recorded trajectory that simulated robots drive along: lines `stamp x y z qx qy qz qw` (TUM; KITTI's LiDAR poses
//! have an index for a stamp), packed (`.xz`) or not. Robots drive on flat ground, so only x and y are taken, and the
//! first point becomes the origin. How the body was turned is not taken either: a robot looks where it drives.

use super::path::Path;
use std::io::Read;
use std::path::{Path as FilePath, PathBuf};
use thiserror::Error;

/// Longest file, unpacked, bytes.
pub const BYTES_MAX: u64 = 64 << 20;
/// Widest and deepest trajectory, m: the world's grid has a cell for each square metre.
pub const SIDE_MAX_M: f64 = 2_000.0;
/// Longest drive, m: whatever is built is kept off every metre of it.
pub const LENGTH_MAX_M: f64 = 50_000.0;
/// Shortest stretch for one robot, m.
pub const STRETCH_MIN_M: f64 = 10.0;
/// Points closer than this to the one before are left out: whoever stands still turns by the noise of his poses alone,
/// m.
const STILL_M: f64 = 0.3;
/// A jump longer than this is no drive, m.
const JUMP_MAX_M: f64 = 50.0;

/// Where somebody drove.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    name: String,
    points: Vec<[f64; 2]>,
}

/// Why a trajectory cannot be driven.
#[derive(Debug, Error)]
pub enum TrajectoryError {
    /// The file.
    #[error("{path}: {source}")]
    Io {
        /// Which.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// What the file holds.
    #[error("{path}: {what}")]
    Content {
        /// Which.
        path: PathBuf,
        /// What is wrong, where, and how to mend it.
        what: String,
    },
}

impl Trajectory {
    /// Reads a file, unpacking it if its name ends in `.xz`.
    ///
    /// # Errors
    /// [`TrajectoryError`]: the file, the first line that is no pose, or a drive that is too short or too wide.
    pub fn read(path: &FilePath) -> Result<Self, TrajectoryError> {
        let io = |source| TrajectoryError::Io { path: path.to_owned(), source };
        let file = std::fs::File::open(path).map_err(io)?;
        let mut text = String::new();
        let read = if path.extension().is_some_and(|extension| extension == "xz") {
            lzma_rust2::XzReader::new(file, true).take(BYTES_MAX + 1).read_to_string(&mut text)
        } else {
            file.take(BYTES_MAX + 1).read_to_string(&mut text)
        };
        read.map_err(io)?;
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        Self::parse(&name, &text).map_err(|what| TrajectoryError::Content { path: path.to_owned(), what })
    }

    /// What the file is called.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Cuts the drive into `robots` stretches of one length, each robot's its own; the first robot's comes first.
    ///
    /// # Errors
    /// [`TrajectoryError::Content`] if that leaves a robot less than [`STRETCH_MIN_M`].
    pub fn cut(&self, robots: usize) -> Result<Vec<Path>, TrajectoryError> {
        let whole = Path::along(&self.points);
        let stretch = whole.length() / robots.max(1) as f64;
        if stretch < STRETCH_MIN_M {
            let what = format!(
                "{:.0} m for {robots} robots; each needs {STRETCH_MIN_M:.0} m: take fewer robots or a longer drive",
                whole.length()
            );
            return Err(TrajectoryError::Content { path: self.name.clone().into(), what });
        }
        Ok((0..robots).map(|k| whole.stretch(k as f64 * stretch, (k + 1) as f64 * stretch)).collect())
    }

    fn parse(name: &str, text: &str) -> Result<Self, String> {
        if text.len() as u64 > BYTES_MAX {
            return Err(format!("holds more than {} MiB of text; cut it", BYTES_MAX >> 20));
        }
        let mut points: Vec<[f64; 2]> = Vec::new();
        let mut first = None;
        let mut length = 0.0;
        for (index, line) in text.lines().enumerate() {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            let at = |what: String| format!("line {}: {what}", index + 1);
            let [x, y] = point(line).map_err(at)?;
            let [x0, y0] = *first.get_or_insert([x, y]);
            let here = [x - x0, y - y0];
            let moved = points.last().map_or(f64::INFINITY, |last| libm::hypot(here[0] - last[0], here[1] - last[1]));
            if !points.is_empty() && moved > JUMP_MAX_M {
                return Err(at(format!(
                    "jumps by {moved:.0} m; give one drive, no pose farther than {JUMP_MAX_M:.0} m"
                )));
            }
            if moved >= STILL_M {
                length += if points.is_empty() { 0.0 } else { moved };
                points.push(here);
            }
            if length > LENGTH_MAX_M {
                return Err(at(format!("goes on beyond {:.0} km; cut it", LENGTH_MAX_M / 1e3)));
            }
        }
        let side = |axis: usize| {
            let of = |fold: fn(f64, f64) -> f64| points.iter().map(|p| p[axis]).fold(0.0, fold);
            of(f64::max) - of(f64::min)
        };
        let widest = side(0).max(side(1));
        if widest > SIDE_MAX_M {
            return Err(format!("reaches over {widest:.0} m; at most {SIDE_MAX_M:.0} m: cut it"));
        }
        if points.len() < 2 {
            return Err("no drive: give lines `stamp x y z qx qy qz qw`, at least two of different places".to_owned());
        }
        Ok(Self { name: name.to_owned(), points })
    }
}

fn point(line: &str) -> Result<[f64; 2], String> {
    let words: Vec<&str> = line.split_ascii_whitespace().collect();
    if words.len() != 8 {
        return Err(format!("{} columns; a pose is `stamp x y z qx qy qz qw`", words.len()));
    }
    let number = |word: &str| match word.parse::<f64>() {
        // Metres in any earthly grid, and no sum of them overflows.
        Ok(number) if number.abs() < 1e9 => Ok(number),
        _ => Err(format!("{word:?} is no number of metres below 1e9")),
    };
    Ok([number(words[1])?, number(words[2])?])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An L of 100 m, a pose a metre, standing still at the corner.
    fn an_l() -> String {
        let east = (0..=50).map(|k| [f64::from(k), 0.0]);
        let still = (0..10).map(|k| [50.0 + 0.001 * f64::from(k), 0.0]);
        let north = (1..=50).map(|k| [50.0, f64::from(k)]);
        let line = |(k, [x, y]): (usize, [f64; 2])| format!("{k} {} {} 7 0 0 0 1\n", x + 4e5, y + 5e6);
        east.chain(still).chain(north).enumerate().map(line).collect()
    }

    #[test]
    fn a_drive_is_cut_into_stretches_of_one_length_that_follow_one_another() {
        let paths = Trajectory::parse("l", &an_l()).unwrap().cut(4).unwrap();
        assert_eq!(paths.len(), 4);
        for (k, path) in paths.iter().enumerate() {
            assert!((path.length() - 25.0).abs() < 1e-9, "{}", path.length());
            assert_eq!(path.end(), Some(path.length()));
            if let Some(next) = paths.get(k + 1) {
                let gap = libm::hypot(next.at(0.0).0[0] - path.at(25.0).0[0], next.at(0.0).0[1] - path.at(25.0).0[1]);
                assert!(gap < 1e-9, "{gap}");
            }
        }
        assert_eq!(paths[0].at(10.0), ([10.0, 0.0], 0.0), "the first point is the origin");
        let ([x, y], heading) = paths[3].at(25.0);
        assert!((x - 50.0).abs() < 1e-9 && (y - 50.0).abs() < 1e-9);
        assert!((heading - core::f64::consts::FRAC_PI_2).abs() < 1e-9);
    }

    #[test]
    fn what_is_no_drive_is_refused_with_its_line() {
        let refusal = |text: &str| Trajectory::parse("x", text).unwrap_err();
        assert!(refusal("").contains("at least two"));
        assert!(refusal("0 1 1 0 0 0 0 1\n1 1 1 0 0 0 0 1\n").contains("at least two"));
        assert!(refusal("# TUM\n0 1 1 0 0 0 0 1\n1 2 1\n").starts_with("line 3: 3 columns"));
        assert!(refusal("0 1 NaN 0 0 0 0 1").contains("\"NaN\""));
        assert!(refusal("0 1e300 1 0 0 0 0 1").contains("1e300"));
        assert!(refusal("0 0 0 0 0 0 0 1\n1 51 0 0 0 0 0 1").starts_with("line 2: jumps by 51 m"));
        let wide = |metres: usize| (0..=metres).step_by(50).map(|x| format!("0 {x} 0 0 0 0 0 1\n")).collect::<String>();
        assert!(refusal(&wide(2050)).contains("reaches over 2050 m"));
        assert!(Trajectory::parse("x", &wide(2000)).is_ok());
        let rounds = |metres: u32| {
            let there_and_back = |k: u32| format!("0 {} 0 0 0 0 0 1\n", if k.is_multiple_of(2) { 0 } else { 50 });
            (0..=metres / 50).map(there_and_back).collect::<String>()
        };
        assert!(Trajectory::parse("x", &rounds(50_000)).is_ok());
        assert!(refusal(&rounds(50_050)).starts_with("line 1002: goes on beyond 50 km"));
        let short = Trajectory::parse("x", &wide(50)).unwrap();
        assert!(short.cut(5).is_ok() && short.cut(6).unwrap_err().to_string().contains("50 m for 6 robots"));
        assert!(matches!(Trajectory::read(FilePath::new("/no/such")), Err(TrajectoryError::Io { .. })));
    }
}
