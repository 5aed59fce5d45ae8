//! `completions`, `man`: shell completions and manual pages, generated from the help.

use std::path::PathBuf;

use anyhow::Context;
use clap::{Command, CommandFactory, ValueEnum};
use clap_complete::Shell;

use crate::output;

/// Print the completion script of a shell.
///
/// bash: cloudroidctl completions bash > ~/.local/share/bash-completion/completions/cloudroidctl. zsh: into
/// _cloudroidctl in a directory of fpath. fish: into ~/.config/fish/completions/cloudroidctl.fish. The Debian package
/// and make install install all three.
#[derive(Debug, clap::Args)]
pub struct CompletionsArgs {
    /// Shell to complete in.
    #[arg(value_enum)]
    shell: CompletionShell,
}

/// Supported shells.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum CompletionShell {
    Bash,
    Zsh,
    Fish,
}

impl From<CompletionShell> for Shell {
    fn from(named: CompletionShell) -> Shell {
        match named {
            CompletionShell::Bash => Shell::Bash,
            CompletionShell::Zsh => Shell::Zsh,
            CompletionShell::Fish => Shell::Fish,
        }
    }
}

impl CompletionsArgs {
    /// Prints the script.
    pub fn run<A: CommandFactory>(self) -> anyhow::Result<()> {
        let mut script = Vec::new();
        clap_complete::generate(Shell::from(self.shell), &mut A::command(), "cloudroidctl", &mut script);
        output::raw(&script)
    }
}

/// Print the manual page of cloudroidctl, or write the pages of all commands to a directory.
///
/// man -l <(cloudroidctl man) shows it. The Debian package and make install install them: man cloudroidctl-push.
#[derive(Debug, clap::Args)]
pub struct ManArgs {
    /// Output directory for the pages of all commands, such as /usr/local/share/man/man1.
    directory: Option<PathBuf>,
}

impl ManArgs {
    /// Prints the page, or writes all pages.
    pub fn run<A: CommandFactory>(self) -> anyhow::Result<()> {
        let command = A::command();
        let Some(directory) = self.directory else {
            let mut page = Vec::new();
            clap_mangen::Man::new(command).render(&mut page)?;
            return output::raw(&page);
        };
        let failed = || format!("cannot write the manual pages to {}", directory.display());
        std::fs::create_dir_all(&directory).with_context(failed)?;
        clap_mangen::generate_to(remove_help_subcommands(command), &directory).with_context(failed)
    }
}

/// Removes the `help` subcommands, which need no manual page of their own.
fn remove_help_subcommands(command: Command) -> Command {
    command.disable_help_subcommand(true).mut_subcommands(remove_help_subcommands)
}
