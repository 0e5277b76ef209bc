//! Cuts a stream of keyframes into submaps. A submap ends with the keyframe that took the body `distance_m` or
//! `rotation_deg` away from its first body pose, that is its `keyframes_max`-th, or that came `secs_max` after the
//! first while the body did not merely stand; the next keyframe begins the next one, unless the body has stood since
//! the submap's beginning: then the first that has left (see `rest`). It ends before a motion that would
//! let its last pose be uncertain by more than `sigma_max_m` or `sigma_max_deg`: so a hole in the odometry lies between
//! submaps, where the joint estimate can mend it, and bends none. The odometry between consecutive anchors compounds
//! every motion in between, so that they chain without gaps.
//!
//! A submap is anchored at its *middle* keyframe. Odometry that drifts bends the cloud, and what others align with is
//! the cloud as a whole. For a random walk of variance w per submap the cloud's mean lies w/3 from the first body pose,
//! from the middle one only w/12; the joint estimate reckons with that (see `distortion` of the estimation).

use super::continuity::{Continuity, FrameSign};
use super::gravity::Up;
use super::landmarks::{Constellation, Gatherer, SIGMA_RANGE, flattened};
use super::loss::{Arrivals, Loss};
use super::misfit::{Misfits, Views};
use super::modality::Modality;
use super::odometry::{across_gap_after, isotropic, motion, motion_across};
use super::open::{Open, moved};
use super::place::{Place, PlaceMean};
use super::planar::{Sharpener, TILT_MAX, flat, flat_motion};
use super::reading::Readings;
use super::rest::{NOISE_MAX, Rest, is_blurred, is_near};
use super::runs::Runs;
use super::stated::{Oddities, Oddity, is_constant};
use super::thinning::Thinner;
use super::{Keyframe, KeyframeError, Mark, PlaceDescriptor, PoseWithCovariance};
use crate::config::{Gravity, SubmapConfig};
use crate::geometry::Se3;
use crate::time::Stamp;

/// Points in one keyframe at most: four times a dense depth image of 640×480.
pub const POINTS_PER_KEYFRAME_MAX: usize = 1 << 20;
/// Farthest a body may be from its frame's origin, in frame units: beyond it f32 clouds and f64 poses lose accuracy.
pub const POSITION_MAX: f64 = 1e7;
/// Stamps lie within this of the clock's zero, ns (146 years): the span of any two then fits the wire.
pub const STAMP_MAX: i64 = (1 << 62) - 1;
/// Standard deviation (m and rad) of the first anchor in its frame: where the frame lies is a convention, so this is
/// small, but not so small that it spoils the conditioning of an estimate.
pub const FIRST_ANCHOR_SIGMA: f64 = 1e-4;

/// A finished stretch of a robot's own trajectory.
#[derive(Clone, Debug, PartialEq)]
pub struct Submap {
    /// Position along the trajectory of this epoch, from 0.
    pub index: u32,
    /// Stamps of the first and last keyframe.
    pub stamps: [Stamp; 2],
    /// `t_prev_this`: this anchor in the previous submap's. For index 0 `t_frame_this`, where the first body pose has
    /// standard deviations of [`FIRST_ANCHOR_SIGMA`].
    pub odometry: PoseWithCovariance,
    /// Pose of the anchor in the SLAM's frame.
    pub t_frame_anchor: Se3,
    /// `t_anchor_body` of each keyframe.
    pub keyframes: Vec<Se3>,
    /// The cloud, thinned to one point per voxel, in the anchor frame, m or frame units.
    pub cloud: Vec<[f32; 3]>,
    /// For each point the position (in `keyframes`) of the keyframe that saw it first.
    pub seen_from: Vec<u16>,
    /// Of landmarks: the points once more, and what else is known of them. Empty where points lie on surfaces.
    pub constellation: Constellation,
    /// What the user's own place recognition says of it.
    pub place: Option<Place>,
    /// Which way is up, in the anchor frame, as far as it is known.
    pub up: Option<Up>,
}

/// Cuts keyframes into submaps; see the [module](self).
#[derive(Clone, Debug)]
pub struct SubmapBuilder {
    config: SubmapConfig,
    next_index: u32,
    /// The last accepted keyframe, without its points.
    last: Option<Keyframe>,
    /// `t_anchor_body` since the anchor of the last finished submap (before the first: since the frame's origin).
    since_finished: Option<PoseWithCovariance>,
    /// Anchor of the last finished submap before a restart, until the first keyframe after it.
    resumed_at: Option<Se3>,
    open: Option<Open>,
    /// Why the first keyframe was lost since the last accepted one, if one was.
    gap: Option<Loss>,
    /// The gap that the last accepted keyframe lies behind, if its motion had to be widened for it.
    crossed: Option<Loss>,
    arrivals: Arrivals,
    /// The body has stood since the last finished submap began.
    rest: Option<Rest>,
    /// Whether keyframes go on from one another.
    continuity: Continuity,
    /// What the front end calls its run, and what it called those that are over.
    runs: Runs,
    /// Where the body is: as the SLAM has it, or a laser's scans.
    t_frame_body: Se3,
    sharpener: Sharpener,
    misfits: Misfits,
    misfit: Option<f64>,
    readings: Readings,
    oddities: Oddities,
}

impl SubmapBuilder {
    /// A builder at the start of a new frame.
    pub fn new(config: SubmapConfig) -> Self {
        Self {
            config,
            next_index: 0,
            last: None,
            since_finished: None,
            resumed_at: None,
            open: None,
            gap: None,
            crossed: None,
            arrivals: Arrivals::default(),
            rest: None,
            continuity: Continuity::default(),
            runs: Runs::default(),
            t_frame_body: Se3::identity(),
            sharpener: Sharpener::default(),
            misfits: Misfits::default(),
            misfit: None,
            readings: Readings::default(),
            oddities: Oddities::default(),
        }
    }

    /// A builder at the start of a new frame, which knows what runs of the front end are over: with `is_over` that of
    /// this frame, too.
    #[must_use]
    pub fn begun_anew(&self, is_over: bool) -> Self {
        Self { runs: self.runs.begun_anew(is_over), ..Self::new(self.config.clone()) }
    }

    /// A builder that goes on after a restart of the agent (not of the SLAM: that shows by a session that is not of
    /// `runs`): submaps below `next_index` exist, the last one anchored at `t_frame_last_anchor`. The motion since then
    /// was not observed: the next submap's odometry takes its mean from the SLAM and its covariance from
    /// `gap_sigma_per_m`. Without the last anchor's pose the frame's origin stands in for it.
    pub fn resume(config: SubmapConfig, next_index: u32, t_frame_last_anchor: Option<Se3>, runs: Runs) -> Self {
        let resumed_at = (next_index > 0).then(|| t_frame_last_anchor.unwrap_or_else(Se3::identity));
        Self { next_index, resumed_at, runs, ..Self::new(config) }
    }

    /// The runs of the front end, as far as they are known.
    pub fn runs(&self) -> &Runs {
        &self.runs
    }

    /// Takes the next keyframe; returns the submap that it closed, if it closed one.
    ///
    /// # Errors
    /// [`KeyframeError`] if the keyframe is refused.
    pub fn push(&mut self, keyframe: Keyframe) -> Result<Option<Submap>, KeyframeError> {
        let checked = self.check(&keyframe);
        // One that is too far away is looked at, too: its unit may be the reason.
        if matches!(checked, Ok(()) | Err(KeyframeError::Jump { .. })) {
            let odd = self.readings.look(&keyframe, &self.config);
            odd.into_iter().for_each(|oddity| self.oddities.tell(oddity));
        }
        if let Err(error) = checked {
            self.loss(keyframe.stamp, &error).into_iter().for_each(|why| self.lose(why));
            if matches!(error, KeyframeError::Jump { .. }) {
                self.continuity.refuse(&keyframe, &self.config);
            }
            return Err(error);
        }
        self.continuity.take(&keyframe, &self.config);
        self.runs.take(keyframe.session);
        let step = self.step(&keyframe);
        if step.as_ref().is_some_and(|step| self.stays(&keyframe, step)) {
            self.keep(keyframe);
            return Ok(None);
        }
        let step = self.leave(step);
        let step = self.taken(step, &keyframe);
        let ended = step.as_ref().filter(|step| self.would_blur(step)).and_then(|step| self.end_before(step));
        let Modality { planar, sharpens, .. } = Modality::of(self.config.sensor);
        self.t_frame_body = match &step {
            Some(step) if sharpens => self.t_frame_body * step.pose,
            _ if planar => flat(&keyframe.pose.pose),
            _ => keyframe.pose.pose,
        };
        self.track(&keyframe, step);
        self.extend(&keyframe);
        self.keep(keyframe);
        // What was just begun is complete only where each keyframe is a submap, and there none was open.
        Ok(if self.is_complete() { self.finish().or(ended) } else { ended })
    }

    /// Closes the open submap before a motion that it does not go on to.
    fn end_before(&mut self, step: &PoseWithCovariance) -> Option<Submap> {
        let keyframes = self.open.as_ref().map_or(0, |open| open.keyframes.len());
        self.oddities.ended(keyframes, Some(&step.covariance), &self.config);
        self.flush()
    }

    /// Closes the open submap, which is complete; a body that did not move in it is at rest from now on.
    fn finish(&mut self) -> Option<Submap> {
        self.oddities.ended(0, None, &self.config);
        let stands = self.open.as_ref().is_some_and(|open| self.stands(open));
        let closed = self.flush();
        let at = self.last.as_ref().filter(|_| stands).map(|last| last.pose.pose);
        self.rest = at.zip(self.since_finished).map(|(at, since)| Rest::new(at, self.t_frame_body, since));
        closed
    }

    fn keep(&mut self, keyframe: Keyframe) {
        self.last = Some(Keyframe { points: Vec::new(), marks: Vec::new(), place: None, ..keyframe });
    }

    /// Whether the last keyframe said no more than that the body still stands: it is in no submap.
    pub fn has_stood(&self) -> bool {
        self.rest.as_ref().is_some_and(Rest::has_stood)
    }

    /// Whether the body still stands where it did when the last submap ended. If so, that is all that `keyframe` says.
    fn stays(&mut self, keyframe: &Keyframe, step: &PoseWithCovariance) -> bool {
        let Some(rest) = &mut self.rest else { return false };
        if !rest.take(&keyframe.pose.pose, step, &self.config) {
            return false;
        }
        if let Some(motion) = rest.motion(&keyframe.pose.pose, &self.config) {
            let planar = Modality::of(self.config.sensor).planar;
            let motion = if planar { flat_motion(&motion) } else { motion };
            self.t_frame_body = rest.t_frame_body * motion.pose;
            self.since_finished = Some(rest.since_finished.compose(&motion));
        }
        true
    }

    /// A body that stood moves on with this step: the motion since it came to stand.
    fn leave(&mut self, step: Option<PoseWithCovariance>) -> Option<PoseWithCovariance> {
        let left = self.rest.take().zip(self.last.as_ref());
        let Some((rest, motion)) = left.and_then(|(rest, last)| {
            let motion = rest.motion(&last.pose.pose, &self.config)?;
            Some((rest, motion))
        }) else {
            return step;
        };
        (self.t_frame_body, self.since_finished) = (rest.t_frame_body, Some(rest.since_finished));
        step.map(|step| motion.compose(&step))
    }

    /// Closes the open submap now, if it holds a keyframe.
    pub fn flush(&mut self) -> Option<Submap> {
        let open = self.open.take()?;
        let index = self.next_index;
        self.next_index = index.saturating_add(1);
        self.since_finished = Some(open.t_anchor_last());
        self.misfit = self.misfits.take(open.views.misfit()).or(self.misfit);
        Some(open.close(index))
    }

    /// Where the body is: the index of the last finished submap, `t_anchor_body` from that submap's anchor, and the
    /// stamp of the last keyframe. `None` before the first submap is finished, and after a restart until a keyframe.
    pub fn body_since_anchor(&self) -> Option<(u32, PoseWithCovariance, Stamp)> {
        let index = self.next_index.checked_sub(1)?;
        Some((index, self.since_finished?, self.last.as_ref()?.stamp))
    }

    /// How far, in voxels, the views of submaps are from fitting together where the SLAM put them: said once, when it
    /// is so much that the intrinsics, the unit, the extrinsics or the odometry must be wrong. Only of depth cameras.
    pub fn take_misfit(&mut self) -> Option<f64> {
        self.misfit.take()
    }

    /// What is odd about what the front end sends: each kind once.
    pub fn take_oddities(&mut self) -> Vec<Oddity> {
        self.oddities.take()
    }

    /// A keyframe was lost: whatever came of it, the motion to the next one crosses a gap.
    pub fn lose(&mut self, why: Loss) {
        self.gap = self.gap.or(Some(why));
    }

    /// As what a keyframe with this stamp that is refused for this reason is lost. One that is repeated, or of a run
    /// that is over, is no loss.
    pub fn loss(&self, stamp: Stamp, error: &KeyframeError) -> Option<Loss> {
        match error {
            KeyframeError::SessionOver { .. } => None,
            KeyframeError::StampNotRising { .. } => (!self.arrivals.has(stamp)).then_some(Loss::Late),
            _ => Some(Loss::Refused),
        }
    }

    /// By what loss, if by any, the motion to the last accepted keyframe was made less certain: said once.
    pub fn take_gap(&mut self) -> Option<Loss> {
        self.crossed.take()
    }

    /// Passes over a keyframe that there is no room for. Where it is counts, so that what goes on from it later is
    /// known to go on; the odometry has a hole.
    pub fn pass(&mut self, keyframe: &Keyframe) {
        if self.check(keyframe).is_ok() {
            self.continuity.take(keyframe, &self.config);
            self.lose(Loss::Overload);
        }
    }

    /// By what it shows, if it does, that this keyframe belongs to a new frame: the front end says so by another
    /// `session`, or it is the last that was wanted to be sure (see [`continuity`](super::continuity)). Then it is the
    /// first to [`push`](Self::push) to a new builder.
    pub fn another_frame(&self, keyframe: &Keyframe) -> Option<FrameSign> {
        let is_late = self.last.as_ref().is_some_and(|last| keyframe.stamp <= last.stamp);
        match (self.runs.now(), keyframe.session) {
            // A session that is over may have keyframes on their way.
            (Some(before), Some(now)) if now != before => {
                let begins = (now > before || !is_late) && self.check_alone(keyframe).is_ok();
                begins.then_some(FrameSign::Session)
            }
            _ if is_late || !self.continuity.is_restart(keyframe, &self.config) => None,
            _ => matches!(self.check(keyframe), Err(KeyframeError::Jump { .. })).then_some(FrameSign::Jump),
        }
    }

    fn check(&self, keyframe: &Keyframe) -> Result<(), KeyframeError> {
        if let Some(last) = self.last.as_ref().map(|k| k.stamp).filter(|&last| keyframe.stamp <= last) {
            return Err(KeyframeError::StampNotRising { stamp: keyframe.stamp.0, last: last.0 });
        }
        self.check_alone(keyframe)?;
        let other = |place: &&PlaceDescriptor| self.open.as_ref().is_some_and(|open| !open.place.takes(place));
        if let Some(place) = keyframe.place.as_ref().filter(other) {
            return Err(KeyframeError::OtherPlace { numbers: place.vector().len(), model: place.model().into() });
        }
        self.continuity.check(keyframe, &self.config)
    }

    /// What no keyframe may be, whichever came before it.
    fn check_alone(&self, keyframe: &Keyframe) -> Result<(), KeyframeError> {
        self.runs.check(keyframe.session)?;
        if !(-STAMP_MAX..=STAMP_MAX).contains(&keyframe.stamp.0) {
            return Err(KeyframeError::StampOutOfRange { stamp: keyframe.stamp.0 });
        }
        // Negated, so that NaN is refused too.
        if !keyframe.pose.pose.translation.iter().all(|x| x.abs() <= POSITION_MAX) {
            return Err(KeyframeError::BadPosition);
        }
        if self.config.sensor.is_planar() {
            let tilt = libm::acos(keyframe.pose.pose.rotation.matrix()[(2, 2)].clamp(-1.0, 1.0));
            if tilt > TILT_MAX {
                return Err(KeyframeError::NotPlanar { tilt });
            }
        }
        if keyframe.points.len() > POINTS_PER_KEYFRAME_MAX {
            return Err(KeyframeError::TooManyPoints { count: keyframe.points.len() });
        }
        if let Some(index) = keyframe.points.iter().position(|p| p.iter().any(|x| !x.is_finite())) {
            return Err(KeyframeError::PointNotFinite { index });
        }
        let (points, marks) = (keyframe.points.len(), keyframe.marks.len());
        if marks != if self.config.sensor.sees_landmarks() { points } else { 0 } {
            return Err(KeyframeError::Marks { points, marks });
        }
        let in_range = |mark: &Mark| mark.covariance.sigmas().iter().all(|sigma| SIGMA_RANGE.contains(sigma));
        if let Some(index) = keyframe.marks.iter().position(|mark| !in_range(mark)) {
            return Err(KeyframeError::MarkOutOfRange { index });
        }
        Ok(())
    }

    /// The motion since the last keyframe, if there was one, as the SLAM has it.
    fn step(&mut self, keyframe: &Keyframe) -> Option<PoseWithCovariance> {
        let gap = self.gap.take();
        let last = self.last.as_ref();
        let gap = gap.or(last.filter(|last| self.arrivals.lack(last, keyframe)).map(|_| Loss::Unseen));
        self.arrivals.take(last.filter(|_| gap.is_none()), keyframe, &self.config);
        let last = last?;
        self.oddities.look(last, keyframe, is_constant(last, keyframe, &self.config), &self.config);
        let across = gap.and_then(|why| Some((why, motion_across(last, keyframe, &self.config)?)));
        self.crossed = across.map(|(why, _)| why);
        Some(across.map_or_else(|| motion(last, keyframe, &self.config), |(_, across)| across))
    }

    /// The motion as it is taken for the submaps.
    fn taken(&mut self, step: Option<PoseWithCovariance>, keyframe: &Keyframe) -> Option<PoseWithCovariance> {
        match Modality::of(self.config.sensor) {
            Modality { sharpens: true, .. } => self.sharpener.sharpen(step, &keyframe.points, self.config.voxel_m),
            Modality { planar: true, .. } => step.as_ref().map(flat_motion),
            _ => step,
        }
    }

    /// How far the frame of the submaps and that of the keyframes drove apart before a restart, at most: where scans
    /// sharpen the motion, the submaps' frame is not the SLAM's.
    fn way_apart(&self) -> f64 {
        let sharpens = Modality::of(self.config.sensor).sharpens;
        if sharpens { f64::from(self.next_index) * self.config.distance_m } else { 0.0 }
    }

    /// Compounds the motion up to `keyframe` onto the two running poses.
    fn track(&mut self, keyframe: &Keyframe, step: Option<PoseWithCovariance>) {
        let Some(step) = step else {
            self.since_finished = self.resumed_at.take().map(|t_frame_anchor| {
                let t_anchor_body = t_frame_anchor.inverse() * self.t_frame_body;
                across_gap_after(&t_anchor_body, self.way_apart(), &self.config, &keyframe.pose.covariance)
            });
            return;
        };
        self.since_finished = self.since_finished.map(|since| since.compose(&step));
        if let Some(open) = &mut self.open {
            open.motions.push(step);
            open.gathered = Some(open.gathered_with(&step));
        }
    }

    /// Adds `keyframe` to the open submap, which it begins if none is open.
    fn extend(&mut self, keyframe: &Keyframe) {
        let t_frame_body = self.t_frame_body;
        let up = self.up(keyframe);
        let open = self.open.get_or_insert_with(|| {
            let at_origin = isotropic(FIRST_ANCHOR_SIGMA, FIRST_ANCHOR_SIGMA, &keyframe.pose.covariance);
            let first = PoseWithCovariance { pose: t_frame_body, covariance: at_origin };
            Open {
                stamps: [keyframe.stamp; 2],
                odometry: self.since_finished.unwrap_or(first),
                t_frame_first: t_frame_body,
                motions: Vec::new(),
                gathered: None,
                keyframes: Vec::new(),
                cloud: Thinner::new(self.config.voxel_m, self.config.points_max),
                landmarks: Gatherer::new(self.config.voxel_m, self.config.points_max),
                place: PlaceMean::default(),
                views: Views::default(),
                ups: Vec::new(),
            }
        });
        let t_first_body = open.t_frame_first.inverse() * t_frame_body;
        open.stamps[1] = keyframe.stamp;
        let position = u16::try_from(open.keyframes.len()).unwrap_or(u16::MAX);
        open.keyframes.push(t_first_body);
        keyframe.place.iter().for_each(|place| open.place.add(place));
        open.ups.push(up);
        let Modality { landmarks, planar, bends, .. } = Modality::of(self.config.sensor);
        if landmarks && planar {
            let (points, marks) = flattened(&keyframe.points, &keyframe.marks);
            return open.landmarks.add(position, &t_first_body, &points, &marks);
        }
        if landmarks {
            return open.landmarks.add(position, &t_first_body, &keyframe.points, &keyframe.marks);
        }
        if bends {
            open.views.add(usize::from(position), &t_first_body, &keyframe.points, self.config.voxel_m);
        }
        let height = |p: &[f32; 3]| if planar { [p[0], p[1], 0.0] } else { *p };
        open.cloud.add(keyframe.points.iter().map(|p| moved(&t_first_body, height(p).map(f64::from))), position);
    }

    /// Which way is up: as the keyframe says itself, or its frame.
    fn up(&self, keyframe: &Keyframe) -> Option<Up> {
        let SubmapConfig { sensor, gravity, gravity_sigma_rad, .. } = self.config;
        match gravity {
            _ if sensor.is_planar() => None,
            Gravity::Keyframes => keyframe.up,
            Gravity::FrameZ => {
                let of_frame = || Up::of_frame_z(&keyframe.pose.pose.rotation, gravity_sigma_rad).ok();
                keyframe.up.or_else(of_frame)
            }
        }
    }

    fn is_complete(&self) -> bool {
        self.open.as_ref().is_some_and(|open| {
            let gone = open.keyframes.last().copied().unwrap_or_else(Se3::identity);
            gone.translation.norm() >= self.config.distance_m
                || gone.rotation.angle() >= self.config.rotation_deg.to_radians()
                || open.keyframes.len() >= self.config.keyframes_max as usize
                || (open.stamps[1].secs_since(open.stamps[0]) >= self.config.secs_max && !self.stands(open))
        })
    }

    /// Whether the body stood all the time: it sees nothing new, and needs no submap to say so.
    fn stands(&self, open: &Open) -> bool {
        // Both ends of what was driven are known with the noise of a motion.
        let mut there = open.keyframes.iter().skip(1).zip(&open.motions);
        there.all(|(t, step)| is_near(t, &step.covariance, NOISE_MAX, &self.config))
    }

    /// Whether with this motion the open submap's last pose would be too uncertain in its first.
    fn would_blur(&self, step: &PoseWithCovariance) -> bool {
        let blurred = |open: &Open| is_blurred(&open.gathered_with(step).covariance, &self.config);
        self.open.as_ref().is_some_and(blurred)
    }
}

#[cfg(test)]
#[path = "builder_tests.rs"]
mod tests;
