//! One robot of a set: its keyframes, in which submap each came to lie, and where robot and anchors truly were.

use super::find::{Set, TruthFile};
use super::mrclam::{Survey, placed, survey, tracked};
use super::reference::Reference;
use anyhow::anyhow;
use merganser_protocol::geometry::Se3;
use merganser_protocol::submap::{Submap, SubmapBuilder};
use merganser_protocol::time::Stamp;
use merganser_recording::Recording;
use std::collections::BTreeMap;

/// What a submap says of its own keyframes is so much better than what wheels say of as long a way. A turn costs nothing:
/// of `aces`, scans before and after one of 366° were matched by hand, and the submap had it to 0.2°.
const SUBMAP_SHARE: f64 = 0.05;

/// Where an anchor is more doubtful than this, m and rad together, it is not judged. Less doubt counts in the truth's
/// covariance, so that what is a metre off is seen all the same.
const DOUBT_MAX: f64 = 0.3;

/// One robot.
#[derive(Debug)]
pub struct Track {
    /// Its name.
    pub robot: String,
    /// Of its keyframes.
    pub stamps: Vec<Stamp>,
    /// From the beginning of the set to its keyframes, s.
    pub seconds: Vec<f64>,
    /// `t_odometry_body` as recorded.
    pub raw: Vec<Se3>,
    /// The submap of each keyframe, and `t_anchor_body`.
    pub within: Vec<(u32, Se3)>,
    /// `t_world_body` of each keyframe, where it is known.
    pub truth: Vec<Option<Se3>>,
    /// Where its anchors truly are, as far as that is known.
    pub anchors: BTreeMap<u32, Anchor>,
}

/// Where an anchor truly is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Anchor {
    /// `t_world_anchor`.
    pub t_world_anchor: Se3,
    /// Standard deviation of what is not known of it, m and rad, beside that of all truth.
    pub doubt: f64,
}

impl Track {
    /// Every robot of a set.
    ///
    /// # Errors
    /// Files that cannot be used, keyframes that the core refuses.
    pub fn all(set: &Set, recordings: &[Recording], reference: Option<&Reference>) -> anyhow::Result<Vec<Self>> {
        let survey = if set.truth == TruthFile::Mrclam { survey(&set.path)? } else { Survey::new() };
        recordings.iter().map(|recording| Self::of(set, recording, reference, &survey)).collect()
    }

    fn of(set: &Set, recording: &Recording, reference: Option<&Reference>, survey: &Survey) -> anyhow::Result<Self> {
        let lines = recording.keyframes();
        let stamps: Vec<Stamp> = lines.iter().map(|line| line.stamp).collect();
        let robot = recording.manifest().robot.as_str().to_owned();
        let truth: Vec<Option<Se3>> = match (&set.truth, reference) {
            (_, Some(reference)) => stamps.iter().map(|stamp| Some(reference.at(*stamp)?.0)).collect(),
            (TruthFile::Mrclam, _) => tracked(&set.path, &robot, &stamps)?,
            _ => match recording.truth() {
                Some(lines) => lines.iter().map(|line| Some(line.pose)).collect(),
                None => vec![None; stamps.len()],
            },
        };
        let vague = match reference {
            Some(reference) => stamps.iter().map(|s| reference.at(*s).map_or(0.0, |(_, near)| near)).collect(),
            None => vec![0.0; stamps.len()],
        };
        let mut track = Self {
            seconds: stamps.iter().map(|stamp| stamp.secs_since(recording.begins())).collect(),
            raw: lines.iter().map(|line| line.pose.pose).collect(),
            within: Vec::new(),
            anchors: BTreeMap::new(),
            robot,
            stamps,
            truth,
        };
        let mut builder = SubmapBuilder::new(recording.manifest().config.submap.clone());
        for index in 0..recording.len() {
            let refused = |error| anyhow!("keyframe {index} of {}: {error}", recording.folder().display());
            let closed = builder.push(recording.keyframe(index)?).map_err(|error| refused(error.to_string()))?;
            closed.iter().for_each(|submap| track.take(submap, &vague, survey));
        }
        builder.flush().iter().for_each(|submap| track.take(submap, &vague, survey));
        if track.within.len() != track.raw.len() {
            return Err(anyhow!("{}: a keyframe came into no submap", recording.folder().display()));
        }
        Ok(track)
    }

    /// Takes the next submap.
    fn take(&mut self, submap: &Submap, vague: &[f64], survey: &Survey) {
        let first = self.within.len();
        self.within.extend(submap.keyframes.iter().map(|t_anchor_body| (submap.index, *t_anchor_body)));
        // Of a keyframe between two true poses the wheels tell, badly; where the anchor is from it, the scans, well.
        let doubt = |k: usize| vague[k] + SUBMAP_SHARE * self.within[k].1.translation.norm();
        let told =
            |k: usize| Some(Anchor { t_world_anchor: self.truth[k]? * self.within[k].1.inverse(), doubt: doubt(k) });
        let known = (first..self.within.len()).filter_map(told).filter(|anchor| anchor.doubt <= DOUBT_MAX);
        let best = known.min_by(|a, b| a.doubt.total_cmp(&b.doubt));
        let surveyed = || Some(Anchor { t_world_anchor: placed(submap, survey)?, doubt: 0.0 });
        if let Some(anchor) = best.or_else(surveyed) {
            self.anchors.insert(submap.index, anchor);
            // Where only the survey tells, the robot is where its submap says.
            for k in (first..self.within.len()).filter(|_| !survey.is_empty()) {
                self.truth[k].get_or_insert(anchor.t_world_anchor * self.within[k].1);
            }
        }
    }
}
