//! The `foreframe` program.

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// How many threads share a matrix product.
const PRODUCT_THREADS: &str = "RAYON_NUM_THREADS";

fn main() -> ExitCode {
    if std::env::var_os(PRODUCT_THREADS).is_none() {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        // Unless told, candle asks the system before every single product (0.11 reads /proc/cpuinfo), which takes longer than
        // a small product does.
        #[expect(unsafe_code, reason = "the process's environment can be changed by no safe call")]
        // SAFETY: no other thread runs yet, so none can read the environment meanwhile.
        unsafe {
            std::env::set_var(PRODUCT_THREADS, cores.to_string());
        }
    }
    foreframe::cli::main()
}
