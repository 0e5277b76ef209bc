//! Files, minima, certificates and covariances of pose graphs.

use super::fault::{MeasurementFault, PoseGraphError};
use super::g2o::{Fault, G2oError, LINE_MAX, Parser, Repeated, Shared, write, write_tum};
use super::kimera::{Importer, KimeraError, KimeraFault};
use super::lines::Place;
use super::solve::Start;
use super::*;
use crate::geometry::so3::So3;
use crate::geometry::{Se3, se3};
use nalgebra::{DMatrix, Vector3, Vector6};
use proptest::prelude::*;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A ring with chords: true poses, and measurements with normal noise of standard deviations (m, rad) for which the
/// information is right.
fn ring(seed: u64, n: u64, noise: (f64, f64)) -> (Vec<Se3>, PoseGraph) {
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let truth: Vec<Se3> = (0..n).map(|_| Se3::exp(&uniform(rng, 2.0, 5.0))).collect();
    let mut graph = PoseGraph { poses: (0..n).map(|k| (k, None)).collect(), ..PoseGraph::default() };
    let chords = (0..n).map(|k| (k, rng.random_range(0..n))).collect::<Vec<_>>();
    let ends = (0..n).map(|k| (k, (k + 1) % n)).chain(chords).filter(|(i, j)| i != j);
    for (line, (i, j)) in ends.enumerate() {
        let error = se3::join(&(normal(rng) * noise.0), &(normal(rng) * noise.1));
        let t_i_j = (truth[i as usize].inverse() * truth[j as usize]).retract(&error);
        let (kappa, tau) = (0.5 / noise.1.powi(2), noise.0.powi(-2));
        let information = isotropic_information(kappa, tau);
        let printed = t_i_j.rotation.matrix();
        graph.measurements.push(Measurement { i, j, t_i_j, printed, information, kappa, tau, line });
    }
    (truth, graph)
}

fn uniform(rng: &mut impl Rng, angle: f64, length: f64) -> Vector6<f64> {
    let mut vector = |size: f64| Vector3::from_fn(|_, _| rng.random_range(-size..size));
    se3::join(&vector(length), &vector(angle))
}

/// Three draws that are nearly normal.
fn normal(rng: &mut impl Rng) -> Vector3<f64> {
    Vector3::from_fn(|_, _| (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0)
}

#[test]
fn exact_measurements_give_back_the_truth_and_are_certified() {
    let (truth, mut graph) = ring(1, 40, (0.1, 0.05));
    for m in &mut graph.measurements {
        m.t_i_j = truth[m.i as usize].inverse() * truth[m.j as usize];
        m.printed = m.t_i_j.rotation.matrix();
    }
    let (values, outcome) = graph.certified(50).unwrap();
    assert!(outcome.certificate.certified && outcome.cost < 1e-18, "{outcome:?}");
    let solved = graph.solve(&values, 50).unwrap();
    assert!(solved.solution.chi2 < 1e-18);
    for (value, want) in solved.values.iter().zip(&truth) {
        assert!((truth[0].inverse() * *want).local(value).norm() < 1e-9);
    }
}

#[test]
fn every_start_finds_the_minimum_and_the_certificate_holds() {
    for seed in 0..8 {
        let (_, graph) = ring(seed, 60, (0.2, 0.1));
        assert!(graph.is_isotropic());
        let (values, outcome) = graph.certified(100).unwrap();
        assert!(outcome.converged && outcome.certificate.certified, "seed {seed}: {outcome:?}");
        let relaxed = graph.solve(&graph.start(Start::Relaxed, 100).unwrap(), 100).unwrap();
        let chordal = graph.solve(&values, 100).unwrap();
        assert!((relaxed.solution.chi2 / chordal.solution.chi2 - 1.0).abs() < 1e-9, "seed {seed}");
        let dof = relaxed.solution.dof as f64;
        assert!((relaxed.solution.chi2 / dof - 1.0).abs() < 6.0 * (2.0 / dof).sqrt());
        let minimum = graph.minimise(&values, 100).unwrap();
        assert_eq!(minimum.values, chordal.values);
    }
}

#[test]
fn a_local_minimum_is_not_certified() {
    // A ring of identities whose poses turn once around is stationary, and not the global minimum.
    let n = 20;
    let (_, mut graph) = ring(3, n, (0.1, 0.1));
    graph.measurements.retain(|m| (m.i + 1) % n == m.j);
    for m in &mut graph.measurements {
        (m.t_i_j, m.printed) = (Se3::identity(), Matrix3::identity());
    }
    let turn = |k: u64| So3::exp(&Vector3::new(0.0, 0.0, k as f64 * core::f64::consts::TAU / n as f64));
    let twisted: Vec<Se3> = (0..n).map(|k| Se3::new(turn(k), Vector3::zeros())).collect();
    let chordal = graph.chordal();
    let stuck = chordal.minimise(&twisted, 100).unwrap();
    assert!(stuck.converged && stuck.cost > 1.0, "{}", stuck.cost);
    let certificate = chordal.certify(&stuck.values).unwrap();
    assert!(!certificate.certified && certificate.gap.is_none_or(|gap| gap >= 0.99 * stuck.cost), "{certificate:?}");
    let best = chordal.minimise(&chordal.relaxed().unwrap(), 100).unwrap();
    assert!(best.cost < 1e-15 && chordal.certify(&best.values).unwrap().certified);
}

#[test]
fn the_gap_bounds_the_excess_of_points_that_are_no_minimum() {
    let (_, graph) = ring(5, 30, (0.2, 0.1));
    let chordal = graph.chordal();
    let best = chordal.minimise(&chordal.relaxed().unwrap(), 100).unwrap();
    let rng = &mut ChaCha8Rng::seed_from_u64(9);
    let off: Vec<Se3> = best.values.iter().map(|t| t.retract(&uniform(rng, 0.01, 0.01))).collect();
    assert!(chordal.cost(&off) > best.cost * 1.01);
    assert!(!chordal.certify(&off).unwrap().certified);
}

proptest! {
    #[test]
    fn chordal_gradient_and_hessian_are_those_of_differences(seed: u64) {
        // The minimiser's own derivatives, by what they promise: Newton converges to where no coordinate can improve.
        let (_, graph) = ring(seed, 8, (0.3, 0.2));
        let chordal = graph.chordal();
        let minimum = chordal.minimise(&chordal.relaxed().unwrap(), 100).unwrap();
        prop_assert!(minimum.converged && minimum.iterations < 30, "{} iterations", minimum.iterations);
        for node in 1..8 {
            for k in 0..6 {
                for step in [-1e-4, 1e-4] {
                    let mut xi = Vector6::zeros();
                    xi[k] = step;
                    let mut moved = minimum.values.clone();
                    moved[node] = moved[node].retract(&xi);
                    prop_assert!(chordal.cost(&moved) > minimum.cost);
                }
            }
        }
    }

    #[test]
    fn no_text_makes_the_parsers_panic(lines in prop::collection::vec("[ -~]{0,60}", 0..8), numbers in prop::collection::vec(any::<f64>(), 28)) {
        let mut parser = Parser::default();
        let mut importer = Importer::default();
        let text: Vec<String> = numbers.iter().map(f64::to_string).collect();
        for line in lines.iter().cloned().chain([format!("EDGE_SE3:QUAT 0 1 {}", text.join(" "))]) {
            let _ = (parser.line(&line), importer.line(&line));
        }
        for part in parser.finish().parts() {
            let _ = part.start(Start::Relaxed, 5).and_then(|start| part.solve(&start, 5));
        }
    }

    #[test]
    fn a_written_graph_reads_back(seed: u64) {
        let (truth, mut graph) = ring(seed, 9, (0.2, 0.1));
        graph.poses.iter_mut().for_each(|(&k, value)| *value = Some(truth[k as usize]));
        let text = write(&graph);
        let read = parsed(&text).unwrap();
        prop_assert!(read.measurements.len() == graph.measurements.len() && read.poses.len() == graph.poses.len());
        for (a, b) in read.poses.values().flatten().zip(graph.poses.values().flatten()) {
            prop_assert!(a.local(b).norm() < 1e-12);
        }
        for (a, b) in read.measurements.iter().zip(&graph.measurements) {
            prop_assert!((a.kappa / b.kappa - 1.0).abs() < 1e-9 && (a.tau / b.tau - 1.0).abs() < 1e-9);
            prop_assert!(a.t_i_j.local(&b.t_i_j).norm() < 1e-12 && (a.i, a.j) == (b.i, b.j));
        }
    }
}

fn parsed(text: &str) -> Result<PoseGraph, G2oError> {
    let mut parser = Parser::default();
    text.lines().try_for_each(|line| parser.line(line))?;
    Ok(parser.finish())
}

#[test]
fn marginals_are_those_of_dense_algebra() {
    let (_, graph) = ring(11, 12, (0.2, 0.1));
    let solved = graph.solve(&graph.start(Start::Relaxed, 100).unwrap(), 100).unwrap();
    // H of the graph by the measurements' exact Jacobians, the first pose fixed.
    let n = 6 * (solved.values.len() - 1);
    let mut h = DMatrix::<f64>::zeros(n, n);
    for m in &graph.measurements {
        let predicted = solved.values[m.i as usize].inverse() * solved.values[m.j as usize];
        let by_j = se3::right_jacobian_inv(&m.t_i_j.local(&predicted));
        let by_i = -by_j * predicted.inverse().adjoint();
        let blocks = [(m.i, by_i), (m.j, by_j)];
        for (a, x) in blocks.iter().filter(|(a, _)| *a > 0) {
            for (b, y) in blocks.iter().filter(|(b, _)| *b > 0) {
                let mut block = h.view_mut((6 * (*a as usize - 1), 6 * (*b as usize - 1)), (6, 6));
                block += x.transpose() * m.information * y;
            }
        }
    }
    let dense = h.try_inverse().unwrap();
    let marginals = solved.marginals();
    assert_eq!(marginals.len(), solved.ids.len());
    for (id, covariance) in marginals.iter().filter(|(id, _)| *id > 0) {
        let at = 6 * (*id as usize - 1);
        let want = dense.view((at, at), (6, 6));
        assert!((covariance.matrix() - want).amax() < 1e-8 * want.amax(), "pose {id}");
    }
}

#[test]
fn planar_files_stay_in_their_plane() {
    let text = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 1.5\nVERTEX_SE2 2 1 1 3\n\
                EDGE_SE2 0 1 1 0 1.5708 50 0 0 40 0 100\nEDGE_SE2 1 2 1 0 1.5708 50 1 2 40 3 100\n\
                EDGE_SE2 2 0 1.1 1 3.2 50 0 0 40 0 100\n";
    let graph = parsed(text).unwrap();
    assert!(graph.planar && !graph.is_isotropic());
    assert_eq!((graph.measurements[0].kappa, graph.measurements[0].tau), (100.0, 2.0 / (1.0 / 50.0 + 1.0 / 40.0)));
    let (values, outcome) = graph.certified(100).unwrap();
    assert!(outcome.certificate.certified);
    let solved = graph.solve(&values, 100).unwrap();
    for value in &solved.values {
        let turn = value.rotation.log();
        assert!(value.translation.z.abs() < 1e-12 && turn.xy().norm() < 1e-12);
    }
    let again = write(&PoseGraph {
        poses: solved.ids.iter().copied().zip(solved.values.iter().copied().map(Some)).collect(),
        ..graph
    });
    assert!(again.lines().count() == 6 && again.lines().all(|line| line.contains("_SE2 ")));
    assert!(parsed(&again).is_ok());
}

#[test]
fn faults_name_their_line_and_what_to_do() {
    let good = "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1";
    assert!(parsed(good).is_ok());
    let fault = |text: &str| {
        let error = parsed(&format!("# a comment\n\nFIX 0\n{text}\n")).unwrap_err();
        assert_eq!(error.line, 4);
        error.what
    };
    assert_eq!(fault("EDGE_XYZ 1 2"), Fault::Tag("EDGE_XYZ".into()));
    assert_eq!(fault("VERTEX_SE2 0 1 2"), Fault::Fields { want: 4, got: 3 });
    assert_eq!(fault("VERTEX_SE2 -1 1 2 3"), Fault::Id("-1".into()));
    assert_eq!(fault("VERTEX_SE2 0 1 NaN 3"), Fault::Number("NaN".into()));
    assert_eq!(fault("VERTEX_SE2 0 1 1e999 3"), Fault::Number("1e999".into()));
    assert_eq!(fault("VERTEX_SE3:QUAT 0 1 2 3 0 0 0 2"), Fault::Quaternion(2.0));
    assert_eq!(fault(&good.replacen("0 1 1", "1 1 1", 1)), Fault::SelfLoop(1));
    assert_eq!(fault("EDGE_SE2 0 1 1 0 0 1e-320 0 0 1 0 1"), Fault::Information, "its variance overflows");
    assert_eq!(fault(&good.replace("0 1 0 1", "0 0 0 1")), Fault::Information);
    let indefinite = parsed(&good.replace("0 0 0 0 0 1 0 0 0 0", "0 0 0 0 9 1 0 0 0 0")).unwrap();
    let start = indefinite.start(Start::Relaxed, 10).unwrap();
    let refused = PoseGraphError::At { line: 1, what: MeasurementFault::Information };
    assert_eq!(indefinite.solve(&start, 10).unwrap_err(), refused);
    assert!(indefinite.isotropic().solve(&start, 10).is_ok());
    assert_eq!(fault("VERTEX_SE2 0 1 -2e12 3"), Fault::Far(-2e12));
    assert_eq!(fault("FIX 0 one"), Fault::Id("one".into()));
    // As many poses may be fixed as there may be.
    let mut parser = Parser::default();
    (0..POSES_MAX as u64).for_each(|id| parser.line(&format!("FIX {id}")).unwrap());
    assert_eq!(parser.line("FIX 1000000").unwrap_err().what, Fault::Poses);
    assert_eq!(fault("VERTEX_SE2 0 0 0 0\rVERTEX_SE2 1 0 0 0\r"), Fault::CarriageReturn);
    assert_eq!(fault("\u{fffd}\u{fffd}V\0E\0"), Fault::Text);
    assert!(parsed(&format!("\u{feff}{good}\r\n")).is_ok());
    assert_eq!(fault(&"x".repeat(LINE_MAX + 1)), Fault::Long);
    assert_eq!(fault(&format!("#{}", "x".repeat(LINE_MAX))), Fault::Long);
    let two = "VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 1 0 0";
    assert_eq!(parsed(two).unwrap_err(), G2oError { line: 2, what: Fault::Twice(0) });
    let mixed = format!("VERTEX_SE2 0 0 0 0\n{good}");
    assert_eq!(parsed(&mixed).unwrap_err(), G2oError { line: 2, what: Fault::Mixed });
    assert!(format!("{}", parsed(two).unwrap_err()).starts_with("line 2: pose 0 is told twice"));
}

#[test]
fn what_two_robots_files_both_hold_counts_once() {
    let name = |letter: u8, k: u64| (u64::from(letter) << 56) | k;
    let measured = |angle: &str| format!("EDGE_SE2 {} {} 1 0 {angle} 1 0 0 1 0 1", name(b'a', 0), name(b'b', 1));
    let mut parser = Parser::default();
    for line in [&measured("0.1"), &measured("0.1"), &measured("0.2")] {
        parser.line(line).unwrap();
    }
    // Twice in one file is two measurements; again in another robot's file is none, and a third value is one.
    parser.begin();
    for line in [&measured("0.1"), &measured("0.3")] {
        parser.line(line).unwrap();
    }
    assert_eq!(parser.line("nonsense").unwrap_err().line, 3);
    assert_eq!(parser.repeated(), Some(Repeated { count: 1, line: 2 }));
    let places: Vec<Place> = [1, 2, 3, 5].map(|line| parser.files().place(line)).into();
    let graph = parser.finish();
    assert_eq!(graph.measurements.iter().map(|m| m.line).collect::<Vec<_>>(), [1, 2, 3, 5]);
    let at = |file, line| Place { file, line };
    assert_eq!(places, [at(0, 1), at(0, 2), at(0, 3), at(1, 2)]);
}

/// Two files, read one after the other; what the second is refused for, and the poses that both name.
fn two_files(first: &[String], second: &[String]) -> (Vec<G2oError>, Option<Shared>) {
    let mut parser = Parser::default();
    parser.begin();
    first.iter().for_each(|line| parser.line(line).unwrap());
    parser.begin();
    let errors = second.iter().filter_map(|line| parser.line(line).err()).collect();
    (errors, parser.shared(0))
}

proptest! {
    #[test]
    fn two_robots_that_number_alike_are_never_taken_for_one(n in 2_u64..30, m in 2_u64..30, with_poses: bool, turned: bool) {
        let chain = |n: u64, y: f64| -> Vec<String> {
            let pose = |k| format!("VERTEX_SE2 {k} {k} {y} 0");
            let step = |k| {
                let [i, j] = if turned && y > 0.0 { [k + 1, k] } else { [k, k + 1] };
                format!("EDGE_SE2 {i} {j} 1 {y} 0 1 0 0 1 0 1")
            };
            (0..n).filter(|_| with_poses).map(pose).chain((0..n - 1).map(step)).collect()
        };
        let (errors, shared) = two_files(&chain(n, 0.0), &chain(m, 1.0));
        let both = n.min(m);
        let lines = both - 1 + if with_poses { both } else { 0 };
        prop_assert_eq!(errors.len() as u64, lines);
        prop_assert!(errors.iter().all(|e| matches!(e.what, Fault::Otherwise(..))), "{:?}", errors);
        prop_assert_eq!(shared.map(|s| (s.first, s.last >= both - 1)), Some((0, true)));
        // The same to the bit is the same robot, and no news.
        prop_assert_eq!(two_files(&chain(n, 0.0), &chain(n, 0.0)), (vec![], None));
        // With a letter each, they differ.
        let letter = |line: &String| {
            let words = line.split(' ').enumerate();
            let is_id = |k: usize| k == 1 || k == 2 && line.starts_with('E');
            let named = |word: &str| (word.parse::<u64>().unwrap() | u64::from(b'b') << 56).to_string();
            words.map(|(k, word)| if is_id(k) { named(word) } else { word.into() }).collect::<Vec<_>>().join(" ")
        };
        let lettered: Vec<String> = chain(m, 1.0).iter().map(letter).collect();
        prop_assert_eq!(two_files(&chain(n, 0.0), &lettered), (vec![], None));
        // Closures of one robot in a file of their own.
        let closure = format!("EDGE_SE2 0 {} 1 0 0 1 0 0 1 0 1", n + m);
        prop_assert_eq!(two_files(&chain(n + m, 0.0), &[closure]).0, vec![]);
    }
}

#[test]
fn graphs_beyond_the_limits_are_refused() {
    let mut parser = Parser::default();
    for k in 0..POSES_MAX {
        parser.line(&format!("VERTEX_SE2 {k} 0 0 0")).unwrap();
    }
    let beyond = format!("VERTEX_SE2 {POSES_MAX} 0 0 0");
    assert_eq!(parser.line(&beyond).unwrap_err().what, Fault::Poses);
    let edge = format!("EDGE_SE2 0 {POSES_MAX} 0 0 0 1 0 0 1 0 1");
    assert_eq!(parser.line(&edge).unwrap_err().what, Fault::Poses);
    let mut parser = Parser::default();
    for _ in 0..MEASUREMENTS_MAX {
        parser.line("EDGE_SE2 0 1 0 0 0 1 0 0 1 0 1").unwrap();
    }
    assert_eq!(parser.line("EDGE_SE2 0 1 0 0 0 1 0 0 1 0 1").unwrap_err().what, Fault::Measurements);
}

#[test]
fn parts_are_solved_by_themselves_and_said() {
    let (_, mut graph) = ring(2, 6, (0.1, 0.1));
    let (_, other) = ring(3, 4, (0.1, 0.1));
    graph.measurements.extend(other.measurements.into_iter().map(|m| Measurement { i: m.i + 10, j: m.j + 10, ..m }));
    graph.poses.extend((10..14).chain([99]).map(|k| (k, None)));
    let start = vec![Se3::identity(); graph.poses.len()];
    assert_eq!(graph.solve(&start, 10).unwrap_err(), PoseGraphError::Parts(3));
    assert_eq!(graph.start(Start::Relaxed, 10), Err(PoseGraphError::Parts(3)));
    assert_eq!(graph.start(Start::Given, 10), Err(PoseGraphError::NoValue(0)));
    let parts = graph.parts();
    let sizes: Vec<usize> = parts.iter().map(|part| part.poses.len()).collect();
    assert_eq!(sizes, [6, 4, 1]);
    for part in &parts {
        let solved = part.solve(&part.start(Start::Relaxed, 10).unwrap(), 20).unwrap();
        assert!(solved.solution.converged && solved.values.len() == part.poses.len());
    }
}

#[test]
fn kimera_tables_are_read_by_their_columns() {
    let head = "robot_src,pose_src,robot_dst,pose_dst,qx,qy,qz,qw,tx,ty,tz,kappa,tau,is_known_inlier,weight";
    let read = |rows: &[&str]| {
        let mut importer = Importer::default();
        importer.line(head)?;
        rows.iter().try_for_each(|row| importer.line(row))?;
        Ok::<_, KimeraError>(importer.finish())
    };
    let row = "0,0,1,7,0,0,0,1,1,2,3,10000,100,0,0.5";
    let (graph, recorded) = read(&[row, row]).unwrap();
    assert_eq!((graph.measurements.len(), recorded.len()), (1, 1));
    let m = &graph.measurements[0];
    assert_eq!((m.i, m.j), (u64::from(b'a') << 56, (u64::from(b'b') << 56) | 7));
    assert!(graph.is_isotropic() && recorded[0].weight == 0.5 && !recorded[0].known);
    let fault = |row: &str| read(&[row]).unwrap_err();
    assert_eq!(fault("0,0,1").what, KimeraFault::Fields { want: 15, got: 3 });
    assert_eq!(fault(&row.replace("10000", "-1")).line, 2);
    assert!(matches!(fault(&row.replace("0,0,1,7", "0,0,26,7")).what, KimeraFault::Number { column: "robot_dst", .. }));
    assert!(matches!(fault(&row.replace("0,0,0,1", "0,0,0,0")).what, KimeraFault::Number { column: "qw", .. }));
    assert_eq!(fault(&row.replace("0,0,1,7", "0,0,0,0")).what, KimeraFault::SelfLoop);
    assert!(read(&[&row.replace(",1,2,3,", ",1e12,2,3,")]).is_ok());
    let far = fault(&row.replace(",1,2,3,", ",1.1e12,2,3,")).to_string();
    assert_eq!(far, "line 2: column tx: \"1.1e12\" is not a length of up to 1e12 m");
    assert_eq!(Importer::default().line("a,b").unwrap_err().what, KimeraFault::Column("robot_src"));
}

#[test]
fn trajectories_are_written_as_tum() {
    let pose = Se3::new(So3::identity(), Vector3::new(1.0, 2.5, -3.0));
    assert_eq!(write_tum([(&7, &pose)]), "7 1 2.5 -3 0 0 0 1\n");
    // A robot's letter is none of the time.
    assert_eq!(write_tum([(&((u64::from(b'b') << 56) | 7), &pose)]), "7 1 2.5 -3 0 0 0 1\n");
}

/// A ring of poses c0 to c4, and c5 and c6 that hang on it by much too little.
fn ill() -> PoseGraph {
    let name = |k: u64| (u64::from(b'c') << 56) | k;
    let edge = |i: u64, j: u64, x: f64, w: &str| {
        let upper = format!("{w} 0 0 0 0 0 {w} 0 0 0 0 {w} 0 0 0 {w} 0 0 {w} 0 {w}");
        format!("EDGE_SE3:QUAT {} {} {x} 0 0 0 0 0 1 {upper}\n", name(i), name(j))
    };
    let ring = (0..5).map(|k| edge(k, (k + 1) % 5, if k < 4 { 1.0 } else { -3.9 }, "100"));
    let text: String = ring.chain([edge(4, 5, 1.0, "1e-11"), edge(5, 6, 1.0, "1e12")]).collect();
    parsed(&text).unwrap()
}

#[test]
fn what_is_not_determined_or_overflows_is_told_by_pose_and_line() {
    let graph = ill();
    let start = vec![Se3::identity(); 7];
    let error = graph.solve(&start, 10).unwrap_err();
    let PoseGraphError::At { line: 6, what: MeasurementFault::Undetermined { pose, i, j, least, most } } = &error
    else {
        panic!("{error}")
    };
    assert_eq!([pose, i, j].map(|id| id & 0xff), [5, 4, 5]);
    assert!((least / 1e-11 - 1.0).abs() < 1e-3 && *most == 1e12);
    assert!(error.to_string().starts_with(&format!("line 6: pose {pose} (c5) is not determined: ")), "{error}");
    let with = |change: &dyn Fn(&mut Measurement)| {
        let mut graph = ill();
        change(&mut graph.measurements[5]);
        graph.solve(&start, 10).unwrap_err()
    };
    // Less than a covariance can hold.
    let weaker = with(&|m| m.information *= 1e-9);
    assert_eq!(weaker, PoseGraphError::At { line: 6, what: MeasurementFault::Information });
    for length in [f64::INFINITY, 1e200] {
        let far = with(&|m| (m.t_i_j.translation.x, m.information) = (length, Matrix6::identity()));
        assert!(matches!(far, PoseGraphError::At { line: 6, what: MeasurementFault::Overflow { .. } }), "{far}");
    }
}

#[test]
fn a_part_lies_where_its_file_puts_its_origin() {
    let there = Se3::exp(&uniform(&mut ChaCha8Rng::seed_from_u64(1), 1.0, 5.0));
    let (truth, mut graph) = ring(9, 6, (0.1, 0.1));
    let mut part: BTreeMap<u64, Se3> = (0..).zip(truth.iter().copied()).collect();
    // Of no value: at the origin.
    assert_eq!(graph.place(&mut part), Some(0));
    assert_eq!(part[&0], Se3::identity());
    graph.poses.insert(0, Some(there));
    graph.poses.insert(4, Some(there));
    let relative = part[&2].inverse() * part[&5];
    for (fixed, origin) in [(vec![], 0), (vec![4], 4), (vec![4, 0, 70], 0)] {
        graph.fixed = fixed.into_iter().collect();
        assert_eq!(graph.place(&mut part), Some(origin));
        assert_eq!(part[&origin], there);
        assert!(relative.local(&(part[&2].inverse() * part[&5])).norm() < 1e-12);
    }
    assert_eq!(graph.place(&mut BTreeMap::new()), None);
    let text = format!("{}VERTEX_SE3:QUAT 77 0 0 0 0 0 0 1\nFIX 77 3\n", write(&graph));
    let read = parsed(&text).unwrap();
    assert_eq!(read.fixed, BTreeSet::from([0, 3, 4, 77]));
    let parts: Vec<BTreeSet<u64>> = read.parts().into_iter().map(|part| part.fixed).collect();
    assert_eq!(parts, [BTreeSet::from([0, 3, 4]), BTreeSet::from([77])]);
}

#[test]
fn covariances_relative_to_any_pose_are_those_of_relations() {
    let (_, graph) = ring(12, 9, (0.2, 0.1));
    let solved = graph.solve(&graph.start(Start::Relaxed, 100).unwrap(), 100).unwrap();
    assert_eq!(solved.marginals_from(0), solved.marginals());
    // Of the relation between two poses, seen from either end.
    let of = |origin: usize, id: u64| solved.marginals_from(origin).into_iter().find(|(k, _)| *k == id).unwrap().1;
    let t_3_7 = solved.values[3].inverse() * solved.values[7];
    let forth = crate::geometry::PoseWithCovariance { pose: t_3_7, covariance: of(3, 7) };
    let (back, want) = (of(7, 3), forth.inverse().covariance);
    assert!((back.matrix() - want.matrix()).amax() < 1e-9 * want.matrix().amax());
}

#[test]
fn robots_that_find_no_place_are_told_with_the_reason() {
    let config = crate::config::EstimateConfig::default();
    let (_, graph) = ring(13, 8, (0.1, 0.1));
    assert_eq!(graph.unsolved(&graph.solve_robustly(&config)), []);
    let graph = ill();
    let solved = graph.solve_robustly(&config);
    assert!(solved.components.is_empty() && !solved.map.converged);
    let unsolved = graph.unsolved(&solved);
    let [part] = &unsolved[..] else { panic!("{unsolved:?}") };
    assert_eq!((part.first, part.poses), (graph.measurements[0].i, 7));
    let Some(PoseGraphError::At { line: 6, what: MeasurementFault::Undetermined { .. } }) = part.why else {
        panic!("{:?}", part.why)
    };
}
