//! The help: verbs in groups, options of `push` in sections, lines wrapped to the terminal.

use std::io::{Write, stderr, stdout};
use std::process::ExitCode;

use api::{Caps, Limits};
use clap::error::ErrorKind;
use clap::{Arg, ArgMatches, Args, Command};

use crate::colour::has_colours;
use crate::output::terminal_width;
use crate::wrap::wrap_help;

/// Width of the help in columns: the greatest on a terminal, and the one without.
const WIDTH: usize = 100;
/// Smallest width of the help in columns.
const NARROWEST: usize = 40;
/// Column in which the descriptions of verbs begin.
const DESCRIPTIONS: usize = 15;

/// Verbs by what they are about.
const GROUPS: [(&str, &[&str]); 7] = [
    (
        "Services",
        &["push", "pushes", "services", "rollback", "rollout", "diff", "rm", "export", "import", "bases", "underlays"],
    ),
    ("Servants and robots", &["servants", "top", "logs", "exec", "set", "stop", "explain", "fit", "events"]),
    ("Topics, actions and recordings", &["topics", "goals", "record", "replay", "recordings"]),
    ("Measuring", &["try", "calibrate", "sla", "eval", "shadow"]),
    ("Robots", &["stub", "pair", "unpair"]),
    ("Access", &["account", "token", "policy", "audit", "trust"]),
    ("Daemon and shell", &["status", "doctor", "version", "completions", "man"]),
];

/// Section of the options about servants, to which all limits belong.
const SERVANTS: &str = "Servants";

/// Options of `push` by what they are about; all others are under Options.
const SECTIONS: [(&str, &[&str]); 5] = [
    ("What runs", &["launch", "node", "param", "arg", "remap"]),
    ("Build", &["base", "map", "with", "on", "as-underlay", "packages-up-to", "packages-skip", "cmake-args"]),
    ("Interface and requests", &["interface", "request", "stateful", "rrt", "max-rrt"]),
    (SERVANTS, &["device", "volume", "egress", "shared", "min", "max", "idempotent", "replicas", "calls"]),
    ("Rollout", &["canary", "bound", "samples", "promote-after", "deadline", "wait"]),
];

/// Verbs that list things by name, with `list` of all others.
const LISTING: [&str; 7] = ["services", "servants", "sessions", "bases", "underlays", "pushes", "list"];

/// Arranges the help of the whole command line.
pub fn arrange(command: Command) -> Command {
    let Some(format) = command.get_arguments().find(|argument| argument.get_id() == "format").cloned() else {
        return command;
    };
    // Where `-o` is an output file, only the long form is left for the format.
    let format = format.short(None);
    let command = keep_own_output(command, &format);
    let command = command.mut_subcommand("push", |push| push.mut_args(assign_section));
    let template = main_help(&command);
    command.help_template(template)
}

fn keep_own_output(command: Command, format: &Arg) -> Command {
    let command = command.mut_subcommands(|verb| keep_own_output(verb, format));
    let is_own = |argument: &Arg| argument.get_short() == Some('o') && argument.get_id() != "format";
    let has_own = command.get_arguments().any(is_own);
    if has_own { command.arg(format.clone()) } else { command }
}

fn assign_section(argument: Arg) -> Arg {
    let Some(long) = argument.get_long() else {
        return argument;
    };
    let section = SECTIONS.iter().find(|(_, options)| options.contains(&long)).map(|(section, _)| *section);
    match section.or_else(|| is_limit(long).then_some(SERVANTS)) {
        Some(section) => argument.help_heading(section),
        None => argument,
    }
}

fn is_limit(long: &str) -> bool {
    let limits = Caps::augment_args(Limits::augment_args(Command::new("limits")));
    limits.get_arguments().any(|argument| argument.get_long() == Some(long))
}

/// Returns the template of the main help, with the verbs in groups.
fn main_help(command: &Command) -> String {
    let heading = |text: &str| format!("\x1b[1m\x1b[4m{text}\x1b[0m");
    let mut template = "{about-with-newline}\n{usage-heading} {usage}\n".to_owned();
    for (group, verbs) in GROUPS {
        template += &format!("\n{}\n", heading(&format!("{group}:")));
        for verb in verbs.iter().filter_map(|verb| command.find_subcommand(verb)) {
            template += &verb_line(verb);
        }
    }
    template += &format!("\n{}\n{{options}}{{after-help}}", heading("Options:"));
    template
}

fn verb_line(verb: &Command) -> String {
    let about = verb.get_about().map(ToString::to_string).unwrap_or_default();
    let aliases: Vec<&str> = verb.get_visible_aliases().collect();
    let aliases = if aliases.is_empty() { String::new() } else { format!(" [also: {}]", aliases.join(", ")) };
    let name = verb.get_name();
    let padding = " ".repeat(DESCRIPTIONS.saturating_sub(name.len() + 2));
    format!("  \x1b[1m{name}\x1b[0m{padding}{about}{aliases}\n")
}

/// Returns whether the verb of the command line lists things by name.
pub fn is_listing(matches: &ArgMatches) -> bool {
    let (mut verb, mut inner) = ("", matches);
    while let Some((name, below)) = inner.subcommand() {
        (verb, inner) = (name, below);
    }
    LISTING.contains(&verb)
}

/// Prints the help, the version, or what is wrong with the command line, and returns the exit status.
pub fn print(asked: &clap::Error) -> ExitCode {
    let status = ExitCode::from(u8::try_from(asked.exit_code()).unwrap_or(2));
    let is_error = asked.use_stderr();
    let has_colours = if is_error { has_colours(&stderr()) } else { has_colours(&stdout()) };
    let text = asked.render();
    let mut text = if has_colours { text.ansi().to_string() } else { text.to_string() };
    // Errors are short, and programs look for their words.
    if matches!(asked.kind(), ErrorKind::DisplayHelp | ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand) {
        text = wrap_help(&text, terminal_width().unwrap_or(WIDTH).clamp(NARROWEST, WIDTH));
    }
    // A reader that closes the pipe early is not an error.
    let _ = if is_error { stderr().write_all(text.as_bytes()) } else { stdout().write_all(text.as_bytes()) };
    status
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;
    use crate::CtlArguments;
    use crate::wrap::visible_width;

    fn whole() -> Command {
        arrange(CtlArguments::command())
    }

    #[test]
    fn every_verb_is_in_one_group() {
        let command = whole();
        for verb in command.get_subcommands().filter(|verb| !verb.is_hide_set()) {
            let groups = GROUPS.iter().filter(|(_, verbs)| verbs.contains(&verb.get_name()));
            assert_eq!(groups.count(), 1, "{}", verb.get_name());
        }
        let help = whole().render_help().to_string();
        assert_eq!(help.matches("\n  bases ").count(), 1, "{help}");
        for part in ["Services:\n  push ", "[also: servant, ps]", "Options:\n", "--format", "Exit status:\n  0  done"] {
            assert!(help.contains(part), "{part:?}: {help}");
        }
        assert!(!help.contains("Commands:"), "{help}");
    }

    #[test]
    fn options_of_push_are_in_sections() {
        let mut command = whole();
        command.build();
        let push = command.find_subcommand_mut("push").expect("it is there");
        let help = push.render_long_help().to_string();
        let at = |text: &str| help.find(text).unwrap_or_else(|| panic!("{text}: {help}"));
        assert!(at("\nWhat runs:") < at("--node <") && at("--node <") < at("\nBuild:"), "{help}");
        assert!(at("\nServants:") < at("--cpus <"), "{help}");
        assert!(at("\nOptions:") < at("--apt <NAME>\n") && at("--apt <NAME>\n") < at("\nWhat runs:"), "{help}");
    }

    #[test]
    fn help_fits_a_terminal() {
        fn check(command: &mut Command) {
            for help in [command.render_help(), command.render_long_help()] {
                let text = wrap_help(&help.to_string(), WIDTH);
                for line in text.lines() {
                    assert!(visible_width(line) <= WIDTH, "{}: {line}", command.get_name());
                }
            }
            command.get_subcommands_mut().for_each(check);
        }
        let mut command = whole();
        command.build();
        check(&mut command);
    }
}
