//! What the agent shows: its views as JSON, for whoever asks, and published while somebody subscribes. One snapshot
//! serves all that ask within a short time, so that asking cannot slow the core down. Map and path, which
//! alone may take megabytes, are made only for those who want them.

use super::session::LinkError;
use super::{Shared, refused};
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
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::Query;

/// The views that grow with the map and the way.
const LARGE: [&str; 2] = ["map", "path"];
/// Questions that may wait.
const WAITING_MAX: usize = 32;
/// A snapshot serves for this long.
const FRESH: Duration = Duration::from_millis(100);
/// An unchanged view is published again after this long, for those who came later.
const REPEAT: Duration = Duration::from_secs(5);

/// The views of one moment, by name.
pub type Views = BTreeMap<&'static str, Vec<u8>>;

/// Views of a snapshot as JSON, a document for each, the large ones only if they are wanted. `shell` are the agent's own
/// counters, shown in `stats`.
pub fn render(snapshot: &Snapshot, wanted: &[&str], shell: &BTreeMap<String, u64>) -> serde_json::Result<Views> {
    let mut stats = serde_json::to_value(&snapshot.stats)?;
    stats["shell"] = serde_json::to_value(shell)?;
    let mut views = BTreeMap::from([
        ("status", serde_json::to_vec(&snapshot.status)?),
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
    let key = shared.own("view/*");
    let s = shared.clone();
    let asked = move |query: Query| {
        if sender.try_send(query).is_err() {
            s.drops().count("refused: too many questions for views at once");
        }
    };
    let queryable = shared.session.declare_queryable(key.clone());
    queryable.callback(asked).background().await.map_err(refused(key))?;
    let publishers = if config.publish { publishers(&shared).await? } else { BTreeMap::new() };
    let server = Server { shared, snapshots, publishers, bytes_max, last: None, published: BTreeMap::new() };
    Ok(tokio::spawn(server.run(questions, Duration::from_secs_f64(config.interval_secs))))
}

async fn publishers(shared: &Shared) -> Result<BTreeMap<&'static str, Publisher<'static>>, LinkError> {
    let mut publishers = BTreeMap::new();
    for view in keys::VIEWS {
        let key = shared.own(&format!("view/{view}"));
        let publisher = shared.session.declare_publisher(key.clone());
        let publisher = publisher
            .congestion_control(CongestionControl::Drop)
            .priority(Priority::Background)
            .encoding(keys::view_encoding(view));
        publishers.insert(view, publisher.await.map_err(refused(key))?);
    }
    Ok(publishers)
}

struct Server {
    shared: Arc<Shared>,
    snapshots: Snapshots,
    publishers: BTreeMap<&'static str, Publisher<'static>>,
    bytes_max: usize,
    last: Option<(Instant, Arc<Views>)>,
    published: BTreeMap<&'static str, (Instant, Vec<u8>)>,
}

impl Server {
    async fn run(mut self, mut questions: mpsc::Receiver<Query>, interval: Duration) {
        let mut ticks = tokio::time::interval(interval);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            let stale = self.last.as_ref().map(|(when, _)| *when + FRESH);
            let served = tokio::select! {
                Some(question) = questions.recv() => self.answer(question).await,
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

    async fn answer(&mut self, question: Query) -> Option<()> {
        let own = |view: &str| self.shared.own(&format!("view/{view}"));
        let asked = |view: &&str| {
            let key = own(view);
            zenoh::key_expr::KeyExpr::new(key.as_str()).is_ok_and(|key| question.key_expr().intersects(&key))
        };
        let wanted: Vec<&str> = keys::VIEWS.into_iter().filter(asked).collect();
        let views = self.views(&wanted).await?;
        for view in wanted {
            let (key, json) = (self.shared.own(&format!("view/{view}")), views[view].clone());
            self.shared.reply(question.clone(), key, json, keys::view_encoding(view));
        }
        Some(())
    }

    async fn publish(&mut self) -> Option<()> {
        let mut wanted = Vec::new();
        for (view, publisher) in &self.publishers {
            match publisher.matching_status().await {
                Ok(status) if status.matching() => wanted.push(*view),
                _ => drop(self.published.remove(view)), // the next to come shall see it at once
            }
        }
        if wanted.is_empty() {
            return Some(());
        }
        let views = self.views(&wanted).await?;
        for view in wanted {
            self.publish_one(view, &views[view]).await;
        }
        Some(())
    }

    async fn publish_one(&mut self, view: &'static str, json: &[u8]) {
        let now = Instant::now();
        if self.published.get(view).is_some_and(|(when, last)| last == json && now - *when < REPEAT) {
            return;
        }
        if json.len() > self.bytes_max {
            return self
                .shared
                .drops()
                .count(format!("not published, larger than zenoh.message_bytes_max: view/{view}"));
        }
        let Some(publisher) = self.publishers.get(view) else { return };
        if let Err(reason) = publisher.put(json.to_vec()).await {
            tracing::debug!(%reason, view, "a view did not leave");
        }
        self.published.insert(view, (now, json.to_vec()));
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
        let rendered = render(&snapshot, wanted, &self.shared.drops().counts());
        let views = Arc::new(rendered.unwrap_or_else(|reason| {
            tracing::error!(%reason, "a view cannot be written as JSON; this is a bug");
            keys::VIEWS.iter().map(|view| (*view, b"null".to_vec())).collect()
        }));
        self.last = Some((Instant::now(), views.clone()));
        Some(views)
    }
}
