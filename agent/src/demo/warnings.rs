//! What the agents warned of in their logs: whoever looks for why robots did not merge should not have to find the logs.

use merganser_protocol::ids::Name;
use std::collections::BTreeMap;

/// Warnings told at most; the logs have all.
const WARNINGS_MAX: usize = 8;

/// A line for each warning and error, with the robots that gave it, in the order in which they came. What differs in
/// fields alone is one warning. Empty if there were none.
pub fn told<'a>(logs: impl IntoIterator<Item = (&'a Name, String)>) -> String {
    let mut order: Vec<String> = Vec::new();
    let mut by: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (name, log) in logs {
        for warning in log.lines().filter_map(warning) {
            let robots = by.entry(warning.to_owned()).or_insert_with(|| {
                order.push(warning.to_owned());
                Vec::new()
            });
            if robots.last().is_none_or(|last| last != name.as_str()) {
                robots.push(name.to_string());
            }
        }
    }
    let more = order.len().saturating_sub(WARNINGS_MAX);
    let mut lines: Vec<String> =
        order.iter().take(WARNINGS_MAX).map(|warning| format!("  ! {}: {warning}\n", by[warning].join(", "))).collect();
    if more > 0 {
        lines.push(format!("  ! {more} other kinds of warnings are in the logs\n"));
    }
    lines.concat()
}

/// The text of a log line that is a warning or an error, without its fields. What the place repeats by itself is none:
/// disputed alignments and frames that part are in the map's own report.
fn warning(line: &str) -> Option<&str> {
    let (_, text) = line.split_once(" WARN ").or_else(|| line.split_once(" ERROR "))?;
    let is_key = |key: &str| !key.is_empty() && key.chars().all(|c| c.is_ascii_lowercase() || c == '_');
    let is_field = |word: &str| word.split_once('=').is_some_and(|(key, _)| is_key(key));
    let end = text.split(' ').take_while(|word| !is_field(word)).map(|word| word.len() + 1).sum::<usize>();
    let text = text[..end.min(text.len())].trim();
    (!text.is_empty() && !["alignment disputed", "no longer merged"].contains(&text)).then_some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_warning_is_told_once_with_the_robots_that_gave_it() {
        let names = ["alpha", "beta"].map(|name| Name::new(name).unwrap());
        let line = |level: &str, text: &str| format!("2026-01-01T00:00:00Z {level} {text}\n");
        let odd = "one pose covariance: state covariance_of = \"motion\"";
        let alpha = line(" WARN", &format!("{odd} frame=a/1"))
            + &line(" INFO", "merged frame=b/1")
            + &line(" WARN", "alignment disputed i=a/1#2 j=b/1#3")
            + &line("ERROR", "the disk is full reason=no room")
            + &line(" WARN", &format!("{odd} frame=a/2"));
        let beta = line(" WARN", &format!("{odd} frame=b/1"));
        let told = |logs: [&str; 2]| told(names.iter().zip(logs.map(str::to_owned)));
        assert_eq!(told([&alpha, &beta]), format!("  ! alpha, beta: {odd}\n  ! alpha: the disk is full\n"));
        assert_eq!(told(["", "nothing to see"]), "");
        let many = |count: usize| -> String { (0..count).map(|k| line(" WARN", &format!("kind {k}"))).collect() };
        assert_eq!(told([&many(WARNINGS_MAX), ""]).lines().count(), WARNINGS_MAX);
        assert!(told([&many(WARNINGS_MAX + 2), ""]).ends_with("  ! 2 other kinds of warnings are in the logs\n"));
    }
}
