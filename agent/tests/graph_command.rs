//! `merganser graph` from outside: what it writes, and what it says of files that it cannot use.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

/// Exit code, what went to stdout and what to stderr.
fn graph(dir: &Path, arguments: &str) -> (i32, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_merganser"));
    let out = command.arg("graph").args(arguments.split(' ')).current_dir(dir).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (out.status.code().unwrap(), text(out.stdout), text(out.stderr))
}

/// An edge along x whose information is `weight` times the identity.
fn edge(i: u64, j: u64, length: f64, weight: &str) -> String {
    let w = weight;
    format!("EDGE_SE3:QUAT {i} {j} {length} 0 0 0 0 0 1 {w} 0 0 0 0 0 {w} 0 0 0 0 {w} 0 0 0 {w} 0 0 {w} 0 {w}\n")
}

/// A loop of `n` poses from `first` on.
fn ring(first: u64, n: u64) -> String {
    let steps = (0..n - 1).map(|k| edge(first + k, first + k + 1, 1.0, "100"));
    steps.chain([edge(first + n - 1, first, 1.0 - n as f64 + 0.1, "100")]).collect()
}

fn vertex(id: u64, x: f64) -> String {
    format!("VERTEX_SE3:QUAT {id} {x} 2 3 0 0 0.7071067811865476 0.7071067811865476\n")
}

fn robots_pose(letter: u8, k: u64) -> u64 {
    (u64::from(letter) << 56) | k
}

fn read(dir: &Path, name: &str) -> String {
    std::fs::read_to_string(dir.join(name)).unwrap()
}

fn rows(table: &str) -> Vec<Vec<f64>> {
    let row = |line: &str| line.split(',').map(|x| x.parse().unwrap()).collect();
    table.lines().skip(1).map(row).collect()
}

#[test]
fn parts_are_told_apart_and_lie_where_their_files_put_them() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let text =
        format!("{}{}{}{}FIX 11\n{}", ring(0, 5), ring(10, 4), vertex(10, 7.0), vertex(11, 50.0), vertex(99, 1.0));
    std::fs::write(at.join("a.g2o"), &text).unwrap();
    for how in ["", " --robust"] {
        let (code, said, odd) = graph(at, &format!("solve a.g2o --tum t --out o.g2o --marginals m.csv{how}"));
        assert_eq!((code, odd.as_str()), (0, ""), "{said}");
        assert!(!said.contains("-0.0") && !said.contains("1 parts"), "{said}");
        if how.is_empty() {
            assert!(
                said.contains("part 3 of 3: 1 pose, 0 measurements, converged after 0 iterations, χ² 0.0"),
                "{said}"
            );
        }
        let tum = read(at, "t");
        let heads: Vec<&str> = tum.lines().filter(|line| line.starts_with('#')).collect();
        let want = ["# part 1 of 3: 5 poses, placed by pose 0", "# part 2 of 3: 4 poses, placed by pose 11"];
        assert_eq!((&heads[..2], heads[2]), (&want[..], "# part 3 of 3: 1 pose, placed by pose 99"));
        // Without a vertex at the origin; fixed; alone.
        assert!(tum.contains("\n0 0 0 0 0 0 0 1\n"), "{tum}");
        for there in ["\n11 50 2 3 ", "\n99 1 2 3 "] {
            assert!(tum.contains(there), "{tum}");
        }
        let out = read(at, "o.g2o");
        assert_eq!(out.lines().filter(|line| line.starts_with('#')).collect::<Vec<_>>(), heads);
        assert!(out.contains("\nFIX 11\n"), "{out}");
        let rows = rows(&read(at, "m.csv"));
        assert_eq!(rows.len(), 10);
        let origin = |id: f64| [0.0, 11.0, 99.0][usize::from(id > 5.0) + usize::from(id > 20.0)];
        assert!(rows.iter().all(|row| row.len() == 30 && row[1] == origin(row[0])), "{rows:?}");
        // The origin is certain, and what is near it surer than what is far.
        let variance = |id: f64| rows.iter().find(|row| row[0] == id).unwrap()[9];
        assert!(variance(11.0) < 1e-17 && variance(12.0) < variance(13.0), "{rows:?}");
        // It reads back, and changes no more.
        let (code, again, _) = graph(at, "solve o.g2o --tum t2");
        assert_eq!(code, 0, "{again}");
        let numbers = |text: &str| -> Vec<f64> {
            let words = text.lines().filter(|line| !line.starts_with('#')).flat_map(|line| line.split(' '));
            words.map(|x| x.parse().unwrap()).collect()
        };
        assert!(numbers(&tum).iter().zip(&numbers(&read(at, "t2"))).all(|(x, y)| (x - y).abs() < 1e-9));
    }
}

#[test]
fn a_graph_of_one_part_is_written_without_comments() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    std::fs::write(at.join("a.g2o"), format!("\u{feff}{}{}", vertex(0, 1.0), ring(0, 5))).unwrap();
    let (code, said, odd) = graph(at, "solve a.g2o --tum t --out o.g2o");
    assert_eq!((code, odd.as_str()), (0, ""), "{said}");
    assert!(read(at, "t").starts_with("0 1 2 3 0 0 0.707") && !read(at, "o.g2o").contains('#'));
    // Turned by 90° as its first pose is: one step on is along y.
    let second: Vec<f64> = read(at, "t").lines().nth(1).unwrap().split(' ').map(|x| x.parse().unwrap()).collect();
    assert!((second[1] - 1.0).abs() < 1e-9 && (second[2] - 3.0).abs() < 0.1, "{second:?}");
}

#[test]
fn the_robust_solvers_covariances_are_those_of_what_counts() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let chain: String = (0..30).map(|k| edge(k, k + 1, 1.0, "1e4")).collect();
    let good: String = (0..10).map(|k| edge(k, k + 20, 20.0, "1e4")).collect();
    let bad = edge(3, 27, 2.0, "1e4");
    std::fs::write(at.join("good.g2o"), format!("{chain}{good}")).unwrap();
    std::fs::write(at.join("all.g2o"), format!("{chain}{bad}{good}")).unwrap();
    let (code, said, odd) = graph(at, "solve all.g2o --robust --marginals all.csv --verdicts v.csv");
    assert_eq!((code, odd.as_str()), (0, ""), "{said}");
    assert!(said.starts_with("31 poses in 1 part; 30 odometry, 10 of 11 other measurements used; "), "{said}");
    let (code, ..) = graph(at, "solve good.g2o --marginals good.csv");
    assert_eq!(code, 0);
    let (all, good) = (rows(&read(at, "all.csv")), rows(&read(at, "good.csv")));
    assert_eq!((all.len(), good.len()), (31, 31));
    for (x, y) in all.iter().zip(&good) {
        let near = |(a, b): (&f64, &f64)| (a - b).abs() <= 1e-6 * b.abs().max(1e-6);
        assert!(x[..9].iter().zip(&y[..9]).all(|(a, b)| (a - b).abs() < 1e-6), "{x:?} {y:?}");
        assert!(x[9..].iter().zip(&y[9..]).all(near), "{x:?} {y:?}");
    }
}

#[test]
fn faults_are_told_by_file_and_line() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let write = |name: &str, text: &str| std::fs::write(at.join(name), text).unwrap();
    let refused = |arguments: &str, parts: &[&str]| {
        let (code, said, told) = graph(at, arguments);
        assert_eq!((code, said.as_str()), (2, ""), "{arguments}");
        assert_eq!(told.lines().count(), 1, "{told}");
        assert!(parts.iter().all(|part| told.contains(part)), "{arguments}: {told}");
    };
    write("a.g2o", &ring(robots_pose(b'a', 0), 5));
    let fifth = robots_pose(b'a', 5);
    write(
        "weak.g2o",
        &format!("# a comment\n{}{}", edge(fifth - 1, fifth, 1.0, "1e-11"), edge(fifth, fifth + 1, 1.0, "1e12")),
    );
    for how in ["", " --robust"] {
        let arguments = format!("solve a.g2o weak.g2o --tum t --out o.g2o --marginals m.csv{how}");
        refused(&arguments, &["weak.g2o:2: ", "pose ", "(a5) is not determined", "1e-11", "1e12"]);
        let written = ["t", "o.g2o", "m.csv"].map(|name| at.join(name).exists());
        assert_eq!(written, [false; 3], "of what failed");
    }
    let off = edge(1, 2, 1.0, "1").replace("1 0 0 0 0 0 1 0 0 0 0 1", "1 0 0 0 9 0 1 0 0 0 0 1");
    write("off.g2o", &format!("{}{off}", edge(0, 1, 1.0, "1")));
    refused("solve a.g2o off.g2o", &["off.g2o:2: the information matrix is not positive definite"]);
    write("far.g2o", &format!("\n{}", edge(0, 1, 1e200, "1")));
    refused("solve a.g2o far.g2o", &["far.g2o:2: 1e200 m is more than 1e12 m; check its unit"]);
    write("word.g2o", "VERTEX_SE2 0 0 zero 0");
    refused("solve a.g2o word.g2o", &["word.g2o:1: \"zero\" is no finite number"]);
    write("cr.g2o", &ring(0, 5).replace('\n', "\r"));
    refused("solve cr.g2o", &["cr.g2o:1: lines end in CR alone", "tr '\\r' '\\n'"]);
    let wide: Vec<u8> = ring(0, 5).encode_utf16().flat_map(u16::to_le_bytes).collect();
    std::fs::write(at.join("wide.g2o"), [&[0xff, 0xfe][..], &wide].concat()).unwrap();
    refused("solve wide.g2o", &["wide.g2o:1: this is no UTF-8 text"]);
    write("empty.g2o", "\n");
    refused("solve empty.g2o", &["empty.g2o: no pose in it"]);
    write("given.g2o", &format!("{}{}", vertex(0, 1.0), ring(0, 5)));
    refused("solve given.g2o --start given", &["the part of pose 0: pose 1 has no value"]);
}

#[test]
fn what_is_odd_but_no_fault_is_said_once() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let twice = edge(0, 3, 3.3, "1");
    std::fs::write(at.join("a.g2o"), format!("{}{twice}{twice}{twice}FIX 8\nFIX 1 2\n", ring(0, 5))).unwrap();
    // The other robot's file repeats it, which is no news.
    std::fs::write(at.join("b.g2o"), &twice).unwrap();
    let (code, said, odd) = graph(at, "solve a.g2o b.g2o");
    assert_eq!(code, 0, "{odd}");
    assert!(said.contains("5 poses, 8 measurements"), "{said}");
    let lines: Vec<&str> = odd.lines().collect();
    assert_eq!(lines.len(), 3, "{odd}");
    assert!(lines[0].contains("a.g2o:7: 2 measurements repeat another to the bit"), "{odd}");
    assert!(lines[1].contains("FIX names pose 8, which has no vertex"), "{odd}");
    assert!(lines[2].contains("FIX names 2 poses of one part; pose 1 says where it lies"), "{odd}");
}

#[test]
fn tables_are_fused_and_what_contradicts_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let chain = |length: f64, poses: u64| (0..poses).map(|k| edge(k, k + 1, length, "100")).collect::<String>();
    for (name, text) in [("a", chain(1.0, 4)), ("b", chain(1.02, 5)), ("far", chain(9.0, 4))] {
        std::fs::write(at.join(format!("{name}.g2o")), text).unwrap();
        assert_eq!(graph(at, &format!("solve {name}.g2o --marginals {name}.csv")).0, 0);
    }
    let (code, said, odd) = graph(at, "fuse a.csv b.csv --out f.csv");
    assert_eq!((code, odd.as_str()), (0, ""), "{said}");
    assert_eq!(said, "5 poses in both; 0 only in a.csv and 1 only in b.csv, kept as they are\n");
    let (a, b, fused) = (rows(&read(at, "a.csv")), rows(&read(at, "b.csv")), rows(&read(at, "f.csv")));
    assert_eq!((fused.len(), &fused[5]), (6, &b[5]));
    assert_eq!(fused[0], a[0], "the origin");
    // Equally sure, all in common: in the middle, and no surer.
    assert!((fused[1][2] - 1.01).abs() < 1e-9, "{fused:?}");
    for (k, row) in fused.iter().enumerate().take(5).skip(1) {
        let between = (1.0 * k as f64 - 1e-9)..=(1.02 * k as f64 + 1e-9);
        assert!(between.contains(&row[2]) && (row[9] / a[k][9] - 1.0).abs() < 1e-3, "{row:?}");
    }
    assert_eq!(graph(at, "fuse a.csv b.csv --out i.csv --independent 1").0, 0);
    let independent = rows(&read(at, "i.csv"));
    assert!((independent[2][9] / a[2][9] - 0.5).abs() < 1e-3, "{independent:?}");
    let refused = |arguments: &str, parts: &[&str]| {
        let (code, _, told) = graph(at, arguments);
        assert_eq!(code, 2, "{arguments}");
        assert!(parts.iter().all(|part| told.contains(part)) && !at.join("no.csv").exists(), "{arguments}: {told}");
    };
    refused("fuse a.csv far.csv --out no.csv", &["a.csv:3 and far.csv:3: pose 1: the two estimates disagree (χ² "]);
    refused("fuse a.csv a.g2o --out no.csv", &["a.g2o:1: the first line is not `id,origin"]);
    let mut bad = String::new();
    read(at, "b.csv").lines().enumerate().for_each(|(k, line)| {
        let _ = writeln!(bad, "{}", if k == 3 { line.replacen("e-", "x-", 1) } else { line.to_owned() });
    });
    std::fs::write(at.join("bad.csv"), bad).unwrap();
    refused("fuse a.csv bad.csv --out no.csv", &["bad.csv:4: ", "is no finite number"]);
    assert_eq!(graph(at, "fuse a.csv b.csv --out no.csv --independent 1.5").0, 2);
    let (code, help, _) = graph(at, "fuse --help");
    let words = help.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(code == 0 && words.contains("unite them in one graph and solve it"), "{help}");
}

#[test]
fn a_split_graph_keeps_what_is_fixed() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    std::fs::write(at.join("a.g2o"), format!("{}{}FIX 3\n", ring(0, 6), vertex(3, 5.0))).unwrap();
    let (code, said, _) = graph(at, "split a.g2o --robots 2 --out s.g2o");
    assert_eq!((code, said.as_str()), (0, "6 poses shared among 2 robots, 2 measurements between them\n"));
    assert!(read(at, "s.g2o").contains(&format!("FIX {}\n", robots_pose(b'b', 0))));
}

/// `n` steps along x from 0 on, with or without the poses.
fn chain(first: u64, n: u64, length: f64, with_poses: bool) -> String {
    let poses = (0..=n).filter(|_| with_poses).map(|k| vertex(first + k, k as f64 * length));
    poses.chain((0..n).map(|k| edge(first + k, first + k + 1, length, "100"))).collect()
}

#[test]
fn robots_that_number_alike_are_told_apart_by_the_cure() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    for with_poses in [false, true] {
        for letter in [0, b'x'] {
            let first = robots_pose(letter, 0);
            std::fs::write(at.join("A.g2o"), chain(first, 3, 1.0, with_poses)).unwrap();
            std::fs::write(at.join("B.g2o"), chain(first, 2, 2.0, with_poses)).unwrap();
            for how in ["", " --robust"] {
                let (code, _, told) = graph(at, &format!("solve A.g2o B.g2o --tum t.tum{how}"));
                assert!(code == 2 && !at.join("t.tum").exists(), "{told}");
                let place = if with_poses { "B.g2o:2: states" } else { "B.g2o:1: measures" };
                let names = if letter == 0 { "the ids 0 to 2" } else { "(x0) to " };
                for part in [place, "otherwise than A.g2o:", names, "letter", "graph split B.g2o --robots 1 --first"] {
                    assert!(told.contains(part), "{part}: {told}");
                }
            }
            let (code, said, told) = graph(at, "split B.g2o --robots 1 --first b --out b.g2o");
            assert_eq!((code, told.as_str()), (0, ""), "{said}");
            assert!(read(at, "b.g2o").contains(&format!("{} {}", robots_pose(b'b', 0), robots_pose(b'b', 1))));
            let (code, said, told) = graph(at, "solve A.g2o b.g2o --tum t.tum");
            assert_eq!((code, told.as_str()), (0, ""), "{said}");
            // A file for each robot, and times that are the numbers of its poses.
            let own = if letter == 0 { "t_0.tum" } else { "t_x.tum" };
            let times = |name: &str| -> Vec<String> {
                let text = read(at, name);
                let lines = text.lines().filter(|line| !line.starts_with('#'));
                lines.map(|line| line.split(' ').next().unwrap().to_owned()).collect()
            };
            assert_eq!(
                (times(own), times("t_b.tum")),
                (["0", "1", "2", "3"].iter().map(|t| (*t).into()).collect(), vec!["0".into(), "1".into(), "2".into()])
            );
            assert_eq!(read(at, own).matches('#').count(), 1, "one part of the two");
        }
    }
    assert_eq!(graph(at, "split A.g2o --robots 2 --first z --out no.g2o").0, 2);
    assert_eq!(graph(at, "split A.g2o --robots 2 --first 1 --out no.g2o").0, 2);
}

#[test]
fn robots_that_number_in_different_strides_are_doubted() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let strided = |stride: u64| (0..6).map(|k| edge(k * stride, (k + 1) * stride, 1.0, "100")).collect::<String>();
    std::fs::write(at.join("A.g2o"), strided(2)).unwrap();
    std::fs::write(at.join("B.g2o"), strided(3)).unwrap();
    let (code, _, told) = graph(at, "solve A.g2o B.g2o");
    assert_eq!((code, told.lines().count()), (0, 1), "{told}");
    assert!(told.contains("A.g2o, B.g2o: several of these files use 3 ids from 0 to 12, without"), "{told}");
}

#[test]
fn what_does_not_converge_is_told_with_what_may_help() {
    let dir = tempfile::tempdir().unwrap();
    let turned = |i: u64, j: u64| {
        edge(i, j, 1.0, "100").replace(" 0 0 0 1 100", " 0 0 0.7071067811865476 0.7071067811865476 100")
    };
    let bent = [(0, 1), (1, 2), (2, 3)].map(|(i, j)| turned(i, j)).concat() + &edge(3, 0, 5.0, "100");
    std::fs::write(dir.path().join("bent.g2o"), bent).unwrap();
    for (how, parts) in [
        ("", ["(--iterations)", "--start chordal", "(--robust)"]),
        (" --start chordal", ["(--iterations)", "(--certify)", "(--robust)"]),
    ] {
        let (code, said, told) = graph(dir.path(), &format!("solve bent.g2o --iterations 1{how}"));
        assert!(code == 1 && said.contains("NOT CONVERGED"), "{code}: {said}");
        assert!(told.contains("part 1 is not at a minimum after 1 iteration:"), "{told}");
        assert!(parts.iter().all(|part| told.contains(part)) && told.lines().count() == 1, "{told}");
    }
    assert_eq!(graph(dir.path(), "solve bent.g2o").0, 0);
}

/// Once for each file that has them so, by its name; of the others nothing is told.
#[test]
fn quaternions_written_w_first_are_told_by_file_with_the_cure() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path();
    let of = |letter: u8| {
        let way: String =
            (0..14).map(|k| edge(robots_pose(letter, k), robots_pose(letter, k + 1), 1.0, "100")).collect();
        way + &vertex(robots_pose(letter, 0), 7.0)
    };
    let w_first = |text: &str| text.replace(" 0 0 0 1 100 ", " 1 0 0 0 100 ");
    std::fs::write(at.join("a.g2o"), of(b'a')).unwrap();
    std::fs::write(at.join("b.g2o"), w_first(&of(b'b'))).unwrap();
    let (_, _, odd) = graph(at, "solve a.g2o");
    assert_eq!(odd, "");
    let (_, _, odd) = graph(at, "solve a.g2o b.g2o");
    assert_eq!(odd.matches("w first").count(), 1, "{odd}");
    let told = "b.g2o: the quaternions of the EDGE_SE3:QUAT lines seem to be written w first; g2o has them as x y z w: put w last";
    assert!(odd.contains(told), "{odd}");
    // Values alone, of a robot that drives round.
    let vertices = |w_first: bool| {
        (0..40).fold(String::new(), |mut text, k| {
            let half = 0.1 * f64::from(k);
            let (s, c, turn) = (half.sin(), half.cos(), 2.0 * half);
            let (x, y) = (5.0 * turn.sin(), 5.0 - 5.0 * turn.cos());
            let q = if w_first { [c, 0.0, 0.0, s] } else { [0.0, 0.0, s, c] };
            let _ = writeln!(text, "VERTEX_SE3:QUAT {k} {x} {y} 0 {} {} {} {}", q[0], q[1], q[2], q[3]);
            text
        })
    };
    for (is_w_first, count) in [(false, 0), (true, 1)] {
        std::fs::write(at.join("c.g2o"), vertices(is_w_first)).unwrap();
        let (_, _, odd) = graph(at, "solve c.g2o");
        assert_eq!(odd.matches("c.g2o: the quaternions of the VERTEX_SE3:QUAT lines").count(), count, "{odd}");
    }
}
