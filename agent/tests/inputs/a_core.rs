//! A core alone, whose jobs are run and whose records are durable at once.

use merganser::trust::SecretKey;
use merganser_protocol::agent::io::{Event, Input, Output};
use merganser_protocol::agent::{Agent, Identity};
use merganser_protocol::config::Config;
use merganser_protocol::ids::Name;
use merganser_protocol::snapshot::Snapshot;
use merganser_protocol::time::Instant;
use std::collections::VecDeque;
use std::time::Duration;

/// See the module.
pub struct ACore {
    agent: Agent,
    now: Instant,
    /// Pairs of submaps that were tried.
    pub tried: usize,
    /// Jobs that were run.
    pub jobs: usize,
}

impl ACore {
    pub fn new(config: Config) -> Self {
        let (key, name) = (SecretKey::from_bytes([1; 32]), Name::new("alpha").unwrap());
        let roster = [(name.clone(), key.public().to_bytes())].into();
        let identity = Identity { swarm: Name::new("test").unwrap(), name, secret_key: *key.to_bytes(), roster };
        let agent = Agent::new(config, identity, 1, Default::default(), Instant::ZERO).unwrap();
        Self { agent, now: Instant::ZERO, tried: 0, jobs: 0 }
    }

    /// A second passes, then this comes, and is all worked off.
    pub fn input(&mut self, input: Input) {
        self.input_after(Duration::from_secs(1), input);
    }

    /// The same after another time.
    pub fn input_after(&mut self, passed: Duration, input: Input) {
        self.now = self.now.after(passed);
        let mut inbox = VecDeque::from([Input::Timeout, input]);
        while let Some(input) = inbox.pop_front() {
            self.agent.handle(self.now, input);
            while let Some(output) = self.agent.poll_output() {
                match output {
                    Output::Run { id, job } => {
                        self.jobs += 1;
                        inbox.push_back(Input::JobDone { job: id, result: job.run() });
                    }
                    Output::Event(Event::AlignmentTried { .. } | Event::LookedAgain { .. }) => self.tried += 1,
                    Output::Persist { batch, .. } => inbox.push_back(Input::Persisted { up_to: batch }),
                    _ => {}
                }
            }
        }
    }

    /// How uncertain the body is along the x axis of its frame, m.
    pub fn sigma_x(&self) -> f64 {
        let seen = self.seen();
        seen.poses.robots[0].t_own_body.as_ref().unwrap().sigmas[0]
    }

    /// Motions across lost keyframes.
    pub fn gaps(&self) -> u64 {
        self.seen().status.gaps
    }

    pub fn seen(&self) -> Snapshot {
        self.agent.snapshot(self.now)
    }
}
