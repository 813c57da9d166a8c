//! The threads of jobs stand back: where all cores are wanted, serving goes first. On Linux a thread has a priority of its
//! own, which those that it starts inherit; elsewhere nothing changes.

/// Added to a thread's niceness: it then gets about a tenth of a core that another thread wants too.
#[cfg(target_os = "linux")]
const NICENESS: i32 = 10;

/// Lowers the priority of the thread that calls, for good.
pub(super) fn lower() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::nice(NICENESS) {
        tracing::warn!(%error, "a job's thread keeps the priority of those that serve");
    }
}
