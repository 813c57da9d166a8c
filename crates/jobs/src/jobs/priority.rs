//! On Linux, jobs and pictures run at lower priority, so that they do not delay predictions. There, each thread has its own priority,
//! and the threads that it starts inherit it. On other systems nothing changes.

/// Added to a thread's niceness: it then gets about a tenth of a core that another thread also needs.
#[cfg(target_os = "linux")]
const NICENESS: i32 = 10;

/// Lowers the priority of the calling thread permanently.
pub fn lower() {
    #[cfg(target_os = "linux")]
    if let Err(error) = rustix::process::nice(NICENESS) {
        tracing::warn!(%error, "could not lower the priority of a thread");
    }
}
