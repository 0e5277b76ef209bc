//! `merganser graph solve` on a long planar drive whose odometry drifts far before the few loops close it, as the public
//! graph ais2klinik is (15,115 poses, 16,727 measurements): a start from odometry is in no minimum's basin.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::f64::consts::PI;
use std::fmt::Write as _;
use std::process::Command;

const POSES: usize = 15_115;
const LOOPS: usize = 1_613;
/// Corridors between two crossings, in poses half a metre apart; crossings to each side.
const CORRIDOR: usize = 80;
const CROSSINGS: i32 = 9;

/// x, y and heading.
type Pose = [f64; 3];

fn relative(a: &Pose, b: &Pose) -> Pose {
    let (sin, cos) = a[2].sin_cos();
    let (x, y, turn) = (b[0] - a[0], b[1] - a[1], b[2] - a[2]);
    [cos * x + sin * y, -sin * x + cos * y, turn.sin().atan2(turn.cos())]
}

/// A drive along the corridors of a grid, at each crossing anywhere but back.
fn drive(rng: &mut ChaCha8Rng) -> Vec<Pose> {
    let (mut at, mut way, mut poses) = ([0_i32, 0], 0, Vec::new());
    let next = |at: [i32; 2], way: usize| [at[0] + [1, 0, -1, 0][way], at[1] + [0, 1, 0, -1][way]];
    while poses.len() < POSES {
        let open: Vec<usize> = (0..4)
            .filter(|&to| to != (way + 2) % 4 && next(at, to).iter().all(|c| (0..=CROSSINGS).contains(c)))
            .collect();
        way = open[rng.random_range(0..open.len())];
        let to = next(at, way);
        let heading = way as f64 * PI / 2.0;
        let length = 0.5 * CORRIDOR as f64;
        for step in 0..CORRIDOR {
            let share = step as f64 / CORRIDOR as f64;
            let along = |k: usize| length * (f64::from(at[k]) + share * f64::from(to[k] - at[k]));
            poses.push([along(0), along(1), heading]);
        }
        at = to;
    }
    poses.truncate(POSES);
    poses
}

/// Odometry whose heading errs by `sigma` rad each half metre, and loops of the last two fifths of the drive.
fn graph(seed: u64, sigma: f64) -> String {
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let truth = drive(rng);
    let mut text = String::new();
    let mut measure = |rng: &mut ChaCha8Rng, i: usize, j: usize, sigmas: [f64; 3]| {
        let mut normal = || (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0;
        let exact = relative(&truth[i], &truth[j]);
        let [x, y, turn] = [0, 1, 2].map(|k| exact[k] + sigmas[k] * normal());
        let [p, q] = [sigmas[0], sigmas[2]].map(|sigma| 1.0 / (sigma * sigma));
        let _ = writeln!(text, "EDGE_SE2 {i} {j} {x} {y} {turn} {p} 0 0 {p} 0 {q}");
    };
    (1..POSES).for_each(|j| measure(rng, j - 1, j, [0.03, 0.03, sigma]));
    let is_near = |i: usize, j: usize| (truth[i][0] - truth[j][0]).abs() + (truth[i][1] - truth[j][1]).abs() < 0.1;
    let late = 3 * POSES / 5;
    for k in 0..LOOPS {
        let j = late + k * (POSES - late) / LOOPS;
        // The first time that it was here, if that was long ago.
        let i = (0..j - 1500).find(|&i| is_near(i, j)).unwrap_or(j - 2);
        measure(rng, i, j, [0.05, 0.05, 0.02]);
    }
    text
}

/// Exit code and what was said.
fn solve(text: &str, arguments: &[&str]) -> (i32, String) {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("hard.g2o"), text).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_merganser"));
    let out = command.args(["graph", "solve", "hard.g2o"]).args(arguments).current_dir(dir.path()).output().unwrap();
    let said = String::from_utf8(out.stdout).unwrap() + &String::from_utf8(out.stderr).unwrap();
    (out.status.code().unwrap(), said)
}

#[test]
fn a_drive_that_drifts_by_a_radian_before_it_closes_converges_and_is_certified() {
    let text = graph(1, 0.008); // times the root of fifteen thousand
    for arguments in [[].as_slice(), &["--certify"]] {
        let (code, said) = solve(&text, arguments);
        assert_eq!(code, 0, "{said}");
        assert!(said.contains("15115 poses, 16727 measurements, converged"), "{said}");
        assert_eq!(said.contains("certified for the isotropic weights"), !arguments.is_empty(), "{said}");
        // Three of each measurement beyond the tree's; what errs as stated has a χ² of as many, within four σ.
        let dof = 3.0 * LOOPS as f64;
        let chi2 = said.split("χ² ").nth(1).and_then(|rest| rest.split(' ').next());
        let chi2 = chi2.map(|text| text.parse::<f64>().unwrap());
        assert!(said.contains(&format!("of {dof} dof")), "{said}");
        assert!(chi2.is_some_and(|chi2| (chi2 - dof).abs() < 4.0 * (2.0 * dof).sqrt()), "{said}");
    }
}

/// With almost four radians of drift some are not solved (benchmarks, section 15).
#[test]
#[ignore = "night: thrice ten seconds"]
fn what_is_not_at_a_minimum_or_not_certified_is_never_said_to_be() {
    for seed in 1..4 {
        let (code, said) = solve(&graph(seed, 0.03), &["--certify"]);
        let is_solved = said.contains(", converged") && said.contains("; certified for");
        let is_told = said.contains("NOT CONVERGED") && said.contains("give it more (--iterations)");
        assert!(if code == 0 { is_solved } else { code == 1 && (is_told || said.contains("NOT CERTIFIED")) }, "{said}");
    }
}
