//! Time of the frame-level consensus, by number of alignments and what they are, in SE(3) and SIM(3).
#![allow(missing_docs)]

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use merganser_protocol::estimate::frames::world::{Draw, World};
use merganser_protocol::estimate::frames::{FrameConsensusConfig, align_frames, align_frames_sim};
use std::hint::black_box;

fn frames(c: &mut Criterion) {
    let mut group = c.benchmark_group("frames");
    group.sample_size(10);
    let config = FrameConsensusConfig::default();
    for (name, real, aliased, random) in [
        ("4_of_20", 4, 0, 16),
        ("4_v_4_of_20", 4, 4, 12),
        ("10_of_50", 10, 0, 40),
        ("30_of_100", 30, 0, 70),
        ("all_of_50", 50, 0, 0),
        ("none_of_100", 0, 0, 100),
    ] {
        let world = World::new(1, Draw { real, aliased, random, under_reported: 1.0 });
        group.bench_function(BenchmarkId::new("se3", name), |b| {
            b.iter(|| black_box(align_frames(&world.alpha, &world.beta, &world.alignments, &config)));
        });
        let world = world.with_unknown_scale(1);
        group.bench_function(BenchmarkId::new("sim3", name), |b| {
            b.iter(|| black_box(align_frames_sim(&world.alpha, &world.beta, &world.alignments, &config)));
        });
    }
    group.finish();
}

criterion_group!(benches, frames);
criterion_main!(benches);
