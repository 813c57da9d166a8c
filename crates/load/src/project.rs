//! Where the project and its program are.

use std::path::{Path, PathBuf};

/// The root of the repository.
pub(crate) fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}

/// The program, built beside this one.
pub(crate) fn program() -> PathBuf {
    let program = std::env::current_exe().unwrap().with_file_name("foreframe");
    assert!(
        program.is_file(),
        "{} is missing; build it with `cargo build --release`",
        program.display()
    );
    program
}
