//! `merganser replay`: the core again, on a journal. The same inputs give the same facts and the same digest; if they
//! do not, something is not deterministic, and that is a bug worth a report with the journal.

use super::say;
use crate::config::FileConfig;
use crate::driver::Finished;
use crate::journal::{Frame, Reader, Replayed, Start};
use anyhow::{Context, Result, bail, ensure};
use merganser_protocol::agent::io::{Input, JobId, Output};
use merganser_protocol::agent::job::Job;
use merganser_protocol::agent::{Agent, Identity, Restored};
use merganser_protocol::ids::Hash;
use merganser_protocol::time::Instant;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What `merganser replay` can be told.
#[derive(Clone, Debug, clap::Args)]
pub struct ReplayArgs {
    /// The journal that `merganser run --journal FILE` wrote.
    pub journal: PathBuf,
    /// The configuration of that run, for its key. The core's knobs are taken from the journal.
    #[arg(long, short, value_name = "FILE")]
    pub config: PathBuf,
    /// Print what the core believes at the end, as JSON.
    #[arg(long)]
    pub snapshot: bool,
}

/// What a replay came to.
pub struct Outcome {
    /// Digest and number of inputs.
    pub finished: Finished,
    /// The digest that the live run came to, if it ended in order.
    pub recorded: Option<Hash>,
    /// The core.
    pub agent: Agent,
    /// The moment of the last frame.
    pub now: Instant,
}

/// Replays a journal and prints the digest; false if the live run came to another one.
///
/// # Errors
/// If the journal or configuration cannot be used.
pub fn run(args: &ReplayArgs) -> Result<bool> {
    let config = FileConfig::load(&args.config)?;
    let outcome = replay(&args.journal, &config.identity()?)?;
    let Finished { digest, inputs } = outcome.finished;
    if args.snapshot {
        say(&serde_json::to_string_pretty(&outcome.agent.snapshot(outcome.now))?)?;
    }
    say(&format!("digest {digest}"))?;
    let verdict = match outcome.recorded {
        Some(recorded) if recorded == digest => format!("{inputs} inputs; the live run came to the same digest"),
        Some(recorded) => format!("{inputs} inputs; THE LIVE RUN CAME TO {recorded}"),
        None => format!("{inputs} inputs; the live run did not end in order, so there is nothing to compare with"),
    };
    say(&verdict)?;
    Ok(outcome.recorded.is_none_or(|recorded| recorded == digest))
}

/// Runs the core on a journal.
///
/// # Errors
/// If the journal is damaged or of another robot, or the core does not start.
pub fn replay(journal: &Path, identity: &Identity) -> Result<Outcome> {
    let (start, mut frames) = Reader::open(journal).with_context(|| journal.display().to_string())?;
    let mut now = start.now;
    let mut core = begin(start, identity)?;
    let (mut inputs, mut recorded) = (0, None);
    while let Some(frame) = frames.next_frame().with_context(|| journal.display().to_string())? {
        match frame {
            Frame::Start(_) => bail!("{}: a second start inside", journal.display()),
            Frame::Input(at, input) => {
                now = at;
                inputs += 1;
                match input.replayed()? {
                    Replayed::Input(input) => core.handle(now, *input),
                    Replayed::JobDone(job) => core.finish(now, job)?,
                }
            }
            Frame::End(at, digest) => {
                now = at;
                recorded = Some(digest);
            }
        }
    }
    let finished = Finished { digest: core.agent.digest(), inputs };
    Ok(Outcome { finished, recorded, agent: core.agent, now })
}

fn begin(start: Start, identity: &Identity) -> Result<Rerun> {
    let same = start.swarm == identity.swarm && start.robot == identity.name;
    ensure!(same, "the journal is of {}/{}, the key of {}/{}", start.swarm, start.robot, identity.swarm, identity.name);
    let identity = Identity { roster: start.roster, ..identity.clone() };
    let records = start.restored.into_iter().map(Into::into).collect();
    let restored = Restored { records, fresh_epoch: start.fresh_epoch };
    let agent = Agent::new(start.config, identity, start.seed, restored, start.now)?;
    let mut core = Rerun { agent, jobs: BTreeMap::new() };
    core.drain();
    Ok(core)
}

/// The core, and the jobs it waits for.
struct Rerun {
    agent: Agent,
    jobs: BTreeMap<JobId, Job>,
}

impl Rerun {
    fn handle(&mut self, now: Instant, input: Input) {
        self.agent.handle(now, input);
        self.drain();
    }

    fn finish(&mut self, now: Instant, id: JobId) -> Result<()> {
        let job = self.jobs.remove(&id);
        let job = job.with_context(|| format!("job {} ended, but this core never wanted it: the runs differ", id.0))?;
        self.handle(now, Input::JobDone { job: id, result: job.run() });
        Ok(())
    }

    fn drain(&mut self) {
        while let Some(output) = self.agent.poll_output() {
            if let Output::Run { id, job } = output {
                self.jobs.insert(id, job);
            }
        }
    }
}
