//! What clock the stamps are of: this host's, another one, or a simulation's.

use merganser_protocol::time::Stamp;
use time::{Duration, OffsetDateTime};

/// Stamps before this, ns since 1970, are of no clock that was ever set: three years.
pub const SET_MIN_NS: i64 = 94_608_000 * 1_000_000_000;
/// Clocks this near one another are one, s: what a keyframe may take on its way.
pub const SAME_SECS: f64 = 2.0;
/// A stamp that is the present time in another unit is so to this, s since 1970: a day. A good clock of nanoseconds since a
/// start shows the present microseconds for three minutes, after 20 days.
const UNIT_SLACK_SECS: f64 = 86_400.0;
/// Units, and how many of them are a second.
const UNITS: [(&str, f64); 3] = [("seconds", 1.0), ("milliseconds", 1e3), ("microseconds", 1e6)];

/// What is told of a clock.
#[derive(Clone, Debug, Default)]
pub struct Told {
    /// In words.
    pub text: String,
    /// The stamps are the present time in another unit than nanoseconds.
    pub is_other_unit: bool,
}

/// What is told of the first stamp, and of what this host's clock showed when its keyframe came, if that is known.
pub fn told(first: Stamp, host: Option<Stamp>) -> Told {
    let unit = host.and_then(|host| {
        let now = host.0 as f64 * 1e-9;
        UNITS.iter().find(|(_, per_sec)| (first.0 as f64 / per_sec - now).abs() < UNIT_SLACK_SECS)
    });
    match unit {
        Some((unit, _)) => {
            Told { text: format!("the stamps are this host's time in {unit}: send nanoseconds"), is_other_unit: true }
        }
        None => Told { text: of_nanoseconds(first, host), is_other_unit: false },
    }
}

fn of_nanoseconds(first: Stamp, host: Option<Stamp>) -> String {
    if first.0 < SET_MIN_NS {
        let secs = first.0 as f64 * 1e-9;
        return format!("begins at {secs:.3} s: since a start, or simulated (no date)");
    }
    let date = OffsetDateTime::UNIX_EPOCH + Duration::nanoseconds(first.0);
    let (day, [hour, minute, second]) = (date.date(), [date.hour(), date.minute(), date.second()]);
    let begins = format!("begins at {day} {hour:02}:{minute:02}:{second:02} UTC");
    match host.map(|host| first.secs_since(host)) {
        Some(off) if off.abs() <= SAME_SECS => format!("{begins}, this host's clock"),
        Some(off) if off < 0.0 => format!("{begins}, {:.1} s before this host's clock", -off),
        Some(off) => format!("{begins}, {off:.1} s after this host's clock"),
        None => begins,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn text(first: i64, host: Option<i64>) -> String {
        told(Stamp(first), host.map(Stamp)).text
    }

    const NOW: i64 = 1_700_000_000_123_456_789;

    #[test]
    fn clocks_are_told_apart() {
        let told = |first: i64| text(first, Some(NOW));
        assert_eq!(told(NOW - 100_000_000), "begins at 2023-11-14 22:13:20 UTC, this host's clock");
        assert_eq!(told(NOW - 7_300_000_000), "begins at 2023-11-14 22:13:12 UTC, 7.3 s before this host's clock");
        assert_eq!(
            told(NOW + 3_600_000_000_000),
            "begins at 2023-11-14 23:13:20 UTC, 3600.0 s after this host's clock"
        );
        assert_eq!(told(12_500_000_000), "begins at 12.500 s: since a start, or simulated (no date)");
        assert_eq!(told(0), "begins at 0.000 s: since a start, or simulated (no date)");
        for (unit, per_ns) in [("seconds", 1_000_000_000), ("milliseconds", 1_000_000), ("microseconds", 1_000)] {
            assert_eq!(told(NOW / per_ns), format!("the stamps are this host's time in {unit}: send nanoseconds"));
        }
        // Nanoseconds since a start 20 days ago are near the present microseconds.
        let since_start = |off_secs: i64| told(NOW / 1_000 + off_secs * 1_000_000_000);
        assert!(since_start(90).contains("since a start") && since_start(-90).contains("since a start"));
        assert!(since_start(80).contains("microseconds") && since_start(-80).contains("microseconds"));
        // Of a recording nobody knows when it came.
        assert_eq!(text(NOW, None), "begins at 2023-11-14 22:13:20 UTC");
        assert!(text(NOW / 1_000_000_000, None).contains("no date"));
    }

    #[test]
    fn the_bounds_are_told_on_both_sides() {
        let off = |secs: f64| text(NOW + (secs * 1e9) as i64, Some(NOW));
        assert!(off(SAME_SECS - 0.01).ends_with("this host's clock") && !off(SAME_SECS - 0.01).contains("after"));
        assert!(off(SAME_SECS + 0.01).contains("after this host's clock"));
        assert!(text(SET_MIN_NS - 1, None).contains("no date"));
        assert_eq!(text(SET_MIN_NS, None), "begins at 1972-12-31 00:00:00 UTC");
    }

    proptest! {
        #[test]
        fn whatever_the_stamps_are_they_are_told(first: i64, host: Option<i64>) {
            prop_assert!(!text(first, host).is_empty());
        }
    }
}
