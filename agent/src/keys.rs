//! The keys of DESIGN §5: where on Zenoh each message of each robot travels, with which encoding and quality of
//! service.
//!
//! `merganser/v1/{swarm}/{robot}/…`: a changed wire version is a different key, so incompatible versions never meet.
//! Congestion control is always `Drop`: with `Block` one stalled neighbour would close the session after 5 s. On TCP
//! all messages are reliable once sent; "best effort" means that they may be dropped before (Zenoh's reliability hint
//! is an unstable interface in 1.10 and changes nothing on TCP).

use merganser_protocol::agent::io::{Channel, QueryKind};
use merganser_protocol::ids::Name;
use zenoh::bytes::Encoding;
use zenoh::qos::Priority;

/// First part of every key.
pub const PREFIX: &str = "merganser/v1";
/// All broadcast channels.
pub const CHANNELS: [Channel; 3] = [Channel::Pose, Channel::Facts, Channel::Have];
/// All questions between robots.
pub const QUERIES: [QueryKind; 4] = [QueryKind::Sync, QueryKind::Blob, QueryKind::Align, QueryKind::Life];
/// All views, as in `…/view/{name}`.
pub const VIEWS: [&str; 7] = ["status", "frames", "poses", "map", "path", "graph", "stats"];
/// Last part of a robot's liveliness key.
pub const ALIVE: &str = "alive";
/// What a robot's own SLAM sends.
pub const INPUTS: [&str; 3] = ["keyframe", "sighting", "position"];

/// The last part of a channel's keys.
pub fn channel(channel: Channel) -> &'static str {
    match channel {
        Channel::Pose => "pose",
        Channel::Facts => "facts",
        Channel::Have => "have",
    }
}

/// The last part of a question's keys.
pub fn query(kind: QueryKind) -> &'static str {
    match kind {
        QueryKind::Sync => "sync",
        QueryKind::Blob => "blob",
        QueryKind::Align => "align",
        QueryKind::Life => "life",
    }
}

/// `merganser/v1/{swarm}/{robot}/{rest}`.
pub fn of(swarm: &Name, robot: &Name, rest: &str) -> String {
    format!("{PREFIX}/{swarm}/{robot}/{rest}")
}

/// `merganser/v1/{swarm}/*/{rest}`: the same of every robot.
pub fn of_all(swarm: &Name, rest: &str) -> String {
    format!("{PREFIX}/{swarm}/*/{rest}")
}

/// The robot that a key names, and what follows its name.
pub fn split(key: &str) -> Option<(Name, &str)> {
    let mut parts = key.strip_prefix(PREFIX)?.strip_prefix('/')?.splitn(3, '/');
    let (_swarm, robot, rest) = (parts.next()?, parts.next()?, parts.next()?);
    Some((Name::new(robot).ok()?, rest))
}

/// Priority of a channel: a pose is worth little a second later; repair catches up on the rest.
pub fn priority(channel: Channel) -> Priority {
    match channel {
        Channel::Pose => Priority::InteractiveHigh,
        Channel::Facts => Priority::Data,
        Channel::Have => Priority::Background,
    }
}

/// Priority of a question and its answer.
pub fn query_priority(kind: QueryKind) -> Priority {
    match kind {
        QueryKind::Sync | QueryKind::Align | QueryKind::Life => Priority::Data,
        QueryKind::Blob => Priority::DataLow,
    }
}

/// Encoding of a broadcast, which names its schema.
pub fn encoding(channel: Channel) -> Encoding {
    postcard(match channel {
        Channel::Pose => "Pose",
        Channel::Facts => "Facts",
        Channel::Have => "Have",
    })
}

/// Encoding of a question and its answer.
pub fn query_encoding(kind: QueryKind) -> Encoding {
    postcard(match kind {
        QueryKind::Sync => "Sync",
        QueryKind::Blob => "Blob",
        QueryKind::Align => "Align",
        QueryKind::Life => "Life",
    })
}

/// Encoding of a view.
pub fn view_encoding(view: &str) -> Encoding {
    Encoding::APPLICATION_JSON.with_schema(format!("merganser.view.{view}/1"))
}

fn postcard(name: &str) -> Encoding {
    Encoding::APPLICATION_OCTET_STREAM.with_schema(format!("merganser.{name}/1;postcard"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_put_together_and_taken_apart() {
        let (swarm, robot) = (Name::new("demo").unwrap(), Name::new("alpha").unwrap());
        let key = of(&swarm, &robot, "view/status");
        assert_eq!(key, "merganser/v1/demo/alpha/view/status");
        assert_eq!(split(&key), Some((robot, "view/status")));
        for bad in ["merganser/v2/demo/alpha/pose", "merganser/v1/demo", "merganser/v1/demo/ALPHA/pose", "x"] {
            assert_eq!(split(bad), None, "{bad}");
        }
        for key in [of_all(&swarm, "pose"), of_all(&swarm, ALIVE)] {
            zenoh::key_expr::KeyExpr::new(key).unwrap();
        }
    }

    #[test]
    fn an_encoding_names_its_schema() {
        let text = encoding(Channel::Pose).to_string();
        assert_eq!(text, "application/octet-stream;merganser.Pose/1;postcard");
        assert_eq!(view_encoding("poses").to_string(), "application/json;merganser.view.poses/1");
    }
}
