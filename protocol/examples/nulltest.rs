#![allow(clippy::print_stdout, clippy::unwrap_used)]
use merganser_protocol::align::{Model, Problem, Refusal, SolverConfig, align};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let n: usize = a[1].parse().unwrap();
    let trials: u64 = a[2].parse().unwrap();
    let sigma_max: f64 = a[3].parse().unwrap();
    let sim = a.len() > 4;
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut u = move || (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
    let mut v = vec![];
    let t0 = std::time::Instant::now();
    for seed in 0..trials {
        let s: Vec<[f64; 3]> = (0..n).map(|_| [u(), u(), u()]).collect();
        let t: Vec<[f64; 3]> = (0..n).map(|_| [u(), u(), u()]).collect();
        let model = if sim { Model::Similarity { scale_min: 0.4, scale_max: 2.5 } } else { Model::Rigid };
        let c = SolverConfig { sigma_max, seed, model, log10_nfa_max: -30.0, support_min: 4.0, ..Default::default() };
        if let Err(Refusal::NoConsensus { log10_nfa, support }) =
            align(&Problem { source: &s, target: &t, scores: None }, &c).unwrap()
        {
            v.push((log10_nfa, support));
        }
    }
    v.sort_by(|a, b| a.0.total_cmp(&b.0));
    print!(
        "n={n} smax={sigma_max} sim={sim} {} of {trials}, {:.2} ms each: ",
        v.len(),
        t0.elapsed().as_secs_f64() * 1e3 / trials as f64
    );
    for q in [0.0, 0.001, 0.01, 0.1, 0.5] {
        let k = (q * v.len() as f64) as usize;
        print!("  q{q}: {:.2}/{:.1}", v[k].0, v[k].1);
    }
    println!();
}
