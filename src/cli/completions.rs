//! `foreframe completions`

use clap::CommandFactory as _;
use clap_complete::Shell;

use super::error::CliError;
use super::process::print_line;

/// Print the completions of commands and options for a shell.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe completions bash > ~/.local/share/bash-completion/completions/foreframe
  foreframe completions zsh > ~/.zfunc/_foreframe")]
pub(super) struct CompletionsArgs {
    /// The shell
    shell: Shell,
}

pub(super) fn run(args: &CompletionsArgs) -> Result<(), CliError> {
    // Into memory first: it would panic if standard output were closed.
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut super::Cli::command(), "foreframe", &mut script);
    print_line(String::from_utf8_lossy(&script).trim_end())
}
