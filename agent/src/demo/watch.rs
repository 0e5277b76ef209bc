//! Looks at the swarm from outside, as any Zenoh subscriber could: asks for the robots' views until all are done, until
//! nothing more will come, or until the time is over.

use super::evaluate::missing;
use super::swarm::Swarm;
use super::track::Track;
use super::views::Views;
use crate::config::ZenohConfig;
use crate::keys;
use crate::link::session::{self, Role};
use anyhow::{Context, Result, anyhow, bail};
use indicatif::{ProgressBar, ProgressStyle};
use merganser_protocol::snapshot::StatusView;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::mpsc;
use zenoh::Session;
use zenoh::qos::CongestionControl;

/// Time between two looks.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// How long a robot may take to answer.
const ANSWER_WAIT: Duration = Duration::from_secs(1);
/// How long all views together may take.
const VIEWS_WAIT: Duration = Duration::from_secs(5);
/// Robots that are idle and unchanged for this long, but not merged, will not merge any more.
const SETTLED: Duration = Duration::from_secs(5);
/// Answers that may wait.
const ANSWERS_MAX: usize = 256;

/// How it ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Ending {
    /// All robots are fed, merged and idle, with the same facts.
    Done,
    /// All are idle and nothing changes, but not all merged.
    Settled,
    /// The time is over.
    TimedOut,
}

/// What was seen at the end.
pub(super) struct Seen {
    pub ending: Ending,
    pub after: Duration,
    /// In the order of the tracks.
    pub views: Vec<Views>,
}

/// Looks on until the end; `playing`, which the recordings take, and `timeout` count from now. While a recording plays,
/// its robot may stand for minutes and drive on.
pub(super) async fn watch(swarm: &mut Swarm, tracks: &[Track], playing: Duration, timeout: Duration) -> Result<Seen> {
    let config = ZenohConfig { connect: swarm.endpoints.clone(), multicast: false, ..ZenohConfig::default() };
    let session = session::open(&config, Role::Onlooker).await?;
    let seen = look(&session, swarm, tracks, playing, timeout).await;
    session::close(&session, Duration::from_secs(1)).await;
    seen
}

async fn look(
    session: &Session,
    swarm: &mut Swarm,
    tracks: &[Track],
    playing: Duration,
    timeout: Duration,
) -> Result<Seen> {
    let bar = progress_bar(tracks);
    let start = Instant::now();
    let mut settling = Settling::default();
    let mut done_once = false;
    let (ending, after) = loop {
        swarm.all_run()?;
        let statuses = statuses(session, swarm).await;
        let statuses: Vec<_> = swarm.agents.iter().map(|agent| statuses.get(agent.name.as_str())).collect();
        show(&bar, &statuses);
        let done = missing(tracks, &statuses).is_empty();
        // Answers of one look may be of different moments; twice in a row they are of the same state.
        if done && done_once {
            let after = start.elapsed();
            let views = all_views(session, swarm).await?;
            // A robot may have found something further to do since: then the end is not yet.
            if missing(tracks, &views.iter().map(|views| Some(&views.status)).collect::<Vec<_>>()).is_empty() {
                bar.finish_and_clear();
                return Ok(Seen { ending: Ending::Done, after, views });
            }
        }
        done_once = done && !done_once;
        if settling.look(&statuses) && start.elapsed() > playing {
            break (Ending::Settled, start.elapsed());
        }
        if start.elapsed() > timeout {
            break (Ending::TimedOut, start.elapsed());
        }
        tokio::time::sleep(LOOK_EVERY).await;
    };
    bar.finish_and_clear();
    Ok(Seen { ending, after, views: all_views(session, swarm).await? })
}

/// All views of every robot, from one answer each. A busy robot may need to be asked again.
async fn all_views(session: &Session, swarm: &Swarm) -> Result<Vec<Views>> {
    let start = Instant::now();
    loop {
        let documents = ask(session, swarm, "view/*").await;
        let parse = |agent: &super::swarm::Agent| {
            let own = documents.get(agent.name.as_str()).ok_or("no view came")?;
            Views::parse(own)
        };
        let views: Result<Vec<Views>> = (swarm.agents.iter())
            .map(|agent| parse(agent).map_err(|why| anyhow!("{}: {why}; its log:\n{}", agent.name, agent.log_tail())))
            .collect();
        match views {
            Err(why) if start.elapsed() < VIEWS_WAIT => tracing::debug!(%why, "asking for all views again"),
            views => return views,
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

async fn statuses(session: &Session, swarm: &Swarm) -> BTreeMap<String, StatusView> {
    let documents = ask(session, swarm, "view/status").await;
    let parse = |documents: BTreeMap<String, Vec<u8>>| serde_json::from_slice(documents.get("status")?).ok();
    documents.into_iter().filter_map(|(robot, documents)| Some((robot, parse(documents)?))).collect()
}

/// Views of every robot that answers: JSON by robot and view.
async fn ask(session: &Session, swarm: &Swarm, rest: &str) -> BTreeMap<String, BTreeMap<String, Vec<u8>>> {
    let (sender, mut replies) = mpsc::channel(ANSWERS_MAX);
    let question = session
        .get(keys::of_all(&swarm.name, rest))
        .congestion_control(CongestionControl::Drop)
        .timeout(ANSWER_WAIT)
        .callback(move |reply| {
            let _ = sender.try_send(reply); // there are far fewer
        });
    let mut documents: BTreeMap<String, BTreeMap<String, Vec<u8>>> = BTreeMap::new();
    if let Err(reason) = question.await {
        tracing::debug!(%reason, "nobody was asked");
        return documents;
    }
    while let Some(reply) = replies.recv().await {
        let Ok(sample) = reply.result() else { continue };
        if let Some((robot, rest)) = keys::split(sample.key_expr().as_str())
            && let Some(view) = rest.strip_prefix("view/")
        {
            documents.entry(robot.to_string()).or_default().insert(view.into(), sample.payload().to_bytes().into());
        }
    }
    documents
}

/// Whether everything has stood still for [`SETTLED`].
#[derive(Default)]
struct Settling {
    last: Vec<StatusView>,
    since: Option<Instant>,
}

impl Settling {
    fn look(&mut self, statuses: &[Option<&StatusView>]) -> bool {
        let now: Vec<StatusView> = statuses.iter().flatten().map(|status| (*status).clone()).collect();
        let still = now.len() == statuses.len() && now == self.last && now.iter().all(|s| s.idle && s.submaps > 0);
        self.last = now;
        if !still {
            self.since = None;
            return false;
        }
        self.since.get_or_insert_with(Instant::now).elapsed() > SETTLED
    }
}

/// Counts keyframes; hidden where nobody sees it.
fn progress_bar(tracks: &[Track]) -> ProgressBar {
    let total: usize = tracks.iter().map(|track| track.odometry.len()).sum();
    let bar = ProgressBar::new(total as u64);
    if let Ok(style) = ProgressStyle::with_template("{elapsed:>4} {bar:30.cyan/blue} {pos}/{len} keyframes  {msg}") {
        bar.set_style(style);
    }
    bar.enable_steady_tick(Duration::from_millis(100));
    bar
}

fn show(bar: &ProgressBar, statuses: &[Option<&StatusView>]) {
    let known = || statuses.iter().flatten();
    bar.set_position(known().map(|status| status.keyframes).sum());
    let merged: usize = known().map(|status| status.merged_with.len()).sum::<usize>() / 2;
    let pairs = statuses.len() * statuses.len().saturating_sub(1) / 2;
    let submaps: u64 = known().map(|status| status.submaps).sum();
    let pending: u64 = known().map(|status| status.pending).sum();
    bar.set_message(format!("{submaps} submaps, {pending} pending, {merged}/{pairs} pairs merged"));
}

/// What tells the demonstration to end early.
pub(super) struct Interrupts {
    interrupt: Signal,
    terminate: Signal,
}

impl Interrupts {
    /// From now on, SIGINT and SIGTERM no longer end the process by themselves.
    pub fn catch() -> Result<Self> {
        let listen = |kind| signal(kind).context("cannot listen for signals");
        Ok(Self { interrupt: listen(SignalKind::interrupt())?, terminate: listen(SignalKind::terminate())? })
    }

    /// Fails at the first signal.
    pub async fn wait(&mut self) -> Result<Seen> {
        tokio::select! {
            _ = self.interrupt.recv() => {}
            _ = self.terminate.recv() => {}
        }
        bail!("interrupted")
    }
}
