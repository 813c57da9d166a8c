//! Malformed input through the real entry points: every file of `tests/corpus`, and mutations of each. Nothing panics, every
//! response is documented, and memory stays within the limit given to [`within_memory`]. This is a separate binary because
//! its allocator counts.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::result_large_err,
    missing_docs
)]

mod bags;
mod bodies;
mod corpus;
#[path = "../it/fixtures.rs"]
#[allow(dead_code)]
mod fixtures;
mod images;
mod messages;
mod mutation;
#[path = "../it/service.rs"]
#[allow(dead_code)]
mod service;
mod test_service;

use std::sync::{Mutex, MutexGuard, PoisonError};

use peak_alloc::PeakAlloc;

#[global_allocator]
static ALLOCATOR: PeakAlloc = PeakAlloc;

/// Memory is counted for the whole process, so one test runs at a time.
static EXCLUSIVE: Mutex<()> = Mutex::new(());

fn exclusive() -> MutexGuard<'static, ()> {
    EXCLUSIVE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Runs `work`, which may allocate at most `limit_bytes` beyond what is already allocated.
fn within_memory<T>(limit_bytes: usize, what: &str, work: impl FnOnce() -> T) -> T {
    ALLOCATOR.reset_peak_usage();
    let before = ALLOCATOR.current_usage();
    let result = work();
    let taken = ALLOCATOR.peak_usage().saturating_sub(before);
    assert!(
        taken <= limit_bytes,
        "{what}: {taken} bytes were allocated; the limit is {limit_bytes}"
    );
    result
}

#[test]
fn property_tests_have_a_fixed_seed() {
    let seed = proptest::test_runner::Config::default().rng_seed;
    let is_fixed = matches!(seed, proptest::test_runner::RngSeed::Fixed(_));
    assert!(
        is_fixed,
        "PROPTEST_RNG_SEED is not set; cargo reads it from .cargo/config.toml when it runs in the repository"
    );
}

#[test]
fn the_memory_check_fails_above_its_limit() {
    let _alone = exclusive();
    let greedy = || within_memory(1 << 20, "a vector", || std::hint::black_box(vec![0u8; 2 << 20]));
    assert!(std::panic::catch_unwind(greedy).is_err());
}
