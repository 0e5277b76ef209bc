//! `merganser watch`: a swarm from outside. A live table of what each robot says of itself, or every message that
//! travels as a line of JSON. It only listens and asks for views: it holds no key and changes nothing.

use super::{BadInput, runtime, say};
use crate::certificates::expiry;
use crate::config::{FileConfig, LogConfig, LogFormat, ZenohConfig};
use crate::keys;
use crate::link::session::{self, Guard, Role};
use crate::telemetry;
use anyhow::{Context, Result, anyhow};
use console::{Term, measure_text_width, pad_str, style};
use merganser_protocol::ids::Name;
use merganser_protocol::snapshot::{FramesView, PairStatus, PairView, StatusView, SuspectView};
use merganser_protocol::wire::messages::Message;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use zenoh::Session;
use zenoh::qos::CongestionControl;
use zenoh::sample::{Sample, SampleKind};

/// Messages that may wait to be printed.
const WAITING_MAX: usize = 4096;
/// How long a robot may take to answer.
const ANSWER_WAIT: Duration = Duration::from_millis(900);
/// A robot that has not answered for this long is shown as silent.
const SILENT: Duration = Duration::from_secs(3);

/// What `merganser watch` can be told.
#[derive(Clone, Debug, clap::Args)]
pub struct WatchArgs {
    /// Configuration of an observer: swarm, key, certificate, roster and endpoints, for a swarm that links by TLS.
    #[arg(long, short, value_name = "FILE", conflicts_with = "swarm")]
    pub config: Option<PathBuf>,
    /// The swarm to watch.
    #[arg(long, default_value = "demo", value_parser = name)]
    pub swarm: Name,
    /// Endpoint of a robot, e.g. tcp/10.0.0.2:7447. May be given more than once.
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// Do not look for robots by multicast.
    #[arg(long)]
    pub no_multicast: bool,
    /// Print every message as a line of JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Stop after so many seconds.
    #[arg(long = "for", value_name = "SECS", value_parser = secs)]
    pub secs: Option<f64>,
    /// Seconds between two tables.
    #[arg(long, value_name = "SECS", default_value_t = 1.0, conflicts_with = "json", value_parser = secs)]
    pub interval: f64,
}

fn name(text: &str) -> Result<Name, String> {
    Name::new(text).map_err(|error| error.to_string())
}

fn secs(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(secs) if (0.01..=1e9).contains(&secs) => Ok(secs),
        _ => Err("use a number from 0.01 to 1000000000".into()),
    }
}

/// Watches until the time is over or a signal comes; false if nothing was seen at all.
///
/// # Errors
/// If Zenoh does not open or the output cannot be written.
pub fn run(args: &WatchArgs) -> Result<bool> {
    let refused = telemetry::init(&LogConfig { format: LogFormat::Text, filter: "warn,zenoh=error".into() });
    let runtime = runtime()?;
    let seen = runtime.block_on(watch(args));
    runtime.shutdown_timeout(Duration::from_millis(200));
    // Whoever sees nobody is told here why.
    for (refusal, count) in refused.take() {
        tracing::warn!(count, cure = refusal.cure(), "{refusal}");
    }
    seen
}

async fn watch(args: &WatchArgs) -> Result<bool> {
    let config = args.config.as_ref().map(|path| FileConfig::load(path)).transpose()?;
    let guard = config.as_ref().map(Guard::of).transpose()?.flatten();
    if let Some(robot) = guard.as_ref().and_then(|guard| guard.robot.as_ref()) {
        return Err(BadInput::told(format!(
            "{robot} is a robot, and views go by TLS to observers alone: name an observer's configuration, or look on from \
             the robot itself by --no-multicast --connect tcp/127.0.0.1:7448"
        )));
    }
    if let Some(warning) = guard.as_ref().and_then(|guard| guard.credentials.certificate.warning(expiry::now())) {
        tracing::warn!("{warning}");
    }
    let mut zenoh = config.as_ref().map_or_else(ZenohConfig::default, |config| config.zenoh.clone());
    zenoh.connect.extend(args.connect.iter().cloned());
    zenoh.multicast &= !args.no_multicast;
    zenoh.validate()?;
    if let Some(tls) = zenoh.connect.iter().find(|endpoint| guard.is_none() && endpoint.starts_with("tls/")) {
        return Err(BadInput::told(format!("{tls} is TLS: name the configuration of an observer by --config")));
    }
    let session = session::open_guarded(&zenoh, Role::Onlooker, guard.as_ref()).await?;
    let swarm = config.map_or_else(|| args.swarm.clone(), |config| config.swarm);
    let end = async {
        let time = args.secs.map(|secs| Duration::try_from_secs_f64(secs).unwrap_or_default());
        let time = async { tokio::time::sleep(time.unwrap_or(Duration::MAX)).await };
        tokio::select! {
            () = time => {}
            _ = tokio::signal::ctrl_c() => {}
        }
    };
    let seen =
        if args.json { messages(&session, &swarm, end).await } else { tables(&session, &swarm, args, end).await };
    session::close(&session, Duration::from_secs(2)).await;
    seen
}

/// Prints every message of the swarm until `end`.
async fn messages(session: &Session, swarm: &Name, end: impl Future<Output = ()>) -> Result<bool> {
    let (sender, mut samples) = mpsc::channel(WAITING_MAX);
    let missed = Arc::new(AtomicU64::new(0));
    let count = missed.clone();
    let heard = move |sample: Sample| {
        if sender.try_send(sample).is_err() {
            count.fetch_add(1, Relaxed);
        }
    };
    let key = format!("{}/{swarm}/**", keys::PREFIX);
    let declared = session.declare_subscriber(key).callback(heard).await;
    let _subscriber = declared.map_err(|error| anyhow!("zenoh refuses the subscription: {error}"))?;
    let start = Instant::now();
    let mut end = std::pin::pin!(end);
    let mut lines = 0_u64;
    loop {
        tokio::select! {
            () = &mut end => break,
            sample = samples.recv() => {
                let Some(sample) = sample else { break };
                say(&describe(&sample, start.elapsed()).to_string())?;
                lines += 1;
            }
        }
    }
    if missed.load(Relaxed) > 0 {
        tracing::warn!(missed = missed.load(Relaxed), "messages came faster than they could be printed");
    }
    Ok(lines > 0)
}

/// A sample as people may want to read it: decoded where we know how, with the reason where it does not decode.
pub fn describe(sample: &Sample, since_start: Duration) -> Value {
    let key = sample.key_expr().as_str();
    let bytes = sample.payload().to_bytes();
    let mut line = json!({
        "secs": since_start.as_secs_f64(),
        "key": key,
        "encoding": sample.encoding().to_string(),
        "bytes": bytes.len(),
    });
    if sample.kind() == SampleKind::Delete {
        line["deleted"] = true.into();
        return line;
    }
    let Some((robot, rest)) = keys::split(key) else { return line };
    line["robot"] = robot.as_str().into();
    line["channel"] = rest.into();
    let decoded = if rest.starts_with("view/") {
        serde_json::from_slice(&bytes).map_err(|error| error.to_string())
    } else if rest.starts_with("in/") {
        return line;
    } else {
        decode(&bytes)
    };
    match decoded {
        Ok(message) => line["message"] = message,
        Err(reason) => line["error"] = reason.into(),
    }
    line
}

fn decode(bytes: &[u8]) -> Result<Value, String> {
    let message = Message::decode(bytes).map_err(|error| error.to_string())?;
    serde_json::to_value(&message).map_err(|error| error.to_string())
}

/// What one robot said of itself, last.
#[derive(Debug, Default)]
struct Seen {
    status: Option<(Instant, StatusView)>,
    pairs: Vec<PairView>,
    suspects: Vec<SuspectView>,
}

/// Asks all robots for their views and shows a table, until `end`.
async fn tables(session: &Session, swarm: &Name, args: &WatchArgs, end: impl Future<Output = ()>) -> Result<bool> {
    let term = Term::stdout();
    let interval =
        Duration::try_from_secs_f64(args.interval).context("--interval: use a positive number of seconds")?;
    let mut ticks = tokio::time::interval(interval.max(Duration::from_millis(100)));
    let mut robots: BTreeMap<Name, Seen> = BTreeMap::new();
    let mut end = std::pin::pin!(end);
    let mut drawn = 0;
    loop {
        tokio::select! {
            () = &mut end => break,
            _ = ticks.tick() => {}
        }
        let (statuses, frames) = tokio::join!(
            ask::<StatusView>(session, swarm, "view/status"),
            ask::<FramesView>(session, swarm, "view/frames"),
        );
        for (robot, status) in statuses {
            robots.entry(robot).or_default().status = Some((Instant::now(), status));
        }
        for (robot, frames) in frames {
            let seen = robots.entry(robot).or_default();
            (seen.pairs, seen.suspects) = (frames.pairs, frames.suspects);
        }
        let text = draw(swarm, &robots);
        if term.is_term() {
            term.clear_last_lines(drawn)?;
        }
        drawn = text.lines().count();
        say(text.trim_end())?;
    }
    Ok(!robots.is_empty())
}

/// The same view of every robot that answers.
async fn ask<T: DeserializeOwned>(session: &Session, swarm: &Name, view: &str) -> Vec<(Name, T)> {
    let (sender, mut replies) = mpsc::channel(WAITING_MAX);
    let asked = session
        .get(keys::of_all(swarm, view))
        .congestion_control(CongestionControl::Drop)
        .timeout(ANSWER_WAIT)
        .callback(move |reply| {
            let _ = sender.try_send(reply); // more robots than fit into a table
        })
        .await;
    if let Err(reason) = asked {
        tracing::debug!(%reason, "nobody was asked");
        return Vec::new();
    }
    let mut views = Vec::new();
    while let Some(reply) = replies.recv().await {
        let Ok(sample) = reply.result() else { continue };
        let robot = keys::split(sample.key_expr().as_str()).map(|(robot, _)| robot);
        let parsed = serde_json::from_slice(&sample.payload().to_bytes());
        match (robot, parsed) {
            (Some(robot), Ok(view)) => views.push((robot, view)),
            (_, Err(reason)) => tracing::warn!(key = sample.key_expr().as_str(), %reason, "a view of another version?"),
            (None, _) => {}
        }
    }
    views
}

fn draw(swarm: &Name, robots: &BTreeMap<Name, Seen>) -> String {
    let heads = ["robot", "epoch", "neighbours", "keyframes", "submaps", "facts", "set", "pending", "merged with"];
    let mut rows = vec![heads.map(String::from).to_vec()];
    for (name, seen) in robots {
        let Some((when, s)) = &seen.status else { continue };
        let state = match () {
            () if when.elapsed() > SILENT => "silent".into(),
            () if s.receive_only => style("receive-only: see its log").red().to_string(),
            () if s.idle => "idle".into(),
            () => s.pending.to_string(),
        };
        let merged = if s.merged_with.is_empty() { "-".into() } else { s.merged_with.join(" ") };
        rows.push(vec![
            name.to_string(),
            s.epoch.to_string(),
            s.neighbours.len().to_string(),
            s.keyframes.to_string(),
            s.submaps.to_string(),
            s.entries.to_string(),
            s.digest.chars().take(8).collect(),
            state,
            merged,
        ]);
    }
    if rows.len() == 1 {
        return format!(
            "swarm {swarm}: no robot answers (where links are by TLS, name an observer's configuration: --config)\n"
        );
    }
    let mut text = format!("swarm {swarm}\n");
    lay_out(&mut text, &rows);
    let statuses = robots.values().filter_map(|seen| Some(&seen.status.as_ref()?.1));
    if let Some(warning) = estimates_differ(statuses) {
        let _ = writeln!(text, "{}", style(warning).yellow()); // a String takes any text
    }
    let mut pairs = BTreeMap::new();
    for pair in robots.values().flat_map(|seen| &seen.pairs) {
        let before = pairs.entry((&pair.a, &pair.b)).or_insert(pair);
        if pair.agreed > before.agreed {
            *before = pair;
        }
    }
    if !pairs.is_empty() {
        text.push('\n');
        let heads = ["pair", "", "proposed", "agreed", "used", "sigma m", "sigma deg"];
        let mut rows = vec![heads.map(String::from).to_vec()];
        rows.extend(pairs.into_values().map(pair_row));
        lay_out(&mut text, &rows);
    }
    let suspects: BTreeSet<String> = robots.values().flat_map(|seen| &seen.suspects).map(suspect).collect();
    for line in suspects {
        let _ = writeln!(text, "{}", style(line).yellow()); // a String takes any text
    }
    text
}

/// A robot that may be wrong, by what another says.
fn suspect(suspect: &SuspectView) -> String {
    let how = if suspect.certain { "is wrong" } else { "may be wrong" };
    format!("{} {how}: {}", suspect.robot, suspect.reason)
}

/// Who makes which map of equal facts, if not all make the same.
fn estimates_differ<'a>(statuses: impl Iterator<Item = &'a StatusView>) -> Option<String> {
    let mut by_estimate: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for status in statuses {
        let estimate = if status.estimate.is_empty() { "an older agent" } else { &status.estimate };
        by_estimate.entry(estimate).or_default().push(&status.robot);
    }
    let groups: Vec<String> =
        by_estimate.iter().map(|(estimate, robots)| format!("{} ({estimate})", robots.join(" "))).collect();
    (groups.len() > 1).then(|| {
        format!(
            "maps differ although facts are equal: {}; give all robots one version and the same [core.estimate]",
            groups.join(", ")
        )
    })
}

fn pair_row(pair: &PairView) -> Vec<String> {
    let status = match pair.status {
        PairStatus::Merged => style("merged").green().to_string(),
        PairStatus::Provisional => "provisional".into(),
        PairStatus::Ambiguous => style("ambiguous").yellow().to_string(),
        PairStatus::Inconsistent => style("inconsistent").red().to_string(),
    };
    let norm = |range: std::ops::Range<usize>| {
        let sigmas = pair.t_a_b.as_ref().and_then(|t| t.sigmas.get(range));
        sigmas.map(|sigmas| sigmas.iter().map(|s| s * s).sum::<f64>().sqrt())
    };
    let show = |value: Option<f64>| value.map_or("-".into(), |value| format!("{value:.3}"));
    vec![
        format!("{} {}", pair.a, pair.b),
        status,
        pair.proposed.to_string(),
        pair.agreed.to_string(),
        pair.used.to_string(),
        show(norm(0..3)),
        show(norm(3..6).map(f64::to_degrees)),
    ]
}

/// Appends rows as columns of equal width; the first row is the head.
fn lay_out(text: &mut String, rows: &[Vec<String>]) {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let width =
        |column: usize| rows.iter().filter_map(|row| row.get(column)).map(|cell| measure_text_width(cell)).max();
    let widths: Vec<usize> = (0..columns).map(|column| width(column).unwrap_or(0)).collect();
    for (number, row) in rows.iter().enumerate() {
        let cells: Vec<_> =
            row.iter().zip(&widths).map(|(cell, w)| pad_str(cell, *w, console::Alignment::Left, None)).collect();
        let line = cells.join("  ");
        let line = line.trim_end();
        let _ = if number == 0 { writeln!(text, "{}", style(line).dim()) } else { writeln!(text, "{line}") }; // a String takes any text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn status(robot: &str, estimate: &str) -> StatusView {
        let view = json!({
            "swarm": "s", "robot": robot, "id": "", "epoch": 0, "neighbours": [], "entries": 0, "digest": "", "submaps": 0,
            "keyframes": 0, "pending": 0, "unsaved": 0, "idle": true, "merged_with": [], "receive_only": false,
            "estimate": estimate,
        });
        serde_json::from_value(view).unwrap()
    }

    #[test]
    fn robots_that_estimate_otherwise_are_named() {
        let told = |robots: &[StatusView]| estimates_differ(robots.iter());
        let (a, b) = (status("alpha", "1-aa"), status("beta", "1-aa"));
        assert_eq!(told(&[]), None);
        assert_eq!(told(&[a.clone(), b.clone()]), None);
        let text = told(&[a.clone(), b, status("gamma", "1-bb")]).unwrap();
        assert!(text.contains("alpha beta (1-aa), gamma (1-bb)") && text.contains("[core.estimate]"), "{text}");
        assert!(told(&[a, status("old", "")]).unwrap().contains("old (an older agent)"));
    }
}
