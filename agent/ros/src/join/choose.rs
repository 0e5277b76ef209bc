//! Which topics of a bag are whose. One robot has one odometry and one cloud; several robots in one bag are told by
//! the first part of their topics' names (`/robot1/odom`, `/robot1/scan`). What is not clear is an error that lists
//! the topics and names the option that decides.

use super::{JoinError, listed};
use crate::bag::Topic;
use crate::msg::{LaserScan, Odometry, PointCloud2, PoseStamped, PoseWithCovarianceStamped, TfMessage};
use crate::wire::Message as _;
use std::collections::BTreeMap;

/// What somebody asked for.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// Topic of poses: `nav_msgs/Odometry`, `geometry_msgs/PoseStamped` or `PoseWithCovarianceStamped`. Without a
    /// leading slash it is that of each namespace.
    pub odometry: Option<String>,
    /// Topic of `sensor_msgs/PointCloud2` or `LaserScan`, named alike.
    pub cloud: Option<String>,
}

/// Where poses come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Poses {
    /// Topic of `nav_msgs/Odometry`.
    Odometry(usize),
    /// Topic of `geometry_msgs/PoseStamped` or `PoseWithCovarianceStamped`.
    Stamped(usize),
    /// TF `odom → base_link`.
    Tf,
}

/// The topics of one robot, by their indices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Choice {
    /// First part of its topics' names, if the bag has several robots.
    pub namespace: Option<String>,
    /// Where its poses come from.
    pub poses: Poses,
    /// Its clouds.
    pub cloud: usize,
    /// Its transforms, and whether they are for all time.
    pub tf: Vec<(usize, bool)>,
}

const ODOMETRY: &str = "--odometry";
const CLOUD: &str = "--cloud";
const POSES: [&str; 3] = [Odometry::TYPE, PoseStamped::TYPE, PoseWithCovarianceStamped::TYPE];
const CLOUDS: [&str; 2] = [PointCloud2::TYPE, LaserScan::TYPE];

/// The topics of each robot, in the order of their namespaces.
///
/// # Errors
/// [`JoinError`], where it is not clear which topics are meant.
pub fn choose(topics: &[Topic], wanted: &Wanted) -> Result<Vec<Choice>, JoinError> {
    let odometries = match &wanted.odometry {
        Some(name) => {
            named(topics, name, &POSES, ODOMETRY, "nav_msgs/Odometry, PoseStamped or PoseWithCovarianceStamped")?
        }
        None => of_kinds(topics, &[Odometry::TYPE]),
    };
    let clouds = match &wanted.cloud {
        Some(name) => named(topics, name, &CLOUDS, CLOUD, "sensor_msgs/PointCloud2 or LaserScan")?,
        None => of_kinds(topics, &CLOUDS),
    };
    if clouds.is_empty() {
        return Err(JoinError::NoClouds(listed(topics)));
    }
    match (odometries.as_slice(), clouds.as_slice()) {
        ([], [cloud]) => {
            if of_kinds(topics, &[TfMessage::TYPE]).is_empty() {
                return Err(JoinError::NoPoses(listed(topics)));
            }
            Ok(vec![choice(topics, None, Poses::Tf, *cloud)])
        }
        ([odometry], [cloud]) => Ok(vec![choice(topics, None, poses(topics, *odometry), *cloud)]),
        _ => by_namespace(topics, &odometries, &clouds, wanted),
    }
}

/// One robot for each namespace that has one of both, if that is all there is.
fn by_namespace(
    topics: &[Topic],
    odometries: &[usize],
    clouds: &[usize],
    wanted: &Wanted,
) -> Result<Vec<Choice>, JoinError> {
    let mut robots: BTreeMap<&str, (Vec<usize>, Vec<usize>)> = BTreeMap::new();
    for index in odometries {
        robots.entry(namespace(&topics[*index].name)).or_default().0.push(*index);
    }
    for index in clouds {
        robots.entry(namespace(&topics[*index].name)).or_default().1.push(*index);
    }
    let whole = |(name, both): (&&str, &(Vec<usize>, Vec<usize>))| match (both.0.as_slice(), both.1.as_slice()) {
        ([odometry], [cloud]) if !name.is_empty() => {
            Some(choice(topics, Some((*name).to_owned()), poses(topics, *odometry), *cloud))
        }
        _ => None,
    };
    let several = |of: &[usize], what, option| {
        let list = listed(of.iter().map(|index| &topics[*index]));
        // What was said once and did not suffice is not said again.
        let said = if option == CLOUD { &wanted.cloud } else { &wanted.odometry };
        let is_said = said.as_ref().is_some_and(|name| !name.starts_with('/'));
        let hint = relative(topics, of, &robots)
            .filter(|_| !is_said)
            .map_or_else(String::new, |name| format!(", or that of each robot without its namespace: {option} {name}"));
        JoinError::Several { count: of.len(), what, list, option, hint }
    };
    match robots.iter().map(whole).collect::<Option<Vec<_>>>() {
        Some(choices) if choices.len() > 1 => Ok(choices),
        _ if odometries.len() > 1 && !one_each(&robots, |both| both.0.len()) => {
            Err(several(odometries, "nav_msgs/Odometry", ODOMETRY))
        }
        _ if clouds.len() > 1 => Err(several(clouds, "sensor_msgs/PointCloud2 or LaserScan", CLOUD)),
        _ => Err(several(odometries, "nav_msgs/Odometry", ODOMETRY)),
    }
}

/// A name that means one of these topics for each robot.
fn relative<'a, T>(topics: &'a [Topic], of: &[usize], robots: &BTreeMap<&str, T>) -> Option<&'a str> {
    if robots.len() < 2 || robots.contains_key("") {
        return None;
    }
    let name = |index: &usize| topics[*index].name.as_str();
    let inner = |index: &usize| Some(name(index).trim_start_matches('/').split_once('/')?.1);
    of.iter().filter_map(inner).find(|inner| {
        let found: Vec<&str> = of.iter().map(name).filter(|name| ends_with(name, inner)).map(namespace).collect();
        found.len() == robots.len() && robots.keys().all(|robot| found.contains(robot))
    })
}

fn ends_with(topic: &str, relative: &str) -> bool {
    topic.strip_suffix(relative).is_some_and(|rest| rest.is_empty() || rest.ends_with('/'))
}

fn one_each<T>(robots: &BTreeMap<&str, T>, count: impl Fn(&T) -> usize) -> bool {
    robots.iter().all(|(name, both)| !name.is_empty() && count(both) == 1)
}

/// The first part of a name that has several; empty for `/odom`.
fn namespace(name: &str) -> &str {
    match name.trim_start_matches('/').split_once('/') {
        Some((first, _)) => first,
        None => "",
    }
}

fn of_kinds(topics: &[Topic], kinds: &[&str]) -> Vec<usize> {
    let is_one =
        |topic: &Topic| topic.count > 0 && topic.serialization.is_some() && kinds.contains(&topic.kind.as_str());
    topics.iter().enumerate().filter(|(_, topic)| is_one(topic)).map(|(index, _)| index).collect()
}

/// The topics that somebody named; at least one.
fn named(
    topics: &[Topic],
    name: &str,
    kinds: &[&str],
    option: &'static str,
    expected: &'static str,
) -> Result<Vec<usize>, JoinError> {
    let is_named = |topic: &Topic| match name.starts_with('/') {
        true => topic.name == name,
        false => ends_with(&topic.name, name),
    };
    let found: Vec<usize> =
        topics.iter().enumerate().filter(|(_, topic)| is_named(topic)).map(|(index, _)| index).collect();
    let Some(first) = found.first() else {
        return Err(JoinError::Unknown { option, name: name.into(), list: listed(topics) });
    };
    let good: Vec<usize> = of_kinds(topics, kinds).into_iter().filter(|index| found.contains(index)).collect();
    if !good.is_empty() {
        return Ok(good);
    }
    let Topic { kind, .. } = &topics[*first];
    if kinds.contains(&kind.as_str()) {
        return Err(JoinError::Silent { option, name: name.into() });
    }
    Err(JoinError::Kind { option, name: name.into(), found: kind.clone(), expected })
}

fn poses(topics: &[Topic], index: usize) -> Poses {
    if topics[index].kind == Odometry::TYPE { Poses::Odometry(index) } else { Poses::Stamped(index) }
}

/// With the transforms that are said to all, or in a namespace of the robot's topics.
fn choice(topics: &[Topic], namespace: Option<String>, poses: Poses, cloud: usize) -> Choice {
    let odometry = match poses {
        Poses::Odometry(index) | Poses::Stamped(index) => Some(&topics[index].name),
        Poses::Tf => None,
    };
    let tf = of_kinds(topics, &[TfMessage::TYPE]).into_iter().filter_map(|index| {
        let name = &topics[index].name;
        let (within, last) = name.rsplit_once('/').unwrap_or(("", name));
        let is_near = |topic: &String| topic.starts_with(&format!("{within}/"));
        let is_mine = is_near(&topics[cloud].name) || odometry.is_some_and(is_near);
        is_mine.then_some((index, last == "tf_static"))
    });
    Choice { namespace, poses, cloud, tf: tf.collect() }
}
