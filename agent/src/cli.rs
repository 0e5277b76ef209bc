//! The command line. Exit codes: 0, all went well; 1, it did not (a check failed, the agent could not go on); 2, the
//! command line, the configuration or a file that was given is wrong.

use crate::certificates::{self, CertificateError};
use crate::commands::{BadInput, align, check, doctor, graph, keys, replay, run, store, watch};
use crate::config::FileConfigError;
use crate::demo::{self, DemoArgs};
use crate::host::HostError;
use crate::trust::TrustError;
use anyhow::Result;
use clap::{Parser, Subcommand};
use merganser_recording::{Problem, RecordingError};
use std::ffi::OsString;
use std::io::{self, ErrorKind};
use std::process::ExitCode;

/// Robot swarms that merge their maps with no server.
///
/// Each robot runs one agent. Agents find one another with Zenoh, exchange signed facts about their maps, align what
/// overlaps, and every robot ends with the same merged map.
#[derive(Debug, Parser)]
#[command(name = "merganser", version, propagate_version = true, max_term_width = 100)]
#[command(
    after_help = "Exit codes: 0 all went well, 1 it did not, 2 the command line, the configuration or a file given is wrong.\n\
                        Start with `merganser demo`."
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Show three robots merging their maps, start to end, on this computer.
    Demo(DemoArgs),
    /// Run this robot's agent.
    Run(run::RunArgs),
    /// Align two clouds or submaps, or tell why they do not align.
    Align(align::AlignArgs),
    /// Look at what a SLAM sends, or at a recording: what is seen, and what to change.
    Doctor(doctor::DoctorArgs),
    /// Watch a swarm: a live table, or every message as a line of JSON.
    Watch(watch::WatchArgs),
    /// Check a configuration and print what it means.
    Check(check::CheckArgs),
    /// Make and show keys and certificates.
    #[command(subcommand)]
    Keys(keys::KeysCommand),
    /// Look into a robot's store of facts: is it sound, what does it hold.
    #[command(subcommand)]
    Store(store::StoreCommand),
    /// Solve pose graphs in files with the estimator that agents use.
    #[command(subcommand)]
    Graph(graph::GraphCommand),
    /// Run an agent's journal through the core again and compare the result.
    Replay(replay::ReplayArgs),
}

/// Runs the program with these arguments (the program's name first).
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        Err(told) => {
            let _ = told.print(); // nowhere left to say that it cannot be said
            return ExitCode::from(u8::try_from(told.exit_code()).unwrap_or(2));
        }
    };
    match dispatch(cli.command) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(error) if is_closed_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            let _ = console::Term::stderr().write_line(&format!("merganser: {}", explain(&error)));
            ExitCode::from(if is_bad_input(&error) { 2 } else { 1 })
        }
    }
}

fn dispatch(command: Command) -> Result<bool> {
    match command {
        Command::Demo(args) => demo::run(args),
        Command::Run(args) => run::run(&args),
        Command::Align(args) => align::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Watch(args) => watch::run(&args),
        Command::Check(args) => check::run(&args),
        Command::Keys(command) => keys::run(command),
        Command::Store(command) => store::run(&command),
        Command::Graph(command) => graph::run(&command),
        Command::Replay(args) => replay::run(&args),
    }
}

/// The error and its causes, on one line; a cause that the line already tells is not told twice.
fn explain(error: &anyhow::Error) -> String {
    error.chain().map(ToString::to_string).fold(String::new(), |line, cause| match line {
        line if line.is_empty() => cause,
        line if line.contains(&cause) => line,
        line => format!("{line}: {cause}"),
    })
}

/// Whether what the user gave is to blame; a disk that is full is not.
fn is_bad_input(error: &anyhow::Error) -> bool {
    let host = error.downcast_ref::<HostError>();
    let is_bad = |cause: &(dyn std::error::Error + 'static)| {
        cause.is::<BadInput>() || cause.downcast_ref::<RecordingError>().is_some_and(is_bad_recording)
    };
    error.downcast_ref::<FileConfigError>().is_some()
        || error.downcast_ref::<CertificateError>().is_some_and(is_bad_certificate)
        || error.downcast_ref::<TrustError>().is_some_and(is_bad_key)
        || matches!(host, Some(HostError::Config(_)))
        || error.chain().any(is_bad)
}

fn is_bad_certificate(error: &CertificateError) -> bool {
    match &error.problem {
        certificates::Problem::Io(error) => is_not_there(error),
        certificates::Problem::Make(_) | certificates::Problem::Exists => false,
        _ => true,
    }
}

fn is_bad_key(error: &TrustError) -> bool {
    match error {
        TrustError::Io { source, .. } => is_not_there(source),
        TrustError::Random(_) => false,
        _ => true,
    }
}

fn is_not_there(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory | ErrorKind::IsADirectory)
}

fn is_bad_recording(error: &RecordingError) -> bool {
    match &error.problem {
        Problem::Io(error) => is_not_there(error),
        _ => true,
    }
}

/// Whoever read our output has enough of it: `merganser watch --json | head`.
fn is_closed_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref::<io::Error>().is_some_and(|error| error.kind() == ErrorKind::BrokenPipe)
}
