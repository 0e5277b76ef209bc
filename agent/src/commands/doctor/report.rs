//! What `doctor` tells, as text.

use super::Examined;
use std::fmt::Write as _;

pub(super) fn text(seen: &Examined) -> String {
    let mut text = String::new();
    let sensor = serde_json::to_value(seen.sensor).ok();
    let sensor = sensor.as_ref().and_then(|sensor| sensor.as_str()).unwrap_or_default();
    let hz = if seen.secs > 0.0 { (seen.keyframes.saturating_sub(1)) as f64 / seen.secs } else { 0.0 };
    let [near, far] = seen.reach_m;
    let [metres, degrees] = seen.step;
    let [x, y, z, roll, pitch, yaw] = seen.sigmas;
    let [aligned, tried] = seen.aligned;
    let [fact, blob] = seen.bytes;
    let [facts, blobs] = seen.bytes_per_sec;
    let refused: u64 = seen.refused.values().sum();
    let _ = write!(
        text,
        "{}\n\
         \x20 keyframes   {} in {:.1} s, {hz:.2} a second by their stamps; {refused} refused\n\
         \x20 clock       {}\n\
         \x20 points      {:.0} in each; half lie within {near:.2} m, nine in ten within {far:.2} m\n\
         \x20 steps       {metres:.3} m and {degrees:.2}° from keyframe to keyframe\n\
         \x20 stated σ    x {x:.2e}, y {y:.2e}, z {z:.2e} m; roll {roll:.2e}, pitch {pitch:.2e}, yaw {yaw:.2e} °\n\
         \x20 submaps     {} looked at, as {sensor} at {} m: {:.0} keypoints in each\n\
         \x20 overlap     {aligned} of {tried} submaps align with the one after it",
        seen.robot, seen.keyframes, seen.secs, seen.clock, seen.points, seen.submaps, seen.voxel_m, seen.keypoints,
    );
    if let Some(off) = seen.off_odometry_m {
        let _ = write!(text, ", {off:.3} m off the odometry");
    }
    let _ = writeln!(
        text,
        "\n\
         \x20 radio       {fact:.0} bytes a submap to each robot, and {blob:.0} to those that may have seen the same: \
         {facts:.0} and {blobs:.0} bytes a second"
    );
    for remark in &seen.remarks {
        let _ = writeln!(text, "! {remark}");
    }
    if seen.remarks.is_empty() {
        text.push_str("  nothing to change\n");
    }
    text
}
