//! Drives one robot's core for a few keyframes: the loop that every shell is, without network or disk.
//!
//! `cargo run --release -p merganser-protocol --example drive_a_core`
#![allow(clippy::print_stdout, reason = "an example shows what it does")]

use merganser_protocol::agent::io::{Input, Output};
use merganser_protocol::agent::{Agent, Identity, Restored};
use merganser_protocol::config::Config;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use merganser_protocol::time::{Instant, Stamp};
use nalgebra::Vector3;
use std::time::Duration;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let secret_key = [7; 32];
    let public = ed25519_dalek::SigningKey::from_bytes(&secret_key).verifying_key().to_bytes();
    let (swarm, name) = (Name::new("example")?, Name::new("alpha")?);
    let identity = Identity { swarm, roster: [(name.clone(), public)].into(), name, secret_key };
    let mut now = Instant::ZERO;
    let mut config = Config::default();
    config.submap.voxel_m = 0.2;
    let mut agent = Agent::new(config, identity, 1, Restored::default(), now)?;
    for step in 0..60 {
        now = now.after(Duration::from_secs(1));
        agent.handle(now, Input::Keyframe(keyframe(step)?));
        // What the agent wants is carried out until it wants nothing; here every record is durable at once.
        while let Some(output) = agent.poll_output() {
            match output {
                Output::Persist { batch, .. } => agent.handle(now, Input::Persisted { up_to: batch }),
                Output::Run { id, job } => agent.handle(now, Input::JobDone { job: id, result: job.run() }),
                Output::Ask { query, .. } => agent.handle(now, Input::Answered { query, bytes: None }),
                Output::Event(event) => println!("{:>2} s  {event:?}", now.as_secs_f64()),
                Output::Publish { .. } | Output::Answer { .. } => {} // to the network, where there is one
            }
        }
        if agent.poll_timeout().is_some_and(|at| at <= now) {
            agent.handle(now, Input::Timeout);
        }
    }
    let view = agent.snapshot(now);
    println!("{}: {} submaps, {} entries", view.status.robot, view.status.submaps, view.status.entries);
    Ok(())
}

/// A robot that drives along a wall of pillars, half a metre a second.
fn keyframe(step: i64) -> Result<Keyframe, merganser_protocol::geometry::CovarianceError> {
    let x = 0.5 * step as f64;
    let surface = |k: usize| {
        let (pillar, side) = ((k / 40) as f64, (k % 40) as f64 * 0.16);
        [(1.7 * pillar - x + 0.4 * side.cos()) as f32, (2.0 + 0.4 * side.sin()) as f32, (k % 7) as f32 * 0.3]
    };
    Ok(Keyframe {
        stamp: Stamp(step * 1_000_000_000),
        pose: PoseWithCovariance {
            pose: Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0)),
            covariance: Covariance::from_sigmas([0.01, 0.01, 0.01, 0.002, 0.002, 0.002])?,
        },
        covariance_of: CovarianceOf::Motion,
        session: None,
        points: (0..1200).map(surface).collect(),
        marks: Vec::new(),
        place: None,
        up: None,
    })
}
