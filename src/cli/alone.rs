//! candle splits what is large over threads that the whole process shares, behind one lock: predictions would wait for a
//! training, and each for threads that spin. Our own threads share the work better: a training takes half the time.

/// How many threads share what is large; candle reads it from the environment only.
const THREADS: &str = "CANDLE_NUM_THREADS";

/// Has every thread compute alone: starts this process anew, as the same process, with that said, unless something is.
/// Elsewhere than on Unix it is for the user to say.
pub(super) fn compute_alone() {
    #[cfg(unix)]
    if std::env::var_os(THREADS).is_none()
        && let Ok(program) = std::env::current_exe()
    {
        use std::os::unix::process::CommandExt as _;
        // It returns only where it fails, and then the program is right all the same, but slower.
        let _ = std::process::Command::new(program)
            .args(std::env::args_os().skip(1))
            .env(THREADS, "1")
            .exec();
    }
}
