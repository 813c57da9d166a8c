//! Time of a camera frame, of a whole simulation step and of a new trial, on one core.
#![allow(clippy::unwrap_used, missing_docs)]

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use foreframe_core::types::Seed;
use foreframe_sim::{Scenario, World, WorldConfig};

fn camera(criterion: &mut Criterion) {
    let config = WorldConfig::default();
    let mut group = criterion.benchmark_group("camera");
    group.throughput(Throughput::Elements(1));
    for scenario in Scenario::ALL {
        let world = World::new(scenario, &config, Seed(1), 0).unwrap();
        group.bench_function(format!("picture 64×64 {scenario}"), |bencher| {
            bencher.iter(|| black_box(world.render().unwrap()));
        });
    }
    group.finish();
}

/// Physics, policy and a frame from a new position in every step.
fn step(criterion: &mut Criterion) {
    let config = WorldConfig {
        max_duration_s: 3600.0,
        ..WorldConfig::default()
    };
    let mut group = criterion.benchmark_group("world");
    group.throughput(Throughput::Elements(1));
    let mut world = World::new(Scenario::MovingObserver, &config, Seed(1), 0).unwrap();
    group.bench_function("step with a moving camera", |bencher| {
        bencher.iter(|| {
            let action = world.policy_action();
            match world.step(&action) {
                Ok(step) if !step.truncated => {}
                _ => world = World::new(Scenario::MovingObserver, &config, Seed(1), 0).unwrap(),
            }
        });
    });
    group.bench_function("new trial", |bencher| {
        bencher.iter(|| black_box(World::new(Scenario::StaticObserver, &config, Seed(1), 0).unwrap()));
    });
    group.finish();
}

criterion_group!(benches, camera, step);
criterion_main!(benches);
