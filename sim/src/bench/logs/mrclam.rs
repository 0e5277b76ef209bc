//! The truth of MRCLAM's robots: motion capture, or the survey of the landmarks.

use super::reference::text;
use anyhow::anyhow;
use merganser_protocol::geometry::{Se3, So3};
use merganser_protocol::submap::Submap;
use merganser_protocol::time::Stamp;
use merganser_recording::mrclam::subjects;
use nalgebra::{Vector2, Vector3};
use std::collections::BTreeMap;
use std::path::Path;

/// A landmark of a submap that lies farther from the survey, m, is another one whose bar code was misread.
const MISREAD_M: f64 = 1.0;
/// Landmarks without which a submap's place in the survey is not known.
const PLACED_MIN: usize = 4;

/// Where the landmark of each bar code is, m.
pub type Survey = BTreeMap<u32, Vector2<f64>>;

/// Reads `Landmark_Groundtruth.dat` and `Barcodes.dat`; empty where they are not there.
///
/// # Errors
/// A file that cannot be used.
pub fn survey(folder: &Path) -> anyhow::Result<Survey> {
    let mut places = BTreeMap::new();
    for row in table(folder, "Landmark_Groundtruth.dat")?.unwrap_or_default() {
        let [subject, x, y] = row;
        places.insert(subject as u32, Vector2::new(x, y));
    }
    let Some(text) = file(folder, "Barcodes.dat")? else { return Ok(Survey::new()) };
    let of = subjects(&text).map_err(|error| anyhow!("{}: {error}", folder.join("Barcodes.dat").display()))?;
    Ok(of.into_iter().filter_map(|(code, subject)| Some((code, *places.get(&subject)?))).collect())
}

/// The poses that motion capture has of a robot, at these stamps.
///
/// # Errors
/// A file that cannot be used.
pub fn tracked(folder: &Path, robot: &str, stamps: &[Stamp]) -> anyhow::Result<Vec<Option<Se3>>> {
    let number = robot.trim_start_matches("robot");
    let Some(rows) = table(folder, &format!("Robot{number}_Groundtruth.dat"))? else {
        return Ok(vec![None; stamps.len()]);
    };
    let pose = |[seconds, x, y, heading]: [f64; 4]| {
        (seconds, Se3::new(So3::exp(&Vector3::new(0.0, 0.0, heading)), Vector3::new(x, y, 0.0)))
    };
    let poses: Vec<(f64, Se3)> = rows.into_iter().map(pose).collect();
    let at = |stamp: &Stamp| {
        let seconds = stamp.as_secs_f64();
        let next = poses.partition_point(|(s, _)| *s <= seconds);
        let ((s0, from), (s1, to)) = (poses.get(next.checked_sub(1)?)?, poses.get(next)?);
        // A gap in the capture tells nothing of what was driven in it.
        (s1 - s0 <= 1.0).then(|| from.interpolate(to, (seconds - s0) / (s1 - s0)))
    };
    Ok(stamps.iter().map(at).collect())
}

fn file(folder: &Path, name: &str) -> anyhow::Result<Option<String>> {
    let paths = [folder.join(name), folder.join(format!("{name}.xz"))];
    paths.iter().find(|path| path.is_file()).map(|path| text(path)).transpose()
}

/// The first numbers of each line that is no remark.
fn table<const N: usize>(folder: &Path, name: &str) -> anyhow::Result<Option<Vec<[f64; N]>>> {
    let Some(text) = file(folder, name)? else { return Ok(None) };
    let mut rows = Vec::new();
    for (line, text) in text.lines().enumerate().filter(|(_, text)| !text.starts_with('#') && !text.trim().is_empty()) {
        let words: Vec<f64> = text.split_ascii_whitespace().map_while(|word| word.parse().ok()).collect();
        let row = words
            .get(..N)
            .and_then(|row| <[f64; N]>::try_from(row).ok())
            .filter(|row| row.iter().all(|x| x.is_finite()));
        let place = folder.join(name);
        rows.push(row.ok_or_else(|| anyhow!("{}:{}: {N} numbers are due", place.display(), line + 1))?);
    }
    Ok(Some(rows))
}

/// `t_survey_anchor` of a submap, by its landmarks; `None` where too few of them are in the survey.
pub fn placed(submap: &Submap, survey: &Survey) -> Option<Se3> {
    let landmarks = submap.constellation.landmarks.iter();
    let known = landmarks.filter_map(|l| Some((l.at.xy(), *survey.get(&l.mark.label?)?)));
    let mut pairs: Vec<(Vector2<f64>, Vector2<f64>)> = known.collect();
    while pairs.len() >= PLACED_MIN {
        let t = fit(&pairs);
        let off = |(p, q): &(Vector2<f64>, Vector2<f64>)| ((t * Vector3::new(p.x, p.y, 0.0)).xy() - q).norm();
        let worst = (0..pairs.len()).max_by(|&a, &b| off(&pairs[a]).total_cmp(&off(&pairs[b])))?;
        if off(&pairs[worst]) <= MISREAD_M {
            return Some(t);
        }
        pairs.remove(worst);
    }
    None
}

/// The motion in the plane that brings the first points nearest to the second (least squares).
fn fit(pairs: &[(Vector2<f64>, Vector2<f64>)]) -> Se3 {
    let count = pairs.len() as f64;
    let p0 = pairs.iter().map(|(p, _)| p).sum::<Vector2<f64>>() / count;
    let q0 = pairs.iter().map(|(_, q)| q).sum::<Vector2<f64>>() / count;
    let (mut sine, mut cosine) = (0.0, 0.0);
    for (p, q) in pairs {
        let (p, q) = (p - p0, q - q0);
        cosine += p.dot(&q);
        sine += p.x * q.y - p.y * q.x;
    }
    let turn = So3::exp(&Vector3::new(0.0, 0.0, libm::atan2(sine, cosine)));
    let middle = turn.matrix() * Vector3::new(p0.x, p0.y, 0.0);
    Se3::new(turn, Vector3::new(q0.x - middle.x, q0.y - middle.y, 0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fit_finds_the_motion() {
        let t = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, 2.0)), Vector3::new(3.0, -1.0, 0.0));
        let points = [[0.0, 0.0], [1.0, 0.5], [-2.0, 3.0], [4.0, 1.0]].map(|[x, y]| Vector2::new(x, y));
        let pairs = points.map(|p| (p, (t * Vector3::new(p.x, p.y, 0.0)).xy()));
        assert!((fit(&pairs).inverse() * t).translation.norm() < 1e-12);
        assert!((fit(&pairs).inverse() * t).rotation.angle() < 1e-12);
    }

    #[test]
    fn a_gap_in_the_capture_tells_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let text = "# Time x y heading\n10.0 0 0 0\n10.5 1 0 0.2\n20.0 5 0 0\n";
        std::fs::write(folder.path().join("Robot3_Groundtruth.dat"), text).unwrap();
        let at = |seconds: f64| Stamp((seconds * 1e9) as i64);
        let poses = tracked(folder.path(), "robot3", &[at(10.25), at(15.0), at(30.0)]).unwrap();
        assert!(poses[0].is_some_and(|t| (t.translation.x - 0.5).abs() < 0.01));
        assert_eq!(&poses[1..], &[None, None]);
        assert_eq!(tracked(folder.path(), "robot4", &[at(10.25)]).unwrap(), [None]);
    }
}
