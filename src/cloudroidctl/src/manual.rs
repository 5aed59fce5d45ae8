//! `completions`, `man`: what shells and `man` read, made from the same words as the help.

use std::path::PathBuf;

use anyhow::Context;
use clap::{Command, CommandFactory, ValueEnum};
use clap_complete::Shell;

use crate::output;

/// Print what makes a shell complete cloudroidctl's verbs and options.
///
/// bash: cloudroidctl completions bash > ~/.local/share/bash-completion/completions/cloudroidctl. zsh: into _cloudroidctl in a directory
/// of fpath. fish: into ~/.config/fish/completions/cloudroidctl.fish. The Debian package and make install bring all three.
#[derive(Debug, clap::Args)]
pub struct Completions {
    /// For which shell.
    #[arg(value_enum)]
    shell: Named,
}

/// Shells that cloudroidctl is completed in.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Named {
    Bash,
    Zsh,
    Fish,
}

impl From<Named> for Shell {
    fn from(named: Named) -> Shell {
        match named {
            Named::Bash => Shell::Bash,
            Named::Zsh => Shell::Zsh,
            Named::Fish => Shell::Fish,
        }
    }
}

impl Completions {
    /// Prints.
    pub fn run<A: CommandFactory>(self) -> anyhow::Result<()> {
        let mut script = Vec::new();
        clap_complete::generate(
            Shell::from(self.shell),
            &mut A::command(),
            "cloudroidctl",
            &mut script,
        );
        output::raw(&script)
    }
}

/// Print the manual page of cloudroidctl, or write those of all its verbs into a directory.
///
/// man -l <(cloudroidctl man) shows it. The Debian package and make install bring them: man cloudroidctl-push.
#[derive(Debug, clap::Args)]
pub struct Man {
    /// Where to write the pages of all verbs, such as /usr/local/share/man/man1.
    directory: Option<PathBuf>,
}

impl Man {
    /// Prints, or writes.
    pub fn run<A: CommandFactory>(self) -> anyhow::Result<()> {
        let command = A::command();
        let Some(directory) = self.directory else {
            let mut page = Vec::new();
            clap_mangen::Man::new(command).render(&mut page)?;
            return output::raw(&page);
        };
        let failed = || format!("cannot write the pages into {}", directory.display());
        std::fs::create_dir_all(&directory).with_context(failed)?;
        clap_mangen::generate_to(without_help(command), &directory).with_context(failed)
    }
}

/// The verb `help` of each has no page of its own: it shows the others'.
fn without_help(command: Command) -> Command {
    command
        .disable_help_subcommand(true)
        .mut_subcommands(without_help)
}
