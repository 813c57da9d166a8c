//! Bad input through the real entry points: every file of `tests/corpus`, and mutations of each. Nothing panics, every answer
//! is the contract's, and memory stays within the limit given to [`within_memory`]. A binary of its own, since its allocator counts.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

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

/// What is allocated is counted for the whole process, so one test runs at a time.
static EXCLUSIVE: Mutex<()> = Mutex::new(());

fn exclusive() -> MutexGuard<'static, ()> {
    EXCLUSIVE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Runs what shall take at most that many bytes of memory at a time, beyond what is held already.
fn within_memory<T>(limit_bytes: usize, what: &str, work: impl FnOnce() -> T) -> T {
    ALLOCATOR.reset_peak_usage();
    let before = ALLOCATOR.current_usage();
    let result = work();
    let taken = ALLOCATOR.peak_usage().saturating_sub(before);
    assert!(
        taken <= limit_bytes,
        "{what}: {taken} bytes were allocated at a time, over {limit_bytes}"
    );
    result
}

#[test]
fn the_memory_check_fails_above_its_limit() {
    let _alone = exclusive();
    let greedy = || within_memory(1 << 20, "a vector", || std::hint::black_box(vec![0u8; 2 << 20]));
    assert!(std::panic::catch_unwind(greedy).is_err());
}
