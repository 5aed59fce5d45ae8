//! `completions`, `man`: shell completions and manual pages, generated from the help.

use std::path::PathBuf;

use anyhow::Context;
use clap::{Command, ValueEnum};
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

/// Bash: the names of services, servants and robots replace what the generated function found, if there are any.
/// They are not expanded by the shell.
const BASH_NAMES: &str = r#"
_cloudroidctl_names() {
    _cloudroidctl "$@"
    local names
    mapfile -t names < <("${COMP_WORDS[0]}" __complete "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null)
    if ((${#names[@]})); then
        COMPREPLY=("${names[@]}")
    fi
}

complete -F _cloudroidctl_names -o bashdefault -o default cloudroidctl
"#;

/// Zsh: asked in place of the files that it offers for values of which nothing else is known.
const ZSH_NAMES: &str = r#"
_cloudroidctl_names() {
    local -a typed names
    typed=("${(@Q)${(z)LBUFFER}}")
    typed=("${(@)typed[${typed[(I)*cloudroidctl]}+1,-1]}")
    [[ "$LBUFFER" == *[[:space:]] ]] && typed+=("")
    names=("${(@f)$(cloudroidctl __complete "${(@)typed}" 2>/dev/null)}")
    names=("${(@)names:#}")
    if (( $#names )); then
        compadd -a names
    else
        _default
    fi
}
"#;

/// Fish: adds the names to what the generated lines offer.
const FISH_NAMES: &str = "
complete -c cloudroidctl -a '(cloudroidctl __complete (commandline -opc)[2..-1] (commandline -ct) 2>/dev/null)'
";

impl CompletionShell {
    /// Adds to a generated script that it asks the daemon for names.
    fn with_names(self, script: String) -> String {
        match self {
            CompletionShell::Bash => script + BASH_NAMES,
            CompletionShell::Fish => script + FISH_NAMES,
            CompletionShell::Zsh => {
                let asks = script.replace(":_default'", ":_cloudroidctl_names'");
                // The file is the body of a function that is loaded at its first use: names must be defined by then.
                match asks.split_once("\n\n") {
                    Some((head, rest)) => format!("{head}\n{ZSH_NAMES}\n{rest}"),
                    None => asks,
                }
            }
        }
    }
}

impl CompletionsArgs {
    /// Prints the script.
    pub fn run(self, mut command: Command) -> anyhow::Result<()> {
        let mut script = Vec::new();
        clap_complete::generate(Shell::from(self.shell), &mut command, "cloudroidctl", &mut script);
        let script = String::from_utf8(script).context("the script is not UTF-8")?;
        output::raw(self.shell.with_names(script).as_bytes())
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
    pub fn run(self, command: Command) -> anyhow::Result<()> {
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
