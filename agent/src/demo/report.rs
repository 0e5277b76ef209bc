//! What the demonstration prints.

use super::certainty::Certainty;
use super::evaluate::{CHI2_6_95, CHI2_7_95, Check, Evaluation, Pair, Singles};
use super::track::Track;
use super::trajectory::TrajectoryError;
use super::views::Views;
use crate::recording::Recording;
use console::style;
use merganser_protocol::geometry::Relative;
use merganser_protocol::snapshot::PairStatus;
use std::collections::BTreeSet;
use std::fmt::Write as _;

/// What each robot is fed.
pub(super) fn recordings(recordings: &[Recording], speed: f64) -> String {
    let mut text = String::new();
    for recording in recordings {
        let (manifest, secs) = (recording.manifest(), recording.duration_secs());
        let _ = writeln!(
            text,
            "  {:<8} {:>3} keyframes, {secs:.1} s of {} at {speed}× speed",
            manifest.robot.as_str(),
            recording.len(),
            manifest.sensor
        );
    }
    let origins: BTreeSet<&str> = recordings.iter().map(|r| r.manifest().origin.as_str()).collect();
    for origin in origins.into_iter().filter(|origin| !origin.is_empty()) {
        let _ = writeln!(text, "  {origin}");
    }
    text
}

/// Alignments with their uncertainty and error, then the paths' errors.
pub(super) fn evaluation(evaluation: &Evaluation, tracks: &[Track]) -> String {
    let mut text = String::from("Frame alignments (t_a_b; rotation as a vector; σ and error in b)\n");
    for pair in &evaluation.pairs {
        alignment(&mut text, pair);
    }
    let errors = evaluation.pairs.iter().filter_map(|pair| pair.error.as_ref());
    let (inside, all) = errors.fold((0, 0), |(inside, all), e| (inside + u32::from(e.inside_95()), all + 1));
    if all > 0 {
        let bound = bounds_95(evaluation);
        let _ = writeln!(text, "  {inside} of {all} errors lie inside their claimed 95 % ellipsoid (NEES ≤ {bound})");
    }
    for (track, Certainty { hold, contradict, .. }) in tracks.iter().zip(&evaluation.loops) {
        if hold + contradict > 0 {
            let _ = writeln!(text, "  Loops of {}: {hold} alignments hold, {contradict} contradict", track.name);
        }
    }
    let Singles { count, nees_mean, inside_95, translation_rms_m, rotation_rms_deg } = evaluation.singles;
    if count > 0 {
        let _ = writeln!(
            text,
            "  Single alignments used: {count}, error {translation_rms_m:.3} m and {rotation_rms_deg:.2}° RMS, {inside_95} \
             inside their 95 % ellipsoid, mean NEES {nees_mean:.1} (6 if honest)"
        );
    }
    if let Some(errors) = &evaluation.trajectory {
        trajectory(&mut text, errors, tracks);
    }
    text
}

/// The bounds of the ellipsoids, of as many kinds as there are.
fn bounds_95(evaluation: &Evaluation) -> String {
    let freedoms: BTreeSet<usize> =
        evaluation.pairs.iter().filter_map(|pair| Some(pair.error?.degrees_of_freedom)).collect();
    match (freedoms.contains(&6), freedoms.contains(&7)) {
        (true, true) => format!("{CHI2_6_95:.3}, with a scale {CHI2_7_95:.3}"),
        (false, true) => format!("{CHI2_7_95:.3}"),
        _ => format!("{CHI2_6_95:.3}"),
    }
}

fn alignment(text: &mut String, pair: &Pair) {
    let [a, b] = &pair.robots;
    let [proposed, agreed, used] = pair.alignments;
    let status = match pair.status {
        Some(PairStatus::Merged) => style("merged").green(),
        Some(PairStatus::Provisional) => style("provisional").yellow(),
        Some(PairStatus::Ambiguous) => style("ambiguous").yellow(),
        Some(PairStatus::Inconsistent) => style("inconsistent").red(),
        None => style("nothing in common was found").yellow(),
    };
    let nfa = pair.log10_nfa.map_or(String::new(), |nfa| format!(", log₁₀ NFA {nfa:.1}"));
    let _ = writeln!(
        text,
        "  {} {status}, {proposed} alignments proposed, {agreed} agreed, {used} used{nfa}",
        style(format!("{a} – {b}")).bold()
    );
    if let Some(told) = &pair.in_vain {
        let _ = writeln!(text, "    {told}");
    }
    let Some(t) = &pair.t_a_b else { return };
    let sim = t.sim();
    let (p, r) = (sim.translation, sim.rotation.log().map(f64::to_degrees));
    let (s, unit): (Vec<f64>, [&str; 2]) = match t {
        Relative::Metric(t) => (t.covariance.sigmas().as_slice().to_vec(), ["m"; 2]),
        Relative::Similarity(t) => (t.covariance.sigmas().as_slice().to_vec(), ["units of a", "units of b"]),
    };
    let _ = writeln!(
        text,
        "    translation ({:>8.3}, {:>8.3}, {:>8.3}) {}   σ ({:.3}, {:.3}, {:.3}) {}",
        p.x, p.y, p.z, unit[0], s[0], s[1], s[2], unit[1]
    );
    let d: Vec<f64> = s.iter().copied().map(f64::to_degrees).collect();
    let _ = writeln!(
        text,
        "    rotation    ({:>8.2}, {:>8.2}, {:>8.2}) °   σ ({:.2}, {:.2}, {:.2}) °",
        r.x, r.y, r.z, d[3], d[4], d[5]
    );
    if let Some(log_sigma) = s.get(6) {
        let _ = writeln!(text, "    scale       {:>8.4}   σ {:.2} %", sim.scale, 100.0 * log_sigma);
    }
    certainty(text, &pair.certainty);
    let Some(e) = &pair.error else { return };
    let verdict = if e.inside_95() { style("inside").green() } else { style("outside").red() };
    let _ = writeln!(
        text,
        "    error       {:.3} m, {:.2}°{}, NEES {:.2}: {verdict} the claimed 95 % ellipsoid",
        e.translation_m,
        e.rotation_deg,
        e.scale_off(),
        e.nees
    );
}

/// What the map says for and against itself, and how well it knows how the two lie where both were.
fn certainty(text: &mut String, certainty: &Certainty) {
    let Certainty { hold, contradict, middle } = certainty;
    let _ = write!(text, "    by itself    {hold} alignments hold, {contradict} contradict");
    if let Some(([i, j], s)) = middle {
        let way = s[..3].iter().fold(0.0_f64, |a, b| a.max(*b));
        let turn = s[3..6].iter().fold(0.0_f64, |a, b| a.max(*b)).to_degrees();
        let _ = write!(text, "; {j} in {i} known to {way:.3}, {turn:.2}° (largest σ)");
    }
    text.push('\n');
}

fn trajectory(text: &mut String, errors: &TrajectoryError, tracks: &[Track]) {
    let head: Vec<String> = tracks.iter().map(|track| format!("{:>9}", track.name)).collect();
    let _ = writeln!(text, "\nTrajectory error, RMSE over keyframes, m{:>14}{}{:>9}", "", head.concat(), "swarm");
    let mut row = |name: &str, (each, all): &(Vec<f64>, f64)| {
        let each: String = each.iter().map(|e| format!("{e:>9.3}")).collect();
        let _ = writeln!(text, "  {name:<51}{each}{all:>9.3}");
    };
    row("odometry alone, every true start given", &errors.alone_m);
    row("merged, only the first robot's true start given", &errors.merged_m);
    match errors.fitted_scale {
        None => row("merged, after the best rigid fit of the whole swarm", &errors.fitted_m),
        Some(_) => row("merged, after the best fit of the swarm, with scale", &errors.fitted_m),
    }
}

/// Bytes of payload each robot sent, by kind of message, and its memory (now, largest).
pub(super) fn costs(views: &[Views], memory: &[Option<(u64, u64)>]) -> String {
    let mut text = String::from("Sent, kB of payload (messages)\n");
    let kinds: BTreeSet<&String> = views.iter().flat_map(|views| views.stats.sent_bytes.keys()).collect();
    let names: String = views.iter().map(|views| format!("{:>18}", views.status.robot)).collect();
    let _ = writeln!(text, "  {:<14}{names}", "");
    for kind in kinds {
        let cells = views.iter().map(|views| {
            let bytes = views.stats.sent_bytes.get(kind).copied().unwrap_or(0);
            let messages = views.stats.sent_messages.get(kind).copied().unwrap_or(0);
            format!("{:>18}", format!("{:.1} ({messages})", bytes as f64 / 1000.0))
        });
        let _ = writeln!(text, "  {kind:<14}{}", cells.collect::<String>());
    }
    let sum = |views: &Views| views.stats.sent_bytes.values().sum::<u64>() as f64 / 1000.0;
    let sums: String = views.iter().map(|views| format!("{:>18.1}", sum(views))).collect();
    let _ = writeln!(text, "  {:<14}{sums}", "all");
    let cell = |m: &Option<(u64, u64)>| {
        m.map_or("unknown".into(), |(now, most)| format!("{} ({})", now / 1_000_000, most / 1_000_000))
    };
    let cells: String = memory.iter().map(|m| format!("{:>18}", cell(m))).collect();
    let _ = writeln!(text, "Memory, MB resident (most)\n  {:<14}{cells}", "");
    text
}

/// What had to be so and whether it is.
pub(super) fn checks(checks: &[Check]) -> String {
    let mut text = String::from("Checks\n");
    for check in checks {
        let mark = if check.held { style("✓").green() } else { style("✗").red() };
        let found = if check.found.is_empty() { String::new() } else { format!(": {}", check.found) };
        let _ = writeln!(text, "  {mark} {}{found}", check.what);
    }
    text
}
