//! What the agent shows: its views as JSON, for whoever asks, and published while somebody subscribes, to the robots'
//! network and where the robot's own SLAM comes in. One snapshot serves all that ask within a short time, so that asking
//! cannot slow the core down. Map and path, which alone may take megabytes, are made only for those who want them. What
//! goes to the robots' network has a budget of bytes, so that looking on cannot eat the radio.

use super::allowance::Allowance;
use super::session::LinkError;
use super::{Shared, refused};
use crate::certificates::expiry::{self, CertificateView};
use crate::config::DebugConfig;
use crate::driver::Snapshots;
use crate::keys;
use merganser_protocol::snapshot::Snapshot;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio::time::{Instant, MissedTickBehavior};
use zenoh::Session;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::Query;

/// The views of megabytes, made only when somebody wants them.
const LARGE: [&str; 2] = ["map", "path"];
/// The views that grow with the map and the way.
const GROWING: [&str; 3] = ["map", "path", "graph"];
/// Questions that may wait.
const WAITING_MAX: usize = 32;
/// A snapshot serves for this long.
const FRESH: Duration = Duration::from_millis(100);
/// An unchanged view is published again after this long, for those who came later.
const REPEAT: Duration = Duration::from_secs(5);

/// The views of one moment, by name.
pub type Views = BTreeMap<&'static str, Vec<u8>>;

/// What the agent adds to the core's views.
#[derive(Clone, Debug, Default)]
pub struct Shell {
    /// Its own counters, shown in `stats`.
    pub counts: BTreeMap<String, u64>,
    /// Where the robot's own SLAM connects, shown in `status`.
    pub input: Vec<String>,
    /// How its certificate stands, if links are by TLS; shown in `status`.
    pub certificate: Option<CertificateView>,
}

/// Views of a snapshot as JSON, a document for each, the large ones only if they are wanted.
pub fn render(snapshot: &Snapshot, wanted: &[&str], shell: &Shell) -> serde_json::Result<Views> {
    let mut stats = serde_json::to_value(&snapshot.stats)?;
    stats["shell"] = serde_json::to_value(&shell.counts)?;
    let mut status = serde_json::to_value(&snapshot.status)?;
    status["input"] = serde_json::to_value(&shell.input)?;
    if let Some(certificate) = &shell.certificate {
        status["certificate"] = serde_json::to_value(certificate)?;
    }
    let mut views = BTreeMap::from([
        ("status", serde_json::to_vec(&status)?),
        ("frames", serde_json::to_vec(&snapshot.frames)?),
        ("poses", serde_json::to_vec(&snapshot.poses)?),
        ("graph", serde_json::to_vec(&snapshot.graph)?),
        ("stats", serde_json::to_vec(&stats)?),
    ]);
    if wanted.contains(&"map") {
        views.insert("map", serde_json::to_vec(&snapshot.map)?);
    }
    if wanted.contains(&"path") {
        views.insert("path", serde_json::to_vec(&snapshot.path)?);
    }
    Ok(views)
}

pub(super) async fn start(
    shared: Arc<Shared>,
    snapshots: Snapshots,
    config: &DebugConfig,
    bytes_max: usize,
) -> Result<JoinHandle<()>, LinkError> {
    let (sender, questions) = mpsc::channel(WAITING_MAX);
    let mut publishers = Vec::new();
    for (session, place) in places(&shared) {
        let key = shared.own("view/*");
        let (s, sender) = (shared.clone(), sender.clone());
        let asked = move |query: Query| {
            if sender.try_send((place, query)).is_err() {
                s.drops().count("refused: too many questions for views at once");
            }
        };
        let queryable = session.declare_queryable(key.clone());
        queryable.callback(asked).background().await.map_err(refused(key))?;
        if config.publish {
            publishers.extend(publish_on(&shared, session, place).await?);
        }
    }
    // A swarm that never leaves its host has no radio to spare.
    let radio = shared.door.session.is_some();
    let allowance = |share: f64| radio.then(|| Allowance::new(config.bytes_per_sec * share));
    let budget = Budget { small: allowance(0.5), large: allowance(0.5) };
    let server = Server { shared, snapshots, publishers, bytes_max, budget, last: None };
    Ok(tokio::spawn(server.run(questions, Duration::from_secs_f64(config.interval_secs))))
}

/// Who looks on from where.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    /// The network of the robots.
    Robots,
    /// Where the robot's own SLAM comes in.
    Door,
}

fn places(shared: &Shared) -> Vec<(&Session, Place)> {
    let door = shared.door.session.iter().map(|session| (session, Place::Door));
    std::iter::once((&shared.session, Place::Robots)).chain(door).collect()
}

async fn publish_on(shared: &Shared, session: &Session, place: Place) -> Result<Vec<Shown>, LinkError> {
    let mut shown = Vec::new();
    for view in keys::VIEWS {
        let key = shared.own(&format!("view/{view}"));
        let publisher = session.declare_publisher(key.clone());
        let publisher = publisher
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::Background)
            .encoding(keys::view_encoding(view));
        let publisher = publisher.await.map_err(refused(key))?;
        shown.push(Shown { view, place, publisher, last: None });
    }
    Ok(shown)
}

/// A view that is published in one place, and what was last.
struct Shown {
    view: &'static str,
    place: Place,
    publisher: Publisher<'static>,
    last: Option<(Instant, Vec<u8>)>,
}

/// Bytes that may go to the network of the robots: a half for the small views, a half for those that grow with the map,
/// so that a map does not keep the others waiting. `None` is without a bound.
struct Budget {
    small: Option<Allowance>,
    large: Option<Allowance>,
}

impl Budget {
    /// Takes the bytes of a view, or says how long there will be nothing for it.
    fn take(&mut self, place: Place, view: &str, bytes: usize) -> Result<(), Duration> {
        let of = if GROWING.contains(&view) { &mut self.large } else { &mut self.small };
        match of {
            Some(allowance) if place == Place::Robots => allowance.take(Instant::now(), bytes),
            _ => Ok(()),
        }
    }
}

struct Server {
    shared: Arc<Shared>,
    snapshots: Snapshots,
    publishers: Vec<Shown>,
    bytes_max: usize,
    budget: Budget,
    last: Option<(Instant, Arc<Views>)>,
}

impl Server {
    async fn run(mut self, mut questions: mpsc::Receiver<(Place, Query)>, interval: Duration) {
        let mut ticks = tokio::time::interval(interval);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let stale = self.last.as_ref().map(|(when, _)| *when + FRESH);
            let served = tokio::select! {
                Some((place, question)) = questions.recv() => self.answer(place, question).await,
                _ = ticks.tick(), if !self.publishers.is_empty() => self.publish().await,
                () = tokio::time::sleep_until(stale.unwrap_or_else(Instant::now)), if stale.is_some() => {
                    self.last = None;
                    Some(())
                }
                else => None,
            };
            if served.is_none() {
                return; // the driver has ended
            }
        }
    }

    async fn answer(&mut self, place: Place, question: Query) -> Option<()> {
        let own = |view: &str| self.shared.own(&format!("view/{view}"));
        let asked = |view: &&str| {
            let key = own(view);
            zenoh::key_expr::KeyExpr::new(key.as_str()).is_ok_and(|key| question.key_expr().intersects(&key))
        };
        let asked: Vec<&str> = keys::VIEWS.into_iter().filter(asked).collect();
        // What there is nothing for is not made either.
        let refused: BTreeMap<&str, Duration> =
            asked.iter().filter_map(|view| Some((*view, self.budget.take(place, view, 0).err()?))).collect();
        let wanted: Vec<&str> = asked.into_iter().filter(|view| !refused.contains_key(view)).collect();
        if let Some((view, wait)) = refused.into_iter().next() {
            self.refuse(&question, view, wait);
        }
        if wanted.is_empty() {
            return Some(());
        }
        let views = self.views(&wanted).await?;
        for view in wanted {
            let (key, json) = (self.shared.own(&format!("view/{view}")), views[view].clone());
            match self.budget.take(place, view, json.len()) {
                Ok(()) => self.shared.reply(question.clone(), key, json, keys::view_encoding(view)),
                Err(wait) => self.refuse(&question, view, wait),
            }
        }
        Some(())
    }

    /// Tells an asker that the budget is spent, and counts it.
    fn refuse(&self, question: &Query, view: &str, wait: Duration) {
        self.shared.drops().count("not shown, beyond debug.bytes_per_sec: a view that was asked for");
        let wait = wait.as_secs_f64();
        let told =
            format!("view/{view}: debug.bytes_per_sec is spent; ask again in {wait:.1} s, or on the robot itself");
        self.shared.reply_error(question.clone(), told);
    }

    async fn publish(&mut self) -> Option<()> {
        let mut wanted = Vec::new();
        for shown in &mut self.publishers {
            match shown.publisher.matching_status().await {
                Ok(status) if !status.matching() => shown.last = None, // the next to come shall see it at once
                Err(_) => shown.last = None,
                Ok(_) => match self.budget.take(shown.place, shown.view, 0) {
                    Ok(()) => wanted.push((shown.place, shown.view)),
                    Err(_) => self.shared.drops().count("not published, beyond debug.bytes_per_sec: a view"),
                },
            }
        }
        if wanted.is_empty() {
            return Some(());
        }
        let views: Vec<&str> = wanted.iter().map(|(_, view)| *view).collect();
        let views = self.views(&views).await?;
        for shown in self.publishers.iter_mut().filter(|shown| wanted.contains(&(shown.place, shown.view))) {
            let json = &views[shown.view];
            if shown.is_old_news(json) {
                continue;
            }
            if json.len() > self.bytes_max {
                let view = shown.view;
                let reason = format!("not published, larger than zenoh.message_bytes_max: view/{view}");
                self.shared.drops().count(reason);
            } else if self.budget.take(shown.place, shown.view, json.len()).is_ok() {
                shown.publish(json).await;
            }
        }
        Some(())
    }

    /// The views of a moment that has just been, with those of the large ones that are wanted.
    async fn views(&mut self, wanted: &[&str]) -> Option<Arc<Views>> {
        let serves = |(when, views): &&(Instant, Arc<Views>)| {
            when.elapsed() < FRESH && wanted.iter().all(|view| views.contains_key(view))
        };
        if let Some((_, views)) = self.last.as_ref().filter(serves) {
            return Some(views.clone());
        }
        let large = wanted.iter().any(|view| LARGE.contains(view));
        let snapshot = if large { self.snapshots.take().await? } else { self.snapshots.overview().await? };
        let shell = Shell {
            counts: self.shared.drops().counts(),
            input: self.shared.door.endpoints.clone(),
            certificate: self.shared.certificate.as_ref().map(|certificate| certificate.view(expiry::now())),
        };
        let rendered = render(&snapshot, wanted, &shell);
        let views = Arc::new(rendered.unwrap_or_else(|reason| {
            tracing::error!(%reason, "a view cannot be written as JSON; this is a bug");
            keys::VIEWS.iter().map(|view| (*view, b"null".to_vec())).collect()
        }));
        self.last = Some((Instant::now(), views.clone()));
        Some(views)
    }
}

impl Shown {
    fn is_old_news(&self, json: &[u8]) -> bool {
        self.last.as_ref().is_some_and(|(when, last)| last == json && when.elapsed() < REPEAT)
    }

    async fn publish(&mut self, json: &[u8]) {
        if let Err(reason) = self.publisher.put(json.to_vec()).await {
            tracing::debug!(%reason, view = self.view, "a view did not leave");
        }
        self.last = Some((Instant::now(), json.to_vec()));
    }
}
