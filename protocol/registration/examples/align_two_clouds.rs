//! Aligns two clouds of matched points, of which seven in ten are matched wrongly, and says how sure it is.
//!
//! `cargo run --release -p merganser-registration --example align_two_clouds`
#![allow(clippy::print_stdout, reason = "an example shows what it does")]

use merganser_geometry::sampling::{normal, rng, uniform};
use merganser_geometry::{Se3, So3};
use merganser_registration::align::{Problem, SolverConfig, align};
use nalgebra::Vector3;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut rng = rng(1);
    let t_target_source = Se3::new(So3::exp(&Vector3::new(0.1, -0.2, 1.0)), Vector3::new(3.0, -1.0, 0.5));
    let mut anywhere = || Vector3::from_fn(|_, _| uniform(&mut rng, -5.0, 5.0));
    let source: Vec<Vector3<f64>> = (0..200).map(|_| anywhere()).collect();
    let mut target: Vec<Vector3<f64>> = source.iter().map(|p| t_target_source * *p).collect();
    target[60..].fill_with(|| t_target_source * anywhere());
    target.iter_mut().for_each(|p| *p += Vector3::from_fn(|_, _| 0.02 * normal(&mut rng)));

    let [source, target] = [source, target].map(|points| points.into_iter().map(Into::into).collect::<Vec<[f64; 3]>>());
    let problem = Problem { source: &source, target: &target, ..Problem::default() };
    let config = SolverConfig { sigma_max: 0.1, ..SolverConfig::default() };
    match align(&problem, &config)? {
        Ok(found) => {
            let estimate = found.t_target_source.metric().ok_or("no rigid motion was found")?;
            let error = t_target_source.local(&estimate.pose);
            println!("{:.1} of {} matches support it, at a noise of {:.3} m", found.support, source.len(), found.sigma);
            println!("as good by chance: once in 10^{:.0} problems", -found.log10_nfa);
            println!("off by {:.4} m and {:.4} rad", error.fixed_rows::<3>(0).norm(), error.fixed_rows::<3>(3).norm());
            println!("standard deviations (m, rad): {:.4?}", estimate.covariance.sigmas().as_slice());
        }
        Err(refusal) => println!("no alignment: {refusal}"),
    }
    Ok(())
}
