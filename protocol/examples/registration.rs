//! Runs the estimator over a folder of `.corr` problems and prints success, errors and time per cell.
//!
//! `cargo run --release -p merganser-protocol --example registration -- DIR [SIGMA_MAX [FILTER]]`
//!
//! A `.corr` file is little-endian: `CORRv001`, u32 N, u32 outliers, f64 sigma, scale, R[9] row-major, t[3], then f32
//! source[3N], f32 target[3N], u8 inlier[N]. Success is rotation < 5°, translation < 0.1, scale < 10 %; a refusal is a
//! miss, a wrong answer is counted apart. `provisional` of the `ok` are above the accepting NFA of 1e-4.
#![allow(clippy::print_stdout, clippy::unwrap_used, clippy::expect_used)]

use merganser_protocol::align::{Model, Problem, Refusal, SolverConfig, Standing, Weighting, align};
use merganser_protocol::geometry::{Relative, Se3, Sim3, So3};
use nalgebra::{Matrix3, Vector3};
use std::collections::BTreeMap;
use std::path::Path;

struct Case {
    source: Vec<[f64; 3]>,
    target: Vec<[f64; 3]>,
    truth: Sim3,
    oracle: Option<f64>,
}

#[derive(Default)]
struct Cell {
    rotation: Vec<f64>,
    over_oracle: Vec<f64>,
    translation: Vec<f64>,
    sigma: Vec<f64>,
    millis: Vec<f64>,
    distance: Vec<f64>,
    nfa: Vec<f64>,
    provisional: usize,
    wrong_accepted: usize,
    wrong: usize,
    ambiguous: usize,
    refused: usize,
    covered: usize,
    kde: usize,
}

fn read(path: &Path) -> Case {
    let bytes = std::fs::read(path).unwrap();
    assert_eq!(&bytes[..8], b"CORRv001", "{path:?}");
    let n = u32::from_le_bytes(bytes[8..12].try_into().unwrap()) as usize;
    let double = |at: usize| f64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
    let rotation = Matrix3::from_fn(|r, c| double(32 + 8 * (3 * r + c)));
    let translation = Vector3::from_fn(|r, _| double(104 + 8 * r));
    let float = |at: usize| f64::from(f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()));
    let points = |at: usize| (0..n).map(|i| core::array::from_fn(|k| float(at + 4 * (3 * i + k)))).collect::<Vec<_>>();
    let (source, target) = (points(128), points(128 + 12 * n));
    let inlier: Vec<bool> = bytes[128 + 24 * n..].iter().map(|&b| b == 1).collect();
    let truth = Sim3::new(So3::from_matrix(&rotation), translation, double(24));
    let oracle = oracle(&source, &target, &inlier).map(|r| degrees(&r, &truth.rotation));
    Case { source, target, truth, oracle }
}

/// Least-squares rotation of the true inliers.
fn oracle(source: &[[f64; 3]], target: &[[f64; 3]], inlier: &[bool]) -> Option<So3> {
    let inliers: Vec<(Vector3<f64>, Vector3<f64>)> = (0..source.len())
        .filter(|&i| inlier[i])
        .map(|i| (Vector3::from(source[i]), Vector3::from(target[i])))
        .collect();
    let n = inliers.len() as f64;
    let (p, q) = inliers.iter().fold((Vector3::zeros(), Vector3::zeros()), |(a, b), (p, q)| (a + p / n, b + q / n));
    let h: Matrix3<f64> = inliers.iter().map(|(a, b)| (b - q) * (a - p).transpose()).sum();
    let svd = h.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    let d = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v).determinant().signum()));
    (inliers.len() > 2).then(|| So3::from_matrix(&(u * d * v)))
}

fn degrees(a: &So3, b: &So3) -> f64 {
    (a.inverse() * *b).angle().to_degrees()
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Squared Mahalanobis distance of the truth, over the 95 % quantile.
fn distance(relative: &Relative, truth: &Sim3) -> f64 {
    match relative {
        Relative::Metric(p) => {
            let delta = p.pose.local(&Se3::new(truth.rotation, truth.translation));
            p.covariance.mahalanobis_squared(&delta) / 12.5916
        }
        Relative::Similarity(s) => {
            let error = s.sim.inverse() * *truth;
            let (t, r) = (error.translation, error.rotation.log());
            let delta = nalgebra::SVector::<f64, 7>::from([t.x, t.y, t.z, r.x, r.y, r.z, error.scale.ln()]);
            s.covariance.mahalanobis_squared(&delta) / 14.0671
        }
    }
}

/// Processor time of this thread (Linux; elsewhere 0).
fn cpu_seconds() -> f64 {
    // The kernel brings the figure up to date when the thread yields.
    std::thread::yield_now();
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    text.split(' ').next().and_then(|ns| ns.parse::<f64>().ok()).unwrap_or(0.0) * 1e-9
}

fn run(case: &Case, config: &SolverConfig, cell: &mut Cell) {
    let problem = Problem { source: &case.source, target: &case.target, ..Problem::default() };
    let start = cpu_seconds();
    let result = align(&problem, config).unwrap();
    cell.millis.push((cpu_seconds() - start) * 1e3);
    match result {
        Ok(found) => {
            let sim = found.t_target_source.sim();
            let rotation = degrees(&sim.rotation, &case.truth.rotation);
            let translation = (sim.translation - case.truth.translation).norm();
            let scale = (sim.scale / case.truth.scale - 1.0).abs();
            if rotation > 5.0 || translation > 0.1 || scale > 0.1 {
                cell.wrong += 1;
                if found.standing == Standing::Accepted {
                    println!(
                        "wrong accepted: {rotation:.2} deg, {translation:.3}, scale {scale:.3} of {:.3}, log10 NFA {:.1}, support {:.1}, sigma {:.4}",
                        case.truth.scale, found.log10_nfa, found.support, found.sigma
                    );
                }
                cell.wrong_accepted += usize::from(found.standing == Standing::Accepted);
                return;
            }
            cell.provisional += usize::from(found.standing == Standing::Provisional);
            cell.rotation.push(rotation);
            cell.over_oracle.extend(case.oracle.map(|o| rotation / o));
            cell.translation.push(translation);
            cell.sigma.push(found.sigma);
            cell.nfa.push(found.log10_nfa);
            let d = distance(&found.t_target_source, &case.truth);
            cell.distance.push(d);
            cell.covered += usize::from(d < 1.0);
            cell.kde += usize::from(found.weighting == Weighting::Kde);
        }
        Err(Refusal::Ambiguous { .. }) => cell.ambiguous += 1,
        Err(_) => cell.refused += 1,
    }
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    let directory = args.get(1).expect("usage: registration DIR [SIGMA_MAX [FILTER]]");
    let sigma_max: f64 = args.get(2).map_or(0.03, |s| s.parse().unwrap());
    let filter = args.get(3).cloned().unwrap_or_default();
    let mut cells: BTreeMap<String, Cell> = BTreeMap::new();
    for group in std::fs::read_dir(directory).unwrap().map(|e| e.unwrap().path()).filter(|p| p.is_dir()) {
        let mut files: Vec<_> = std::fs::read_dir(&group).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        for file in files.iter().filter(|f| f.extension().is_some_and(|e| e == "corr")) {
            let name = file.file_stem().unwrap().to_string_lossy().to_string();
            if !name.contains(&filter) {
                continue;
            }
            let model = match name.starts_with("SIM3") {
                true => Model::Similarity { scale_min: 0.4, scale_max: 2.5 },
                false => Model::Rigid,
            };
            let config = SolverConfig {
                model,
                sigma_max,
                support_min: 4.0,
                log10_nfa_provisional: Some(-1.0),
                ..SolverConfig::default()
            };
            let cell = cells.entry(name[..name.len() - 4].to_string()).or_default();
            run(&read(file), &config, cell);
        }
    }
    println!(
        "cell              ok provisional wrong wrong_acc ambig none  rot_deg x_oracle trans   sigma  cover kde   nfa   ms_med   ms_max"
    );
    for (name, mut c) in cells {
        let ok = c.rotation.len();
        let max = c.millis.iter().copied().fold(0.0, f64::max);
        println!(
            "{name:17} {ok:2} {:11} {:5} {:9} {:5} {:4} {:8.3} {:8.3} {:.4} {:.5} {:2}/{ok:2} {:3} {:6.1} {:8.2} {max:8.2}",
            c.provisional,
            c.wrong,
            c.wrong_accepted,
            c.ambiguous,
            c.refused,
            median(&mut c.rotation),
            median(&mut c.over_oracle),
            median(&mut c.translation),
            median(&mut c.sigma),
            c.covered,
            c.kde,
            median(&mut c.nfa),
            median(&mut c.millis),
        );
    }
}
