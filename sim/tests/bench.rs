//! `bench registration` on generated files: rows, tables, one clear error for each kind of bad file, exit codes.

#![allow(clippy::unwrap_used, clippy::panic, reason = "the whole file is a test")]

use merganser_protocol::align::POINTS_LIMIT;
use merganser_sim::bench::corr::{self, CorrError};
use merganser_sim::bench::peers::Peers;
use merganser_sim::bench::registration::files;
use merganser_sim::bench::row::{HEADER, Problem, Row, Status};
use merganser_sim::bench::table::Cell;
use merganser_sim::dice::Dice;
use std::path::Path;
use std::process::{Command, Output};

/// A file's bytes: a quarter turn about z and a shift, the first `inliers` matches true.
fn bytes(n: usize, inliers: usize, scale: f64) -> Vec<u8> {
    let mut dice = Dice::new(n as u64, "a correspondence file");
    let source: Vec<[f64; 3]> = (0..n).map(|_| core::array::from_fn(|_| dice.uniform())).collect();
    let mut place = |k: usize| {
        let [x, y, z] = if k < inliers { source[k] } else { core::array::from_fn(|_| dice.uniform()) };
        [0.5 - scale * y, 0.25 + scale * x, scale * z - 0.5].map(|c| c + 0.01 * dice.normal())
    };
    let target: Vec<[f64; 3]> = (0..n).map(&mut place).collect();
    let mut file = b"CORRv001".to_vec();
    file.extend((n as u32).to_le_bytes());
    file.extend(((n - inliers) as u32).to_le_bytes());
    let truth = [0.01, scale, 0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.5, 0.25, -0.5];
    file.extend(truth.into_iter().flat_map(f64::to_le_bytes));
    file.extend(source.iter().chain(&target).flatten().flat_map(|&c| (c as f32).to_le_bytes()));
    file.extend((0..n).map(|k| u8::from(k < inliers)));
    file
}

fn write(folder: &Path, name: &str, bytes: &[u8]) {
    let group = folder.join("inputs").join(name.split('_').next().unwrap());
    std::fs::create_dir_all(&group).unwrap();
    std::fs::write(group.join(name), bytes).unwrap();
}

fn bench(folder: &Path, options: &[&str]) -> Output {
    let program = env!("CARGO_BIN_EXE_merganser-sim");
    let fixed = ["bench", "registration", "--inputs"];
    Command::new(program).args(fixed).arg(folder.join("inputs")).args(options).output().unwrap()
}

#[test]
fn a_row_per_problem_and_a_table_per_solver() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path();
    write(root, "SE3_N00060_o50_s00.corr", &bytes(60, 30, 1.0));
    write(root, "SIM3_N00060_o50_s03.corr", &bytes(60, 30, 1.5));
    write(root, "SE3_N00060_o99_s00.corr", &bytes(60, 0, 1.0));
    std::fs::write(
        root.join("peers.csv"),
        "group,solver,N,outlier_pct,seeds,success_pct,rot_med_deg,trans_med,scale_med_rel,cpu_med_ms,cpu_max_ms,timeouts\n\
         SE3,quick,60,50,20,100,0.3,0.004,0.0,0.01,0.1,0\nSE3,teaser_exact,60,50,20,95,0.3,0.004,0.0,7.5,9.0,0\n",
    )
    .unwrap();
    let csv = root.join("rows.csv");
    let out = bench(root, &["--csv", csv.to_str().unwrap(), "--weighting", "auto,kde,em"]);
    assert_eq!(out.status.code(), Some(0), "{}", String::from_utf8_lossy(&out.stderr));
    assert!(out.stderr.is_empty(), "a progress bar needs a terminal");
    let text = String::from_utf8(out.stdout).unwrap();
    for part in ["merganser_em ", "merganser_kde ", "1/1 (0)", "quick 100 % 0.01 ms", "teaser_exact 95 % 7.50 ms"] {
        assert!(text.contains(part), "{part} is not in\n{text}");
    }
    let rows = std::fs::read_to_string(csv).unwrap();
    let mut lines = rows.lines();
    assert_eq!(lines.next(), Some(HEADER));
    let rows: Vec<Row> = lines.map(|line| Row::parse(line).unwrap_or_else(|| panic!("{line}"))).collect();
    assert_eq!(rows.len(), 9);
    for row in &rows {
        assert_eq!(row.status, if row.problem.ratio == 99 { Status::None } else { Status::Ok }, "{row}");
        assert_eq!(row.is_right(), row.problem.ratio == 50, "{row}");
        assert!(row.cpu_s > 0.0 && row.cpu_s < 10.0);
    }
    // The same again but for the times.
    let again = bench(root, &["--csv", root.join("again.csv").to_str().unwrap(), "--filter", "SIM3"]);
    assert_eq!(again.status.code(), Some(0));
    let line =
        std::fs::read_to_string(root.join("again.csv")).unwrap().lines().nth(1).map(Row::parse).unwrap().unwrap();
    let same = rows.iter().find(|r| r.problem == line.problem && r.solver == line.solver).unwrap();
    assert_eq!((line.rot_deg, line.trans, line.scale_rel), (same.rot_deg, same.trans, same.scale_rel));
}

#[test]
fn bad_files_are_named_with_what_is_wrong() {
    let good = bytes(20, 10, 1.0);
    let name = "SE3_N00020_o50_s00.corr";
    let patch = |at: usize, with: &[u8]| {
        let mut bad = good.clone();
        bad[at..at + with.len()].copy_from_slice(with);
        bad
    };
    let nan = f32::NAN.to_le_bytes();
    let beyond = (POINTS_LIMIT as u32 + 1).to_le_bytes();
    let longer = [good.as_slice(), &[0]].concat();
    let cases: [(&str, Vec<u8>, &str); 16] = [
        (name, good[..good.len() - 1].to_vec(), "truncated"),
        (name, longer, "needs 628"),
        (name, good[..100].to_vec(), "truncated"),
        (name, Vec::new(), "CORRv001"),
        (name, patch(0, b"CORRv002"), "CORRv001"),
        (name, patch(8, &0_u32.to_le_bytes()), "0 points"),
        (name, patch(8, &beyond), "1 to 65535 can be aligned"),
        (name, patch(8, &u32::MAX.to_le_bytes()), "1 to 65535 can be aligned"),
        (name, patch(128, &nan), "a source point"),
        (name, patch(128 + 12 * 20 + 4, &f32::INFINITY.to_le_bytes()), "a target point"),
        (name, patch(16, &(-1.0_f64).to_le_bytes()), "σ"),
        (name, patch(24, &0.0_f64.to_le_bytes()), "true scale"),
        (name, patch(32, &f64::NAN.to_le_bytes()), "rotation"),
        (name, patch(104, &f64::INFINITY.to_le_bytes()), "true translation"),
        (name, patch(good.len() - 1, &[3]), "kind 3"),
        ("SE3_N00021_o50_s00.corr", good.clone(), "21 by its name"),
    ];
    for (name, bytes, part) in cases {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), name, &bytes);
        let out = bench(folder.path(), &[]);
        let text = String::from_utf8(out.stderr).unwrap().replace("need 628", "needs 628");
        assert_eq!((out.status.code(), text.lines().count()), (Some(2), 1), "{text}");
        assert!(text.contains(name) && text.contains(part), "{part} is not in {text}");
    }
    assert!(corr::parse(Problem::of_name("SE3_N00020_o50_s00").unwrap(), &good).is_ok());
}

#[test]
fn the_largest_problem_is_read_and_one_more_is_not() {
    let sized = |n: usize| {
        let problem = Problem { group: "SE3".into(), n: n as u32, ratio: 0, seed: 0 };
        let mut file = bytes(1, 1, 1.0)[..128].to_vec();
        file[8..12].copy_from_slice(&(n as u32).to_le_bytes());
        file.resize(128 + 25 * n, 0);
        corr::parse(problem, &file)
    };
    assert_eq!(sized(POINTS_LIMIT).unwrap().source.len(), POINTS_LIMIT);
    assert!(matches!(sized(POINTS_LIMIT + 1), Err(CorrError::Count { .. })));
}

#[test]
fn names_tell_the_cell() {
    let problem = Problem::of_name("ALIAS_N00100_o95_s07").unwrap();
    assert_eq!((problem.group.as_str(), problem.n, problem.ratio, problem.seed), ("ALIAS", 100, 95, 7));
    let bad =
        ["", "SE3", "SE3_N1_o1", "SE3_N1_o1_s1_x", "SE2_N1_o1_s1", "SE3_1_o1_s1", "SE3_N1_o101_s1", "SE3_N-1_o1_s1"];
    assert!(bad.iter().all(|name| Problem::of_name(name).is_none()));
}

#[test]
fn bad_commands_exit_with_2() {
    let folder = tempfile::tempdir().unwrap();
    let code = |options: &[&str]| bench(folder.path(), options).status.code();
    assert_eq!(code(&[]), Some(2), "no folder");
    write(folder.path(), "SE3_N00020_o50_s00.corr", &bytes(20, 10, 1.0));
    assert_eq!(code(&["--filter", "SIM3"]), Some(2), "no file of the filter");
    for sigma in ["0", "-1", "nan", "inf", "wide"] {
        assert_eq!(code(&[&format!("--sigma-max={sigma}")]), Some(2), "{sigma}");
    }
    assert_eq!(code(&["--weighting", "best"]), Some(2));
    assert_eq!(code(&["--peers", "/no/such/peers.csv"]), Some(2));
    assert_eq!(code(&["--peer-python", "/no/such/python"]), Some(2));
    assert_eq!(code(&["--csv", "/no/such/folder/rows.csv"]), Some(2));
    assert_eq!(code(&["--weighting", "em"]), Some(0));
}

#[test]
fn a_wrong_accepted_answer_exits_with_1() {
    let folder = tempfile::tempdir().unwrap();
    // The truth in the header is not that of the points.
    let mut lie = bytes(40, 30, 1.0);
    lie[104..112].copy_from_slice(&5.0_f64.to_le_bytes());
    write(folder.path(), "SE3_N00040_o25_s00.corr", &lie);
    let out = bench(folder.path(), &[]);
    assert_eq!(out.status.code(), Some(1));
    assert!(String::from_utf8(out.stdout).unwrap().contains("0/1 (0)    1 (0)"));
}

#[test]
fn pure_outliers_are_counted() {
    let program = env!("CARGO_BIN_EXE_merganser-sim");
    let out = Command::new(program)
        .args(["bench", "registration", "--pure-outliers", "20", "--n", "50,100"])
        .output()
        .unwrap();
    assert_eq!(out.status.code(), Some(0));
    let text = String::from_utf8(out.stdout).unwrap();
    assert!(text.contains("N=50: 0 of 20 accepted") && text.contains("N=100: 0 of 20 accepted"), "{text}");
}

#[test]
fn peers_are_ranked_by_success_then_time() {
    let text = "group,solver,N,outlier_pct,seeds,success_pct,rot_med_deg,trans_med,scale_med_rel,cpu_med_ms,cpu_max_ms,timeouts\n\
                SE3,slow,100,50,20,100,0.3,0.004,0.0,9.0,9.0,0\nSE3,fast,100,50,20,100,0.3,0.004,0.0,2.0,9.0,0\n\
                SE3,poor,100,50,20,40,0.3,0.004,0.0,0.1,9.0,0\nSE3,teaser_a,100,50,5,100,nan,nan,nan,1.0,1.0,0\n\
                SE3,teaser_b,100,50,20,100,0.3,0.004,0.0,3.0,9.0,0\n";
    let peers = Peers::parse(text).unwrap();
    let cell = Cell { group: "SE3".into(), n: 100, ratio: 50 };
    assert_eq!(peers.best(&cell).unwrap().solver, "teaser_a");
    assert_eq!(peers.headline(&cell).unwrap().solver, "teaser_b");
    assert!(peers.best(&Cell { n: 5, ..cell }).is_none());
    for bad in ["", "group\n", &text.replace("100,50,5", "100,fifty,5"), &text.replace(",1.0,0\n", ",1.0\n")] {
        assert!(Peers::parse(bad).is_err(), "{bad}");
    }
}

#[test]
fn files_are_found_below_and_in_order() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["SIM3_N00020_o50_s00.corr", "SE3_N00020_o50_s01.corr", "SE3_N00020_o50_s00.corr", "SE3_notes.txt"] {
        write(folder.path(), name, b"");
    }
    let names: Vec<String> = files(folder.path(), "N00020")
        .unwrap()
        .iter()
        .map(|path| path.file_name().unwrap().to_string_lossy().into_owned())
        .collect();
    assert_eq!(names, ["SE3_N00020_o50_s00.corr", "SE3_N00020_o50_s01.corr", "SIM3_N00020_o50_s00.corr"]);
}

#[test]
fn a_folder_without_logs_is_told() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("one.clf"), "").unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_merganser-sim"));
    let out = command.args(["bench", "logs", "--data"]).arg(folder.path()).output().unwrap();
    assert_eq!(out.status.code(), Some(2));
    let told = String::from_utf8(out.stderr).unwrap();
    assert!(
        told.contains("nothing that can be played") && told.contains("no one.relations and no one.gt.tum"),
        "{told}"
    );
}
