//! Names for the completion of shells: the generated scripts ask for those of services, servants and robots with a verb
//! of their own. It is fast and silent, also when the daemon does not answer.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::time::Duration;

use api::{EVENT_KINDS, Servant, ServiceSummary};
use clap::{Arg, ArgAction, Command};

use crate::client::DaemonClient;
use crate::output;

/// The verb of the scripts, followed by the words of the line up to the one that is typed.
pub const VERB: &str = "__complete";
/// Time that the daemon has to answer: a person waits with a key pressed.
const PATIENCE: Duration = Duration::from_secs(2);

/// Kind of thing that an argument names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum NamedThing {
    Service,
    Servant,
    Robot,
    EventKind,
}

/// Prints the names that may stand in place of the last word, one per line.
pub async fn print_names(words: &[OsString], command: Command) -> anyhow::Result<()> {
    let words: Vec<String> = words.iter().map(|word| word.to_string_lossy().into_owned()).collect();
    let last = words.last().cloned().unwrap_or_default();
    // Bash gives what follows `=` as a word of its own, other shells the whole option.
    let option = last.split_once('=').filter(|_| last.starts_with("--")).map(|(option, _)| format!("{option}="));
    let words = rejoin(words);
    let Some((typed, thing)) = find_thing(&command, &words) else {
        return Ok(());
    };
    let names = tokio::time::timeout(PATIENCE, ask_names(thing, &words)).await;
    // A person who types wants no message between the words.
    let names = names.ok().and_then(Result::ok).unwrap_or_default();
    let option = option.unwrap_or_default();
    for name in names.iter().filter(|name| name.starts_with(&typed) && is_plain(name)) {
        output::line(&format!("{option}{name}"))?;
    }
    Ok(())
}

async fn ask_names(thing: NamedThing, words: &[String]) -> anyhow::Result<BTreeSet<String>> {
    if thing == NamedThing::EventKind {
        return Ok(EVENT_KINDS.iter().map(|kind| (*kind).to_owned()).collect());
    }
    let server = find_value(words, "--server", "CLOUDROID_SERVER");
    let token = find_value(words, "--token", "CLOUDROID_TOKEN");
    let client = DaemonClient::new(server.as_deref(), token)?.without_first_trust();
    if thing == NamedThing::Service {
        let services: Vec<ServiceSummary> = client.get("/api/v1/services").await?;
        return Ok(services.into_iter().map(|service| service.name).collect());
    }
    let servants: Vec<Servant> = client.get("/api/v1/servants").await?;
    if thing == NamedThing::Robot {
        return Ok(servants.into_iter().map(|servant| servant.robot).collect());
    }
    // A service with one servant names that as well.
    Ok(servants.into_iter().flat_map(|servant| [servant.id, servant.service]).collect())
}

/// Returns the value of an option in the words, else that of its environment variable.
fn find_value(words: &[String], option: &str, variable: &str) -> Option<String> {
    let given = words.iter().enumerate().find_map(|(at, word)| {
        let value = word.strip_prefix(option)?;
        if value.is_empty() { words.get(at + 1).cloned() } else { value.strip_prefix('=').map(str::to_owned) }
    });
    given.or_else(|| std::env::var(variable).ok().filter(|value| !value.is_empty()))
}

/// Joins what bash has broken at `:` and `=` (COMP_WORDBREAKS).
fn rejoin(words: Vec<String>) -> Vec<String> {
    let mut joined: Vec<String> = Vec::new();
    let mut is_open = false;
    for word in words {
        let is_break = [":", "=", "://"].contains(&word.as_str());
        match joined.last_mut().filter(|_| is_break || is_open) {
            Some(last) => last.push_str(&word),
            None => joined.push(word),
        }
        is_open = is_break;
    }
    joined
}

/// Returns what is typed of the last word's name so far, and what it names.
fn find_thing(command: &Command, words: &[String]) -> Option<(String, NamedThing)> {
    let (last, before) = words.split_last()?;
    let (mut verb, mut positionals) = (command, 0);
    let mut waiting: Option<&Arg> = None;
    for word in before {
        if waiting.take().is_some() {
            continue;
        }
        if word.starts_with('-') && word.len() > 1 {
            let takes_next = |option: &&Arg| !word.contains('=') && !option.is_require_equals_set();
            waiting = find_option(command, verb, word).filter(takes_next);
        } else if let Some(inner) = verb.find_subcommand(word).filter(|_| positionals == 0) {
            verb = inner;
        } else {
            positionals += 1;
        }
    }
    if let Some(option) = waiting {
        return Some((last.clone(), thing_of(verb, option)?));
    }
    if last.starts_with('-') {
        let (option, value) = last.split_once('=')?;
        return Some((value.to_owned(), thing_of(verb, find_option(command, verb, option)?)?));
    }
    let repeats = |argument: &&Arg| matches!(argument.get_action(), ArgAction::Append);
    let positional =
        verb.get_positionals().nth(positionals).or_else(|| verb.get_positionals().last().filter(repeats))?;
    Some((last.clone(), thing_of(verb, positional)?))
}

/// Returns the option of this verb, or of all, that the word begins and that takes a value.
fn find_option<'a>(command: &'a Command, verb: &'a Command, word: &str) -> Option<&'a Arg> {
    let name = word.split_once('=').map_or(word, |(name, _)| name);
    let long = name.strip_prefix("--");
    let short = name.strip_prefix('-').filter(|_| long.is_none()).and_then(|name| name.chars().next());
    let mut arguments = verb.get_arguments().chain(command.get_arguments());
    let found = arguments.find(|argument| {
        (long.is_some() && argument.get_long() == long) || (short.is_some() && argument.get_short() == short)
    });
    found.filter(|argument| argument.get_action().takes_values())
}

/// Returns what an argument of a verb names, by its name in the code.
fn thing_of(verb: &Command, argument: &Arg) -> Option<NamedThing> {
    match argument.get_id().as_str() {
        "service" | "services" => Some(NamedThing::Service),
        "servant" | "servants" => Some(NamedThing::Servant),
        // Where recordings are replayed to.
        "to" if verb.get_name() == "replay" => Some(NamedThing::Servant),
        // `eval --robot` is a kind of computer.
        "robot" if verb.get_name() != "eval" => Some(NamedThing::Robot),
        "live" => Some(NamedThing::Robot),
        "name" if verb.get_name() == "logs" => Some(NamedThing::Servant),
        "kind" => Some(NamedThing::EventKind),
        _ => None,
    }
}

/// Returns whether a name can be typed as it is. Robots choose their names: what a shell would interpret is left out.
fn is_plain(name: &str) -> bool {
    let is_harmless = |c: char| c.is_ascii_alphanumeric() || "._-/@+".contains(c);
    !name.is_empty() && !name.starts_with('-') && name.chars().all(is_harmless)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_argument_tells_what_it_names() {
        let command = crate::command_line();
        let thing = |line: &str| {
            let words = rejoin(line.split(' ').map(str::to_owned).collect());
            find_thing(&command, &words)
        };
        for (line, typed, expected) in [
            ("rm ", "", NamedThing::Service),
            ("--format json rm ad", "ad", NamedThing::Service),
            ("delete ad", "ad", NamedThing::Service),
            ("services ad", "ad", NamedThing::Service),
            ("stop one two ", "", NamedThing::Servant),
            ("stop --service ad", "ad", NamedThing::Service),
            ("stop --service=ad", "ad", NamedThing::Service),
            ("stop --service = ad", "ad", NamedThing::Service),
            ("--server http : //host : 9090 logs ", "", NamedThing::Servant),
            ("logs -n 5 ad", "ad", NamedThing::Servant),
            ("explain r", "r", NamedThing::Robot),
            ("events --robot ", "", NamedThing::Robot),
            ("events --kind node", "node", NamedThing::EventKind),
            ("recordings take ", "", NamedThing::Servant),
            ("sla list ", "", NamedThing::Service),
        ] {
            assert_eq!(thing(line), Some((typed.to_owned(), expected)), "{line}");
        }
        for line in ["", "ro", "push ", "rm adder ", "rm -", "eval adder --robot ", "record s -o "] {
            assert_eq!(thing(line), None, "{line}");
        }
    }

    #[test]
    fn the_server_of_the_line_is_asked() {
        let words: Vec<String> = ["--server", "unix:/x", "rm", ""].map(str::to_owned).into();
        assert_eq!(find_value(&words, "--server", "CLOUDROID_NO_SUCH_VARIABLE").as_deref(), Some("unix:/x"));
        let words = ["--server=http://h:1".to_owned()];
        assert_eq!(find_value(&words, "--server", "CLOUDROID_NO_SUCH_VARIABLE").as_deref(), Some("http://h:1"));
        assert_eq!(find_value(&[], "--server", "CLOUDROID_NO_SUCH_VARIABLE"), None);
    }

    #[test]
    fn names_that_a_shell_would_interpret_are_left_out() {
        for (name, expected) in [("rover1", true), ("a_b-c.d/e", true), ("$(reboot)", false), ("a b", false)] {
            assert_eq!(is_plain(name), expected, "{name}");
        }
        assert!(!is_plain("") && !is_plain("-x") && !is_plain("`x`"));
    }
}
