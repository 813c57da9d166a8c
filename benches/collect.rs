//! Time to collect trials of `static-observer` at 64×64 px on all cores, and to open the data set.

#![allow(clippy::unwrap_used, missing_docs)]

use std::path::Path;
use std::sync::atomic::AtomicBool;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use foreframe_core::types::Seed;
use foreframe_data::dataset::{CollectConfig, Dataset, DatasetInfo, collect};
use foreframe_sim::Scenario;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

const TRIALS: u64 = 40;

fn collect_trials(out: &Path) -> DatasetInfo {
    let config = CollectConfig {
        trials_per_shard: 10,
        ..CollectConfig::new(Scenario::StaticObserver, TRIALS, Seed(1), out)
    };
    collect(&config, &|_| {}, &AtomicBool::new(false)).unwrap()
}

fn benches(criterion: &mut Criterion) {
    let directory = tempfile::tempdir().unwrap();
    let set = directory.path().join("set");
    let frames = collect_trials(&set).frame_count as u64;
    let mut group = criterion.benchmark_group("dataset");
    group.sample_size(10).throughput(Throughput::Elements(frames));
    group.bench_function("collect", |bencher| {
        bencher.iter_with_setup(
            || tempfile::tempdir().unwrap(),
            |directory| {
                collect_trials(&directory.path().join("set"));
                directory
            },
        );
    });
    group.bench_function("open", |bencher| bencher.iter(|| Dataset::open(&set).unwrap()));
    group.finish();
}

criterion_group!(dataset, benches);
criterion_main!(dataset);
