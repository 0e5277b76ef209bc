//! One reading of a bag for poses, transforms and stamps of clouds.

use super::{Choice, JoinError, Poses, Tally, listed};
use crate::bag::{Bag, Flow, Record};
use crate::limits::{CLOUD_FRAMES_MAX, CLOUDS_MAX, GAP_SECS_MAX, POSES_MAX};
use crate::msg::{
    Header, LaserScan, Odometry, PointCloud2, Pose, PoseStamped, PoseWithCovarianceStamped, TfMessage, plain_frame,
};
use crate::tf::{TfTree, When, interpolated};
use crate::wire::{CDR_HEADER_LEN, Field as _, Message, Ros1Reader, Serialization, WireError};
use hiroz_cdr::{BigEndian, CdrReader, LittleEndian};
use merganser_geometry::Se3;
use std::collections::BTreeSet;

/// The body, where nothing says how it is called.
const BODY: &str = "base_link";
/// Names of the body, the preferred first, in TF `odom → base_link`.
const BODIES: [&str; 2] = [BODY, "base_footprint"];
/// Name of the odometry's frame there.
const ODOM: &str = "odom";

/// A cloud whose pose is known.
#[derive(Clone, Debug, PartialEq)]
pub struct Posed {
    /// Its number among the messages of its topic.
    pub number: u64,
    /// Its stamp, ns.
    pub stamp_ns: i64,
    /// `t_odom_body` then.
    pub pose: Se3,
    /// Which of [`Joined::covariances`] is stated with the pose that is nearest in time.
    pub covariance: Option<usize>,
}

/// Where clouds of one robot were measured.
#[derive(Clone, Debug)]
pub struct Joined {
    /// Whose, and which topics.
    pub choice: Choice,
    /// Name of the clouds' topic.
    pub cloud: String,
    /// Whether clouds are those of a planar laser.
    pub is_planar: bool,
    /// Where poses come from, for people.
    pub poses: String,
    /// The odometry's frame.
    pub odom: String,
    /// The body's frame.
    pub body: String,
    /// Clouds with a pose, with rising numbers and stamps; at least one.
    pub clouds: Vec<Posed>,
    /// Covariances of poses as stated: 6×6 row by row, x, y, z and rotation about the fixed axes of the odometry's
    /// frame.
    pub covariances: Vec<[f64; 36]>,
    /// Transforms.
    pub tree: TfTree,
    /// What was passed over.
    pub tally: Tally,
    pub(super) serialization: Serialization,
}

/// A pose, and the number of its covariance.
type Sample = (Se3, Option<usize>);

/// Poses in rising order of their stamps, with the frames of odometry and body, and where they come from.
type Way = (Vec<(i64, Sample)>, String, String, String);

/// What is read of one robot.
struct Gathering<'a> {
    choice: &'a Choice,
    /// Stamp, time of receipt, pose.
    poses: Vec<(i64, i64, Sample)>,
    covariances: Vec<[f64; 36]>,
    odom: BTreeSet<String>,
    body: BTreeSet<String>,
    /// Stamp, time of receipt.
    clouds: Vec<(i64, i64)>,
    tree: TfTree,
    tally: Tally,
    poses_bad: Tally,
    clouds_bad: Tally,
    error: Option<JoinError>,
}

/// Reads where the clouds of each robot were measured.
///
/// # Errors
/// [`JoinError`].
pub fn gather(bag: &Bag, choices: &[Choice]) -> Result<Vec<Joined>, JoinError> {
    let mut robots: Vec<Gathering<'_>> = choices.iter().map(Gathering::of).collect();
    let wanted: BTreeSet<usize> = choices.iter().flat_map(Choice::topics).collect();
    let topics = bag.topics();
    bag.read(
        |topic| wanted.contains(&topic),
        |record| {
            let Some(topic) = topics.get(record.topic) else { return Flow::On };
            let Some(serialization) = topic.serialization else { return Flow::On };
            let mut flow = Flow::On;
            for robot in &mut robots {
                if let Err(error) = robot.take(serialization, &topic.kind, &topic.name, record) {
                    robot.error = Some(error);
                    flow = Flow::Stop;
                }
            }
            flow
        },
    )?;
    robots.into_iter().map(|robot| robot.finish(bag)).collect()
}

impl Choice {
    /// All topics of the robot.
    fn topics(&self) -> impl Iterator<Item = usize> + '_ {
        let poses = match self.poses {
            Poses::Odometry(index) | Poses::Stamped(index) => Some(index),
            Poses::Tf => None,
        };
        self.tf.iter().map(|(index, _)| *index).chain([self.cloud]).chain(poses)
    }
}

impl<'a> Gathering<'a> {
    fn of(choice: &'a Choice) -> Self {
        Self {
            choice,
            poses: Vec::new(),
            covariances: Vec::new(),
            odom: BTreeSet::new(),
            body: BTreeSet::new(),
            clouds: Vec::new(),
            tree: TfTree::default(),
            tally: Tally::default(),
            poses_bad: Tally::default(),
            clouds_bad: Tally::default(),
            error: None,
        }
    }

    fn take(
        &mut self,
        serialization: Serialization,
        kind: &str,
        name: &str,
        Record { topic, received_ns, bytes }: Record<'_>,
    ) -> Result<(), JoinError> {
        if let Some((_, is_fixed)) = self.choice.tf.iter().find(|(index, _)| *index == topic) {
            match TfMessage::decode(serialization, bytes) {
                Ok(message) => self.tree.take(&message, *is_fixed),
                Err(error) => self.tally.count(format!("{name}: {error}")),
            }
        }
        if self.choice.cloud == topic {
            if self.clouds.len() == CLOUDS_MAX {
                return Err(JoinError::Clouds(name.into()));
            }
            // One that cannot be read keeps its place, so that numbers are right.
            self.clouds.push(match header(serialization, bytes) {
                Ok(Header { stamp_ns, .. }) => (stamp_ns, received_ns),
                Err(error) => {
                    self.clouds_bad.count(error);
                    (UNREAD, received_ns)
                }
            });
        }
        if matches!(self.choice.poses, Poses::Odometry(index) | Poses::Stamped(index) if index == topic) {
            if self.poses.len() == POSES_MAX {
                return Err(JoinError::Poses(name.into()));
            }
            match stated(serialization, kind, bytes) {
                Err(error) => self.poses_bad.count(error),
                Ok(Stated { header, body, pose, covariance }) => match pose.se3() {
                    None => self.poses_bad.count("a number is not finite or too large, or the quaternion is zero"),
                    Some(pose) => {
                        name_frame(&mut self.odom, header.frame());
                        name_frame(&mut self.body, plain_frame(&body));
                        let covariance = covariance.map(|stated| {
                            if self.covariances.last() != Some(&stated) {
                                self.covariances.push(stated);
                            }
                            self.covariances.len() - 1
                        });
                        self.poses.push((header.stamp_ns, received_ns, (pose, covariance)));
                    }
                },
            }
        }
        Ok(())
    }

    fn finish(mut self, bag: &Bag) -> Result<Joined, JoinError> {
        if let Some(error) = self.error {
            return Err(error);
        }
        let topics = bag.topics();
        let topic = &topics[self.choice.cloud];
        let source = match self.choice.poses {
            Poses::Odometry(index) | Poses::Stamped(index) => Some(&topics[index]),
            Poses::Tf => None,
        };
        let (poses, odom, body, told) = match source {
            Some(source) => {
                if self.poses.is_empty() {
                    let why = self.poses_bad.commonest().unwrap_or("there are none").into();
                    return Err(JoinError::Unusable { topic: source.name.clone(), count: source.count, why });
                }
                let samples = stamped(std::mem::take(&mut self.poses), &source.name, &mut self.tally);
                let odom = one(&self.odom, ODOM, &source.name, &mut self.tally);
                let body = one(&self.body, BODY, &source.name, &mut self.tally);
                (samples, odom, body, source.name.clone())
            }
            None => self.of_tf().ok_or_else(|| {
                JoinError::NoPoses(format!("frames {}, and topics {}", self.tree.known(), listed(topics)))
            })?,
        };
        for (why, count) in self.poses_bad.reasons() {
            self.tally.add(format!("{told}: {why}"), count);
        }
        let clouds = self.posed(&poses, &topic.name, &told)?;
        for (why, count) in self.tree.refused() {
            self.tally.add(format!("TF: {why}"), *count);
        }
        Ok(Joined {
            choice: self.choice.clone(),
            cloud: topic.name.clone(),
            is_planar: topic.kind == LaserScan::TYPE,
            poses: told,
            odom,
            body,
            clouds,
            covariances: self.covariances,
            tree: self.tree,
            tally: self.tally,
            serialization: topic.serialization.unwrap_or(Serialization::Cdr),
        })
    }

    /// Poses of TF `odom → base_link`, with frames and where they come from.
    fn of_tf(&self) -> Option<Way> {
        let named = |frame: &str, name: &str| frame == name || frame.ends_with(&format!("/{name}"));
        let links = |body: &str| -> Vec<(String, String)> {
            let links = self.tree.links().filter(|(odom, child)| named(odom, ODOM) && named(child, body));
            links.map(|(odom, child)| (odom.to_owned(), child.to_owned())).collect()
        };
        let [(odom, body)] = BODIES.iter().map(|body| links(body)).find(|links| !links.is_empty())?.try_into().ok()?;
        let stamps = self.tree.stamps(&odom, &body)?;
        let poses = stamps.filter_map(|stamp| Some((stamp, (self.tree.lookup(&odom, &body, stamp).ok()?, None))));
        let told = format!("TF {odom} → {body}");
        Some((poses.collect(), odom.clone(), body.clone(), told))
    }

    /// Clouds with their poses.
    fn posed(&mut self, poses: &[(i64, Sample)], name: &str, source: &str) -> Result<Vec<Posed>, JoinError> {
        let count = self.clouds.len();
        let read: Vec<i64> =
            self.clouds.iter().filter(|(stamp, _)| *stamp != UNREAD).map(|(stamp, _)| *stamp).collect();
        if read.is_empty() {
            let why = self.clouds_bad.commonest().unwrap_or("there are none").into();
            return Err(JoinError::Unusable { topic: name.into(), count: count as u64, why });
        }
        for (why, bad) in self.clouds_bad.reasons() {
            self.tally.add(format!("{name}: {why}"), bad);
        }
        let is_clockless = read.iter().all(|stamp| *stamp == 0);
        let (mut clouds, mut last) = (Vec::new(), i64::MIN);
        let (mut first_ns, mut last_ns) = (i64::MAX, i64::MIN);
        for (number, (stamp, received)) in self.clouds.iter().enumerate() {
            let stamp_ns = match *stamp {
                UNREAD => continue,
                0 if is_clockless => {
                    self.tally.count(format!("{name}: {CLOCKLESS}"));
                    *received
                }
                0 => {
                    self.tally.count(format!("{name}: left out, as the stamp is 0"));
                    continue;
                }
                stamp => stamp,
            };
            (first_ns, last_ns) = (first_ns.min(stamp_ns), last_ns.max(stamp_ns));
            if stamp_ns <= last {
                self.tally.count(format!("{name}: left out, as the stamp does not come after the one before"));
                continue;
            }
            last = stamp_ns;
            match interpolated(poses, stamp_ns, |(pose, _)| *pose) {
                Ok(pose) => {
                    let covariance = nearest(poses, stamp_ns).and_then(|(_, covariance)| *covariance);
                    clouds.push(Posed { number: number as u64, stamp_ns, pose, covariance });
                }
                Err(When::Outside(..)) => {
                    self.tally
                        .count(format!("{name}: left out, as no pose of {source} comes before, or none after it"));
                }
                Err(When::Gap(_)) => self
                    .tally
                    .count(format!("{name}: left out, as {source} is silent for more than {GAP_SECS_MAX} s then")),
            }
        }
        if clouds.is_empty() {
            let secs = |ns: i64| ns as f64 * 1e-9;
            let (from, to) = (poses.first().map_or(0, |p| p.0), poses.last().map_or(0, |p| p.0));
            return Err(JoinError::Apart {
                cloud: name.into(),
                count,
                first: secs(first_ns),
                last: secs(last_ns),
                poses: source.into(),
                from: secs(from),
                to: secs(to),
            });
        }
        Ok(clouds)
    }
}

/// Stands for a cloud that cannot be read.
const UNREAD: i64 = i64::MIN;
const CLOCKLESS: &str = "taken by the time of receipt, as all stamps are 0";

/// Poses in rising order of their stamps.
fn stamped(poses: Vec<(i64, i64, Sample)>, name: &str, tally: &mut Tally) -> Vec<(i64, Sample)> {
    let is_clockless = poses.iter().all(|(stamp, ..)| *stamp == 0);
    let mut samples: Vec<(i64, Sample)> = Vec::with_capacity(poses.len());
    for (stamp, received, sample) in poses {
        match stamp {
            0 if is_clockless => {
                tally.count(format!("{name}: {CLOCKLESS}"));
                samples.push((received, sample));
            }
            0 => tally.count(format!("{name}: left out, as the stamp is 0")),
            stamp => samples.push((stamp, sample)),
        }
    }
    samples.sort_by_key(|(stamp, _)| *stamp);
    let all = samples.len();
    samples.dedup_by_key(|(stamp, _)| *stamp);
    if samples.len() < all {
        tally.add(format!("{name}: left out, as another has the same stamp"), (all - samples.len()) as u64);
    }
    samples
}

fn nearest(poses: &[(i64, Sample)], at_ns: i64) -> Option<&Sample> {
    let after = poses.partition_point(|(stamp, _)| *stamp < at_ns);
    let around = [after.checked_sub(1), Some(after)].into_iter().flatten().filter_map(|index| poses.get(index));
    around.min_by_key(|(stamp, _)| stamp.abs_diff(at_ns)).map(|(_, sample)| sample)
}

/// Frames are few, and are only told.
fn name_frame(frames: &mut BTreeSet<String>, frame: &str) {
    if !frames.contains(frame) && frames.len() < CLOUD_FRAMES_MAX {
        frames.insert(frame.into());
    }
}

/// The one frame that a topic names; told if there are others.
fn one(frames: &BTreeSet<String>, default: &str, topic: &str, tally: &mut Tally) -> String {
    let mut named = frames.iter().filter(|frame| !frame.is_empty());
    let Some(first) = named.next() else { return default.into() };
    if named.next().is_some() {
        let all: Vec<&str> = frames.iter().map(String::as_str).take(8).collect();
        tally.count(format!("{topic}: names several frames ({}); {first} is taken", all.join(", ")));
    }
    first.clone()
}

/// What a message says of the body.
struct Stated {
    header: Header,
    body: String,
    pose: Pose,
    covariance: Option<[f64; 36]>,
}

fn stated(serialization: Serialization, kind: &str, bytes: &[u8]) -> Result<Stated, WireError> {
    if kind == PoseStamped::TYPE {
        let PoseStamped { header, pose } = PoseStamped::decode(serialization, bytes)?;
        return Ok(Stated { header, body: String::new(), pose, covariance: None });
    }
    if kind == PoseWithCovarianceStamped::TYPE {
        let PoseWithCovarianceStamped { header, pose } = PoseWithCovarianceStamped::decode(serialization, bytes)?;
        return Ok(Stated { header, body: String::new(), pose: pose.pose, covariance: Some(pose.covariance) });
    }
    let Odometry { header, child_frame_id, pose, .. } = Odometry::decode(serialization, bytes)?;
    Ok(Stated { header, body: child_frame_id, pose: pose.pose, covariance: Some(pose.covariance) })
}

/// The header alone, with which every message here begins: a cloud of megabytes is not looked through.
pub(super) fn header(serialization: Serialization, bytes: &[u8]) -> Result<Header, WireError> {
    const FIELD: &str = "header";
    if serialization == Serialization::Ros1 {
        return Header::read(&mut Ros1Reader::new(bytes), FIELD);
    }
    let short = WireError::Short { field: PointCloud2::TYPE, left: bytes.len() };
    let (head, body) = bytes.split_at_checked(CDR_HEADER_LEN).ok_or(short)?;
    match [head[0], head[1]] {
        [0, 1] => Header::read(&mut CdrReader::<LittleEndian>::new(body), FIELD),
        [0, 0] => Header::read(&mut CdrReader::<BigEndian>::new(body), FIELD),
        other => Err(WireError::Encapsulation(other)),
    }
}
