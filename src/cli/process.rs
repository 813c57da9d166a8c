//! The process as its user sees it: how it was started, and what it prints.

use std::fmt::Display;
use std::io::{ErrorKind, Write as _};

use super::error::CliError;
use super::next_step::shell_word;
use foreframe_core::error_text::printable;

/// Writes a line to standard output.
pub(super) fn print_line(line: impl Display) -> Result<(), CliError> {
    let written = writeln!(std::io::stdout(), "{}", printable(&line.to_string()));
    written.map_err(|error| match error.kind() {
        ErrorKind::BrokenPipe => CliError::OutputClosed,
        _ => CliError::Failed(format!("could not write to standard output: {error}")),
    })
}

/// The command line as it was given; reports and manifests record it.
pub(super) fn command_line() -> String {
    std::env::args()
        .enumerate()
        .map(|(index, argument)| match index {
            0 => "foreframe".to_owned(),
            _ => shell_word(&argument),
        })
        .collect::<Vec<_>>()
        .join(" ")
}
