//! `cloudroidctl`: the command line for deployers. Each command is one file and uses only the daemon's HTTP API; its
//! doc comments are its help, which `help` groups and wraps.

#![forbid(unsafe_code)]

mod account;
mod audit;
mod bases;
mod calibrate;
mod choice;
mod client;
mod colour;
mod complete;
mod confirm;
mod diff;
mod doctor;
mod eval;
mod events;
mod exec;
mod exit;
mod explain;
mod export;
mod first_credential;
mod fit;
mod goals;
mod help;
mod import;
mod inside;
mod logs;
mod manual;
mod moment;
mod output;
mod pair;
mod policy;
mod push;
mod pushes;
mod record;
mod recordings;
mod registry;
mod replay;
mod rm;
mod rollback;
mod rollout;
mod servants;
mod services;
mod set;
mod shadow;
mod sla;
mod status;
mod stop;
mod stream;
mod stub;
mod synonyms;
mod terms_flags;
mod token;
mod top;
mod topic_selection;
mod topics;
mod trial;
mod trust;
mod underlays;
mod version;
mod wait;
mod whole;
mod wrap;

use std::ffi::OsString;
use std::process::ExitCode;

use api::Problem;
use clap::error::ErrorKind;
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

use choice::OutputChoice;
use client::DaemonClient;
use exit::Exit;

/// Manage ROS packages as services: push, observe and end them.
#[derive(Debug, Parser)]
#[command(
    name = "cloudroidctl",
    version,
    arg_required_else_help = true,
    propagate_version = true,
    after_help = exit::table()
)]
struct CtlArguments {
    /// Address of the daemon: https://HOST:PORT, http://HOST:PORT, or unix:PATH of its socket. Default: the socket in
    /// CLOUDROID_HOME, of your own or of the installed daemon, otherwise http://127.0.0.1:9090.
    #[arg(long, global = true, env = "CLOUDROID_SERVER", value_name = "URL")]
    server: Option<String>,
    /// Bearer token; required over TCP if the daemon has tokens configured.
    #[arg(long, global = true, env = "CLOUDROID_TOKEN", value_name = "TOKEN", hide_env_values = true)]
    token: Option<String>,
    /// Output format; -o is a file in verbs that write one.
    #[arg(short = 'o', long, global = true, value_enum, default_value_t = OutputChoice::Table)]
    format: OutputChoice,
    /// Print only names or ids, of verbs that list: short for -o name.
    #[arg(short, long, global = true, conflicts_with = "format")]
    quiet: bool,
    #[command(subcommand)]
    verb: CtlCommand,
}

#[derive(Debug, Subcommand)]
enum CtlCommand {
    #[command(visible_alias = "deploy")]
    Push(Box<push::PushArgs>),
    Pushes(pushes::PushesArgs),
    #[command(visible_aliases = ["service", "ls", "list", "get"])]
    Services(services::ServicesArgs),
    #[command(visible_aliases = ["servant", "ps"])]
    Servants(servants::ServantsArgs),
    Top(top::TopArgs),
    Logs(logs::LogsArgs),
    Exec(exec::ExecArgs),
    Record(record::RecordArgs),
    Replay(replay::ReplayArgs),
    Recordings(recordings::RecordingsArgs),
    Topics(topics::TopicsArgs),
    Goals(goals::GoalsArgs),
    Events(events::EventsArgs),
    Set(set::SetArgs),
    Shadow(shadow::ShadowArgs),
    Sla(sla::SlaArgs),
    Stop(stop::StopArgs),
    #[command(visible_alias = "delete")]
    Rm(rm::RmArgs),
    Rollback(rollback::RollbackArgs),
    Diff(diff::DiffArgs),
    Export(export::ExportArgs),
    Import(Box<import::ImportArgs>),
    #[command(visible_alias = "base")]
    Bases(bases::BasesArgs),
    #[command(visible_alias = "underlay")]
    Underlays(underlays::UnderlaysArgs),
    Rollout(rollout::RolloutArgs),
    Stub(stub::StubArgs),
    Try(Box<trial::TryArgs>),
    Calibrate(Box<calibrate::CalibrateArgs>),
    Eval(Box<eval::EvalArgs>),
    Explain(explain::ExplainArgs),
    Fit(fit::FitArgs),
    Account(account::AccountArgs),
    Token(token::TokenArgs),
    Pair(pair::PairArgs),
    Unpair(pair::UnpairArgs),
    Audit(audit::AuditArgs),
    Policy(policy::PolicyArgs),
    Trust(trust::TrustArgs),
    Status(status::StatusArgs),
    Doctor(doctor::DoctorArgs),
    Version(version::VersionArgs),
    Completions(manual::CompletionsArgs),
    Man(manual::ManArgs),
}

/// Returns the whole command line, as it is parsed, explained and completed.
fn command_line() -> clap::Command {
    help::arrange(CtlArguments::command())
}

/// Parses the words of the command line.
fn parse(words: Vec<OsString>) -> Result<CtlArguments, clap::Error> {
    let matches = command_line().try_get_matches_from(synonyms::to_own_words(words))?;
    let mut arguments = CtlArguments::from_arg_matches(&matches)?;
    if arguments.quiet {
        arguments.format = OutputChoice::Name;
    }
    if arguments.format == OutputChoice::Name && !help::is_listing(&matches) {
        let message =
            "names are printed by verbs that list: services, servants, bases, underlays, pushes, and list of others\n";
        return Err(command_line().error(ErrorKind::ArgumentConflict, message));
    }
    Ok(arguments)
}

fn main() -> ExitCode {
    let words: Vec<OsString> = std::env::args_os().collect();
    if words.get(1).is_some_and(|word| word == complete::VERB) {
        return run_to_end(complete::print_names(&words[2..], command_line()));
    }
    match parse(words) {
        Ok(arguments) => run_to_end(run(arguments)),
        Err(error) => help::print(&error),
    }
}

fn run_to_end(work: impl Future<Output = anyhow::Result<()>>) -> ExitCode {
    let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => {
            eprintln!("error: cannot start: {error}");
            return Exit::Failed.into();
        }
    };
    let outcome = runtime.block_on(work);
    // A pending read of standard input or a directory must not delay the exit.
    runtime.shutdown_background();
    match outcome {
        Ok(()) => Exit::Done.into(),
        Err(error) if output::is_closed_pipe(&error) => Exit::Done.into(),
        Err(error) => {
            if let Some(failed) = error.downcast_ref::<exec::ProgramFailed>() {
                return ExitCode::from(failed.status);
            }
            print_error(&error);
            Exit::from_error(&error).into()
        }
    }
}

async fn run(arguments: CtlArguments) -> anyhow::Result<()> {
    // These run while a package is built, where there is no daemon.
    let arguments = match arguments.verb {
        CtlCommand::Completions(verb) => return verb.run(command_line()),
        CtlCommand::Man(verb) => return verb.run(command_line()),
        verb => CtlArguments { verb, ..arguments },
    };
    let client = DaemonClient::new(arguments.server.as_deref(), arguments.token)?;
    let format = arguments.format.apply();
    match arguments.verb {
        CtlCommand::Push(verb) => verb.run(&client, format).await,
        CtlCommand::Pushes(verb) => verb.run(&client, format).await,
        CtlCommand::Services(verb) => verb.run(&client, format).await,
        CtlCommand::Servants(verb) => verb.run(&client, format).await,
        CtlCommand::Top(verb) => verb.run(&client, format).await,
        CtlCommand::Logs(verb) => verb.run(&client, format).await,
        CtlCommand::Exec(verb) => verb.run(&client).await,
        CtlCommand::Record(verb) => verb.run(&client, format).await,
        CtlCommand::Replay(verb) => verb.run(&client, format).await,
        CtlCommand::Recordings(verb) => verb.run(&client, format).await,
        CtlCommand::Topics(verb) => verb.run(&client, format).await,
        CtlCommand::Goals(verb) => verb.run(&client, format).await,
        CtlCommand::Events(verb) => verb.run(&client, format).await,
        CtlCommand::Set(verb) => verb.run(&client, format).await,
        CtlCommand::Shadow(verb) => verb.run(&client, format).await,
        CtlCommand::Sla(verb) => verb.run(&client, format).await,
        CtlCommand::Stop(verb) => verb.run(&client, format).await,
        CtlCommand::Rm(verb) => verb.run(&client, format).await,
        CtlCommand::Rollback(verb) => verb.run(&client, format).await,
        CtlCommand::Diff(verb) => verb.run(&client, format).await,
        CtlCommand::Export(verb) => verb.run(&client, format).await,
        CtlCommand::Import(verb) => verb.run(&client, format).await,
        CtlCommand::Bases(verb) => verb.run(&client, format).await,
        CtlCommand::Underlays(verb) => verb.run(&client, format).await,
        CtlCommand::Rollout(verb) => verb.run(&client, format).await,
        CtlCommand::Stub(verb) => verb.run(&client, format).await,
        CtlCommand::Try(verb) => verb.run(&client, format).await,
        CtlCommand::Calibrate(verb) => verb.run(&client, format).await,
        CtlCommand::Eval(verb) => verb.run(&client, format).await,
        CtlCommand::Explain(verb) => verb.run(&client, format).await,
        CtlCommand::Fit(verb) => verb.run(&client, format).await,
        CtlCommand::Pair(verb) => verb.run(&client, format).await,
        CtlCommand::Unpair(verb) => verb.run(&client, format).await,
        CtlCommand::Account(verb) => verb.run(&client, format).await,
        CtlCommand::Token(verb) => verb.run(&client, format).await,
        CtlCommand::Audit(verb) => verb.run(&client, format).await,
        CtlCommand::Policy(verb) => verb.run(&client, format).await,
        CtlCommand::Trust(verb) => verb.run(),
        CtlCommand::Status(verb) => verb.run(&client, format).await,
        CtlCommand::Doctor(verb) => verb.run(&client, format).await,
        CtlCommand::Version(verb) => verb.run(&client, format).await,
        CtlCommand::Completions(_) | CtlCommand::Man(_) => Ok(()),
    }
}

/// Prints an error with its log, its alternatives and the next step.
fn print_error(error: &anyhow::Error) {
    let Some(problem) = error.downcast_ref::<Problem>() else {
        output::eprint_line(&format!("error: {error:#}"));
        return;
    };
    for line in &problem.log {
        output::eprint_line(&format!("  | {line}"));
    }
    output::eprint_line(&format!("error: {problem}"));
    if !problem.exists.is_empty() {
        output::eprint_line(&format!("available: {}", problem.exists.join(", ")));
    }
    if let Some(next) = &problem.next {
        output::eprint_line(&format!("next: {next}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse_line(line: &str) -> Result<CtlArguments, clap::Error> {
        parse(line.split_whitespace().map(OsString::from).collect())
    }

    #[test]
    fn the_command_line_is_consistent() {
        command_line().debug_assert();
    }

    #[test]
    fn every_verb_explains_itself() {
        for verb in command_line().get_subcommands() {
            assert!(verb.get_about().is_some(), "{} has no help", verb.get_name());
            for argument in verb.get_arguments() {
                assert!(argument.get_help().is_some(), "{} {} has no help", verb.get_name(), argument.get_id());
            }
        }
    }

    #[test]
    fn the_format_may_stand_before_or_after_the_verb() {
        for (line, format) in [
            ("cloudroidctl --format json status", OutputChoice::Json),
            ("cloudroidctl status --format json", OutputChoice::Json),
            ("cloudroidctl -o yaml services", OutputChoice::Yaml),
            ("cloudroidctl services -o wide", OutputChoice::Wide),
            ("cloudroidctl token list -o json", OutputChoice::Json),
            ("cloudroidctl services -q", OutputChoice::Name),
            ("cloudroidctl -q token list", OutputChoice::Name),
            ("cloudroidctl status", OutputChoice::Table),
            // Verbs that write a file have had -o for it.
            ("cloudroidctl record s -o drive.mcap --format json", OutputChoice::Json),
            ("cloudroidctl -o json recordings get 3 -o drive.mcap", OutputChoice::Json),
        ] {
            assert_eq!(parse_line(line).expect(line).format, format, "{line}");
        }
        for line in ["cloudroidctl status -q", "cloudroidctl push ./p -o name", "cloudroidctl services -q -o json"] {
            assert_eq!(parse_line(line).expect_err(line).exit_code(), 2, "{line}");
        }
    }

    #[test]
    fn verbs_are_known_by_the_names_that_others_give_them() {
        for (line, meant) in [
            ("cloudroidctl ps", "Servants("),
            ("cloudroidctl ls", "Services("),
            ("cloudroidctl list", "Services("),
            ("cloudroidctl get services", "Services("),
            ("cloudroidctl --format json get servants", "Servants("),
            ("cloudroidctl delete service adder", "Rm("),
            ("cloudroidctl delete adder", "Rm("),
            ("cloudroidctl deploy ./p", "Push("),
            ("cloudroidctl version", "Version("),
        ] {
            let verb = format!("{:?}", parse_line(line).expect(line).verb);
            assert!(verb.starts_with(meant), "{line}: {verb}");
        }
    }
}
