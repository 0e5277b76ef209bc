//! What a fuzz target of `agent/recording/fuzz` does with bytes, shared with the test `readers`: bytes as a graph and as
//! tables. A reader may refuse a line, by its number, and takes nothing of it then; what it takes is finite, bounded, and
//! written and read alike.
#![allow(
    dead_code,
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a failed unwrap in a test is its report"
)]

use merganser_estimation::posegraph::g2o::{self, LENGTH_MAX, LINE_MAX};
use merganser_estimation::posegraph::kimera::Importer;
use merganser_estimation::posegraph::marginals::{self, Reader};
use merganser_estimation::posegraph::{MEASUREMENTS_MAX, POSES_MAX, PoseGraph};

/// The lines as the program hands them over: of too long ones the beginning, and of bytes that are no text marks.
fn lines(bytes: &[u8]) -> impl Iterator<Item = String> {
    bytes.split(|byte| *byte == b'\n').map(|line| String::from_utf8_lossy(&line[..line.len().min(2 * LINE_MAX)]).into())
}

pub fn graphs(bytes: &[u8]) {
    g2o(bytes);
    kimera(bytes);
    table(bytes);
}

pub fn g2o(bytes: &[u8]) {
    let mut parser = g2o::Parser::default();
    for (index, line) in lines(bytes).enumerate() {
        let before = (index < 50).then(|| parser.clone().finish());
        if let Err(error) = parser.line(&line) {
            assert_eq!(error.line, index + 1);
            is_one_line(&error.to_string(), "line ");
            assert!(before.is_none_or(|before| before == parser.clone().finish()), "nothing of a bad line is taken");
        }
    }
    let graph = parser.finish();
    is_sound(&graph);
    let mut again = g2o::Parser::default();
    for line in g2o::write(&graph).lines() {
        again.line(line).unwrap();
    }
    let again = again.finish();
    assert_eq!(again.measurements.len(), graph.measurements.len());
    assert_eq!(again.planar, graph.planar || again.poses.is_empty() && again.measurements.is_empty() && again.planar);
    for (a, b) in again.measurements.iter().zip(&graph.measurements) {
        assert_eq!((a.i, a.j), (b.i, b.j));
        assert!(a.t_i_j.rotation.log().metric_distance(&b.t_i_j.rotation.log()) < 1e-6, "{a:?} {b:?}");
        let size = b.t_i_j.translation.amax().max(1.0);
        assert!((a.t_i_j.translation - b.t_i_j.translation).amax() <= 1e-9 * size, "{a:?} {b:?}");
    }
}

fn is_sound(graph: &PoseGraph) {
    assert!(graph.poses.len() <= POSES_MAX && graph.measurements.len() <= MEASUREMENTS_MAX);
    for value in graph.poses.values().flatten().chain(graph.measurements.iter().map(|m| &m.t_i_j)) {
        assert!(value.translation.iter().all(|c| c.abs() <= LENGTH_MAX), "{value:?}");
        assert!(value.rotation.xyzw().iter().all(|c| c.is_finite()), "{value:?}");
    }
    for m in &graph.measurements {
        assert!(m.i != m.j && graph.poses.contains_key(&m.i) && graph.poses.contains_key(&m.j));
        assert!(m.information.iter().all(|x| x.is_finite()) && m.kappa > 0.0 && m.tau > 0.0, "{m:?}");
    }
    let parts = graph.parts();
    assert_eq!(parts.iter().map(|part| part.poses.len()).sum::<usize>(), graph.poses.len());
}

pub fn kimera(bytes: &[u8]) {
    let mut importer = Importer::default();
    for (index, line) in lines(bytes).enumerate() {
        if let Err(error) = importer.line(&line) {
            assert_eq!(error.line, index + 1);
            is_one_line(&error.to_string(), "line ");
        }
    }
    let (graph, recorded) = importer.finish();
    is_sound(&graph);
    assert_eq!(recorded.len(), graph.measurements.len());
}

pub fn table(bytes: &[u8]) {
    let mut reader = Reader::default();
    for (index, line) in lines(bytes).enumerate() {
        if let Err(error) = reader.line(&line) {
            assert_eq!(error.line, index + 1);
            is_one_line(&error.to_string(), "line ");
        }
    }
    let rows = reader.finish();
    let mut again = Reader::default();
    for line in marginals::write(rows.values()).lines() {
        again.line(line).unwrap();
    }
    let again = again.finish();
    assert_eq!(again.len(), rows.len());
    for (a, b) in again.values().zip(rows.values()) {
        assert_eq!((a.id, a.origin), (b.id, b.origin));
        assert_eq!(a.estimate.covariance.matrix(), b.estimate.covariance.matrix());
        assert_eq!(a.estimate.pose.translation, b.estimate.pose.translation);
    }
}

fn is_one_line(told: &str, begins: &str) {
    assert!(told.starts_with(begins) && !told.contains('\n') && told.len() > begins.len() + 12, "{told:?}");
}
