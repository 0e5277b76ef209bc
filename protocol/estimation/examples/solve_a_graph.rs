//! Solves a small pose graph in the g2o format: the poses, how far they fit, and how sure each is.
//!
//! `cargo run --release -p merganser-estimation --example solve_a_graph [FILE.g2o]`
#![allow(clippy::print_stdout, reason = "an example shows what it does")]

use merganser_estimation::posegraph::g2o::Parser;
use merganser_estimation::posegraph::solve::Start;

/// A square of four metres, driven once around in the plane; the last edge closes it.
const SQUARE: &str = "\
VERTEX_SE2 0 0 0 0
VERTEX_SE2 1 4 0 1.5708
VERTEX_SE2 2 4 4 3.1416
VERTEX_SE2 3 0 4 -1.5708
EDGE_SE2 0 1 4.05 0.02 1.58 100 0 0 100 0 400
EDGE_SE2 1 2 3.98 0.01 1.56 100 0 0 100 0 400
EDGE_SE2 2 3 4.02 -0.03 1.57 100 0 0 100 0 400
EDGE_SE2 3 0 4.00 0.00 1.57 100 0 0 100 0 400
";
/// Steps at most.
const ITERATIONS_MAX: usize = 100;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let text = std::env::args().nth(1).map_or_else(|| Ok(SQUARE.to_owned()), std::fs::read_to_string)?;
    let mut parser = Parser::default();
    for line in text.lines() {
        parser.line(line)?;
    }
    // Unconnected parts are graphs of their own.
    for graph in parser.finish().parts() {
        let start = graph.start(Start::Relaxed, ITERATIONS_MAX)?;
        let solved = graph.solve(&start, ITERATIONS_MAX)?;
        println!("{} poses, {} measurements", solved.ids.len(), graph.measurements.len());
        for ((id, covariance), t_world_pose) in solved.marginals().into_iter().zip(&solved.values).take(10) {
            let [at, sigmas] = [t_world_pose.translation, covariance.sigmas().fixed_rows::<3>(0).into_owned()];
            println!(
                "{id:>4}: at ({:.3}, {:.3}, {:.3}) m, standard deviations {:.3?} m",
                at.x,
                at.y,
                at.z,
                sigmas.as_slice()
            );
        }
    }
    Ok(())
}
