//! Peers measured in the same run: a Python interpreter runs `sim/bench/peers.py` on the same files and prints rows.

use super::row::{HEADER, Row};
use anyhow::{Context, bail};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

const SCRIPT: &str = include_str!("../../bench/peers.py");

/// Runs `solvers` (all there are, if none is named) on the files, told `sigma`'s upper bound. The rows, and why a
/// solver is missing.
///
/// # Errors
/// An interpreter that does not start, or output that is no rows.
pub fn measure(
    python: &Path,
    solvers: &[String],
    sigma_max: f64,
    files: &[PathBuf],
) -> anyhow::Result<(Vec<Row>, Vec<String>)> {
    let mut child = Command::new(python)
        .args(["-c", SCRIPT, &sigma_max.to_string()])
        .args(solvers)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .with_context(|| format!("{}: no Python interpreter starts there", python.display()))?;
    // Written by a thread of its own: the peers' output must not wait for the last file's name.
    let names: String = files.iter().map(|file| format!("{}\n", file.display())).collect();
    let stdin = child.stdin.take();
    let writer = std::thread::spawn(move || stdin.map(|mut pipe| pipe.write_all(names.as_bytes())));
    let output = child.wait_with_output()?;
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    let _ = writer.join();
    if !output.status.success() {
        bail!("peers: {}: {}", output.status, said.lines().last().unwrap_or("no reason given"));
    }
    Ok((parse(&String::from_utf8_lossy(&output.stdout))?, said.lines().map(str::to_owned).collect()))
}

fn parse(text: &str) -> anyhow::Result<Vec<Row>> {
    let mut lines = text.lines();
    if lines.next() != Some(HEADER) {
        bail!("peers: the first line is not {HEADER}");
    }
    lines.map(|line| Row::parse(line).with_context(|| format!("peers: {line:?} is no row"))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn output_must_be_rows() {
        let row = "kiss,SE3,100,50,3,ok,0.001,0.5,0.01,0.0";
        let rows = parse(&format!("{HEADER}\n{row}\n")).unwrap();
        assert!(rows[0].is_right() && rows[0].solver == "kiss");
        assert!(parse(row).is_err() && parse("").is_err());
        assert!(parse(&format!("{HEADER}\n{row},1\n")).is_err());
        assert!(parse(&format!("{HEADER}\nkiss,SE3,100,50,3,fine,0.001,0.5,0.01,0.0\n")).is_err());
    }

    #[test]
    fn a_missing_interpreter_is_named() {
        let error = measure(Path::new("/no/such/python"), &[], 0.03, &[]).unwrap_err();
        assert!(error.to_string().contains("/no/such/python"), "{error}");
    }
}
