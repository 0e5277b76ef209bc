//! One reading of a bag for poses, transforms and stamps of clouds.

use super::{Choice, JoinError, Poses, Tally, listed};
use crate::bag::{Bag, Damage, Flow, Record};
use crate::limits::{CLOUD_FRAMES_MAX, CLOUDS_MAX, FRAME_BYTES_MAX, GAP_SECS_MAX, POSES_MAX};
use crate::msg::{
    Header, LaserScan, Odometry, PointCloud2, Pose, PoseStamped, PoseWithCovarianceStamped, TfMessage, plain_frame,
};
use crate::order::{Order, Turn};
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
    /// What of the bag could not be read for these, beyond what its opening told.
    pub(super) damage: Damage,
}

/// A pose, and the number of its covariance.
type Sample = (Se3, Option<usize>);

/// A pose as it came: stamp, time of receipt, which pair of frames.
type Received = (i64, i64, usize, Sample);

/// Poses in rising order of their stamps, with the frames of odometry and body, and where they come from.
type Way = (Vec<(i64, Sample)>, String, String, String);

/// What is read of one robot.
struct Gathering<'a> {
    choice: &'a Choice,
    poses: Vec<Received>,
    covariances: Vec<[f64; 36]>,
    frames: Frames,
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
    let damage = bag.read(
        |topic| wanted.contains(&topic),
        |record| {
            let Some(topic) = topics.get(record.topic) else { return Flow::On };
            let Some(serialization) = topic.serialization else { return Flow::On };
            let mut flow = Flow::On;
            // One /tf may be that of many robots.
            let is_tf = robots.iter().any(|robot| robot.choice.is_fixed(record.topic).is_some());
            let transforms = is_tf.then(|| TfMessage::decode(serialization, record.bytes));
            for robot in &mut robots {
                if let (Some(is_fixed), Some(transforms)) = (robot.choice.is_fixed(record.topic), &transforms) {
                    robot.take_tf(transforms, is_fixed, &topic.name);
                }
                if let Err(error) = robot.take(serialization, &topic.kind, &topic.name, record) {
                    robot.error = Some(error);
                    flow = Flow::Stop;
                }
            }
            flow
        },
    )?;
    let damage = damage.beyond(bag.damage());
    let mut joined = robots.into_iter().map(|robot| robot.finish(bag, &damage)).collect::<Result<Vec<_>, _>>()?;
    // It is that of the bag, and so it is told once.
    if let Some(first) = joined.first_mut() {
        damage.told().iter().for_each(|told| first.tally.count(told));
    }
    Ok(joined)
}

impl Choice {
    /// Whether the topic's transforms are for all time; none if they are not those of this robot.
    fn is_fixed(&self, topic: usize) -> Option<bool> {
        self.tf.iter().find(|(index, _)| *index == topic).map(|(_, is_fixed)| *is_fixed)
    }

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
            frames: Frames::default(),
            clouds: Vec::new(),
            tree: TfTree::default(),
            tally: Tally::default(),
            poses_bad: Tally::default(),
            clouds_bad: Tally::default(),
            error: None,
        }
    }

    fn take_tf(&mut self, transforms: &Result<TfMessage, WireError>, is_fixed: bool, name: &str) {
        match transforms {
            Ok(message) => self.tree.take(message, is_fixed),
            Err(error) => self.tally.count(format!("{name}: {error}")),
        }
    }

    /// Takes what is no transform.
    fn take(
        &mut self,
        serialization: Serialization,
        kind: &str,
        name: &str,
        Record { topic, received_ns, bytes }: Record<'_>,
    ) -> Result<(), JoinError> {
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
                        let frames = match self.frames.index(header.frame(), plain_frame(&body)) {
                            Ok(frames) => frames,
                            Err(why) => {
                                self.poses_bad.count(why);
                                return Ok(());
                            }
                        };
                        let covariance = covariance.map(|stated| {
                            if self.covariances.last() != Some(&stated) {
                                self.covariances.push(stated);
                            }
                            self.covariances.len() - 1
                        });
                        self.poses.push((header.stamp_ns, received_ns, frames, (pose, covariance)));
                    }
                },
            }
        }
        Ok(())
    }

    fn finish(mut self, bag: &Bag, damage: &Damage) -> Result<Joined, JoinError> {
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
                let poses = std::mem::take(&mut self.poses);
                let (poses, odom, body) = self.frames.commonest(poses, &source.name, &mut self.tally);
                (stamped(poses, &source.name, &mut self.tally), odom, body, source.name.clone())
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
            damage: damage.clone(),
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
            match interpolated(poses, stamp_ns, |(pose, _)| *pose) {
                Ok(pose) => {
                    // A cloud without a pose, as one stamped in the future, says nothing of those that follow.
                    last = stamp_ns;
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
const UNNAMED: &str = "names no body; taken for that of base_link, so the sensor's mounting on it is applied";
const CLOCKLESS: &str = "taken by the time of receipt, as all stamps are 0";

/// Poses in rising order of their stamps.
fn stamped(poses: Vec<Received>, name: &str, tally: &mut Tally) -> Vec<(i64, Sample)> {
    let is_clockless = poses.iter().all(|(stamp, ..)| *stamp == 0);
    let mut samples: Vec<(i64, Sample)> = Vec::with_capacity(poses.len());
    let mut order = Order::default();
    for (stamp, received, _, sample) in poses {
        let at = match stamp {
            0 if is_clockless => {
                tally.count(format!("{name}: {CLOCKLESS}"));
                received
            }
            0 => {
                tally.count(format!("{name}: left out, as the stamp is 0"));
                continue;
            }
            stamp => stamp,
        };
        match order.take(at) {
            Turn::On => {}
            Turn::Back => {
                tally.count(format!("{name}: the clock was set back, or the bag loops; left out"));
                continue;
            }
            Turn::Alone(_) => {
                tally.count(format!("{name}: left out, as the stamp lies far ahead of those before and after it"));
                samples.pop();
            }
        }
        samples.push((at, sample));
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

/// Pairs of frames that one topic names, with how many messages name them.
#[derive(Default)]
struct Frames {
    pairs: Vec<(String, String, usize)>,
    /// Messages that name no body.
    unnamed: u64,
}

impl Frames {
    /// The number of a pair; why there is none.
    fn index(&mut self, odom: &str, body: &str) -> Result<usize, String> {
        if let Some(long) = [odom, body].map(str::len).into_iter().find(|bytes| *bytes > FRAME_BYTES_MAX) {
            return Err(format!(
                "a frame's name has {long} bytes; at most {FRAME_BYTES_MAX} (FRAME_BYTES_MAX) are read"
            ));
        }
        self.unnamed += u64::from(body.is_empty());
        let odom = if odom.is_empty() { ODOM } else { odom };
        let body = if body.is_empty() { BODY } else { body };
        let found = self.pairs.iter().position(|(a, b, _)| a == odom && b == body);
        if found.is_none() && self.pairs.len() == CLOUD_FRAMES_MAX {
            return Err(format!("names more than {CLOUD_FRAMES_MAX} pairs of frames (CLOUD_FRAMES_MAX)"));
        }
        let index = found.unwrap_or(self.pairs.len());
        match self.pairs.get_mut(index) {
            Some((.., count)) => *count += 1,
            None => self.pairs.push((odom.into(), body.into(), 1)),
        }
        Ok(index)
    }

    /// The poses in the frames that most are in (the first of several), and these; what is left out is told.
    fn commonest(&self, mut poses: Vec<Received>, topic: &str, tally: &mut Tally) -> (Vec<Received>, String, String) {
        if self.unnamed > 0 {
            tally.add(format!("{topic}: {UNNAMED}"), self.unnamed);
        }
        let most = self.pairs.iter().map(|(.., count)| *count).max();
        let found = self.pairs.iter().enumerate().find(|(_, (.., count))| Some(*count) == most);
        let Some((index, (odom, body, _))) = found else { return (poses, ODOM.into(), BODY.into()) };
        let all = poses.len();
        poses.retain(|(_, _, frames, _)| *frames == index);
        if poses.len() < all {
            let others = self.pairs.iter().enumerate().filter(|(other, _)| *other != index).take(8);
            let others: Vec<String> = others.map(|(_, (odom, body, _))| format!("{odom} → {body}")).collect();
            let others = others.join(", ");
            let why = format!("{topic}: left out, as they are of other frames ({others}) than most, {odom} → {body}");
            tally.add(why, (all - poses.len()) as u64);
        }
        (poses, odom.clone(), body.clone())
    }
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
