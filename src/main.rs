//! The `foreframe` program.

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    // Or candle counts the cores before every single product, which takes longer than a small product does.
    set_default_env("RAYON_NUM_THREADS", cores);
    // Or candle splits what is large over threads of the whole process, behind one lock: predictions would wait for a training.
    // Our own threads share the work better: a training takes half the time.
    set_default_env("CANDLE_NUM_THREADS", 1);
    foreframe::cli::main()
}

/// Sets an environment variable that is not set yet. Candle reads these from the environment only.
fn set_default_env(variable: &str, threads: usize) {
    if std::env::var_os(variable).is_none() {
        #[expect(unsafe_code, reason = "no safe call changes the environment")]
        // SAFETY: no other thread runs yet that could read the environment meanwhile.
        unsafe {
            std::env::set_var(variable, threads.to_string());
        }
    }
}
