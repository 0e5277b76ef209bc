//! What is wrong with a message that is no message, in the sender's terms: which field, how many numbers it should have
//! and in which order, and how to send them. Looked at only after the strict reader has refused it.

use super::ObservationError;
use serde::de::{DeserializeOwned, IgnoredAny};
use serde_json::Value;

/// Numbers of a field, and their order.
struct Wanted {
    name: &'static str,
    count: usize,
    order: &'static str,
}

/// Characters that are told of a message at most.
const TOLD_MAX: usize = 500;

const TRIANGLE: &str = "the upper triangle of the 6×6 matrix row by row, translation before rotation; from ROS's 36: \
                        [c[6 * r + k] for r in range(6) for k in range(r, 6)]";
const TRIANGLE_3: &str = "the upper triangle of the 3×3 matrix row by row: xx, xy, xz, yy, yz, zz";
const FIELDS: [Wanted; 4] = [
    Wanted { name: "translation", count: 3, order: "x, y, z" },
    Wanted { name: "position", count: 3, order: "x, y, z" },
    Wanted { name: "rotation", count: 4, order: "the quaternion x, y, z, w" },
    Wanted { name: "covariance", count: 21, order: TRIANGLE },
];

/// Why JSON is no `T`: a keyframe, sighting or position.
pub(super) fn json<T: DeserializeOwned>(bytes: &[u8], error: &serde_json::Error) -> ObservationError {
    let told = told(bytes).unwrap_or_else(|| named::<T>(bytes, error));
    ObservationError::Json(one_line(&told))
}

/// The error, with the field that it is of before it.
fn named<T: DeserializeOwned>(bytes: &[u8], error: &serde_json::Error) -> String {
    let mut reader = serde_json::Deserializer::from_slice(bytes);
    let field = serde_path_to_error::deserialize::<_, T>(&mut reader).err().map(|error| error.path().to_string());
    // A text that is no JSON has no fields.
    let is_json = serde_json::from_slice::<IgnoredAny>(bytes).is_ok();
    match field.filter(|field| is_json && field != ".") {
        Some(field) => format!("{field}: {error}"),
        None => error.to_string(),
    }
}

/// Names of fields are the sender's: what is told of them is one line, and not as long as they like. Of a longer one the
/// beginning is told and the end, where the cure stands.
fn one_line(told: &str) -> String {
    let breaks = |c: char| c.is_control() || matches!(c, '\u{2028}' | '\u{2029}');
    let line: Vec<char> = told.chars().map(|c| if breaks(c) { ' ' } else { c }).collect();
    if line.len() <= TOLD_MAX {
        return line.into_iter().collect();
    }
    let half = (TOLD_MAX - 1) / 2;
    line[..half].iter().chain(&['…']).chain(&line[line.len() - half..]).collect()
}

/// Whether bytes that were sent as postcard are JSON.
pub(super) fn is_json(bytes: &[u8]) -> bool {
    bytes.trim_ascii_start().first() == Some(&b'{') && serde_json::from_slice::<Value>(&finite(bytes).0).is_ok()
}

fn told(bytes: &[u8]) -> Option<String> {
    let (text, has_odd) = finite(bytes);
    let Ok(Value::Object(fields)) = serde_json::from_slice(&text) else { return None };
    let null = |value: &Value| value.is_null();
    for wanted in &FIELDS {
        let Some(value) = fields.get(wanted.name) else { continue };
        // A position's covariance is of its place alone.
        let is_seen = fields.contains_key("position") && !fields.contains_key("points");
        let is_of_place = is_seen && wanted.name == "covariance";
        let (count, order) = if is_of_place { (6, TRIANGLE_3) } else { (wanted.count, wanted.order) };
        if let Some(fault) = numbers(value, count, order) {
            return Some(format!("{}: {fault}", wanted.name));
        }
    }
    if let Some(Value::Array(points)) = fields.get("points") {
        for (index, point) in points.iter().enumerate() {
            let is_flat = point.is_number();
            let found = point.as_array().map_or(0, Vec::len);
            if is_flat || found != 3 {
                let got = if is_flat { "a number".to_owned() } else { format!("{found} numbers") };
                return Some(format!(
                    "points: [x, y, z] of each, not {got} as points[{index}]; leave intensity and the like out"
                ));
            }
            if point.as_array().is_some_and(|point| point.iter().any(null)) {
                return Some(format!(
                    "points: every number must be finite, and JSON has no NaN; points[{index}] is not: leave it out"
                ));
            }
        }
    }
    if let Some(Value::Number(stamp)) = fields.get("stamp_ns").filter(|stamp| stamp.as_i64().is_none()) {
        return Some(format!("stamp_ns: a whole number of nanoseconds, not {stamp}; in Python int(seconds * 1e9)"));
    }
    let field = fields.iter().find(|(_, value)| has_odd && holds(value, &null)).map(|(name, _)| name);
    field.map(|name| format!("{name}: every number must be finite, and JSON has no NaN"))
}

/// What is wrong with an array of numbers.
fn numbers(value: &Value, count: usize, order: &str) -> Option<String> {
    let Some(values) = value.as_array() else { return Some(format!("{count} numbers are wanted: {order}")) };
    if let Some(odd) = values.iter().find(|value| !value.is_number() && !value.is_null()) {
        let flat = if odd.is_array() { "; write them in one list" } else { "" };
        return Some(format!("{count} numbers are wanted, not {}{flat}: {order}", kind(odd)));
    }
    if values.len() != count {
        return Some(format!("{count} numbers are wanted, not {}: {order}", values.len()));
    }
    values.iter().any(Value::is_null).then(|| "every number must be finite, and JSON has no NaN".to_owned())
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::Array(_) => "lists",
        Value::String(_) => "text",
        Value::Object(_) => "objects",
        Value::Bool(_) => "true or false",
        Value::Null | Value::Number(_) => "numbers",
    }
}

fn holds(value: &Value, what: &impl Fn(&Value) -> bool) -> bool {
    match value {
        Value::Array(values) => values.iter().any(|value| holds(value, what)),
        Value::Object(fields) => fields.values().any(|value| holds(value, what)),
        other => what(other),
    }
}

/// The text with `null` in place of `NaN` and `Infinity`, which Python writes and JSON does not have; whether there were
/// any.
fn finite(bytes: &[u8]) -> (Vec<u8>, bool) {
    const ODD: [&[u8]; 3] = [b"NaN", b"-Infinity", b"Infinity"];
    let (mut out, mut rest, mut in_text, mut any) = (Vec::with_capacity(bytes.len()), bytes, false, false);
    while let Some((&byte, after)) = rest.split_first() {
        if let Some(odd) = ODD.iter().find(|odd| !in_text && rest.starts_with(odd)) {
            out.extend(b"null");
            (rest, any) = (&rest[odd.len()..], true);
            continue;
        }
        let taken = if in_text && byte == b'\\' { rest.len().min(2) } else { 1 };
        in_text ^= byte == b'"';
        out.extend(&rest[..taken]);
        rest = if taken == 1 { after } else { &rest[taken..] };
    }
    (out, any)
}
