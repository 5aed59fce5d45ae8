//! `cloudroidctl`: the command line for deployers. Each command is one file and uses only the daemon's HTTP API; its
//! doc comments are its help.

#![forbid(unsafe_code)]

mod account;
mod audit;
mod calibrate;
mod client;
mod diff;
mod doctor;
mod eval;
mod events;
mod exit;
mod explain;
mod export;
mod first_credential;
mod fit;
mod goals;
mod import;
mod inside;
mod limits;
mod logs;
mod manual;
mod output;
mod pair;
mod policy;
mod published;
mod push;
mod record;
mod recordings;
mod replay;
mod rm;
mod rollback;
mod rollout;
mod servants;
mod services;
mod set;
mod shadow;
mod sla;
mod stated;
mod status;
mod stop;
mod stream;
mod stub;
mod token;
mod top;
mod topics;
mod trial;
mod trust;
mod wait;
mod whole;

use std::process::ExitCode;

use api::Problem;
use clap::{Parser, Subcommand};

use client::DaemonClient;
use exit::Exit;
use output::OutputFormat;

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
    /// Output format.
    #[arg(long, global = true, value_enum, default_value_t = OutputFormat::Table)]
    format: OutputFormat,
    #[command(subcommand)]
    verb: CtlCommand,
}

#[derive(Debug, Subcommand)]
enum CtlCommand {
    Push(Box<push::PushArgs>),
    Services(services::ServicesArgs),
    Servants(servants::ServantsArgs),
    Top(top::TopArgs),
    Logs(logs::LogsArgs),
    Record(record::RecordArgs),
    Replay(replay::ReplayArgs),
    Recordings(recordings::RecordingsArgs),
    Topics(published::TopicsArgs),
    Goals(goals::GoalsArgs),
    Events(events::EventsArgs),
    Set(set::SetArgs),
    Shadow(shadow::ShadowArgs),
    Sla(sla::SlaArgs),
    Stop(stop::StopArgs),
    Rm(rm::RmArgs),
    Rollback(rollback::RollbackArgs),
    Diff(diff::DiffArgs),
    Export(export::ExportArgs),
    Import(Box<import::ImportArgs>),
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
    Completions(manual::CompletionsArgs),
    Man(manual::ManArgs),
}

fn main() -> ExitCode {
    let arguments = CtlArguments::parse();
    let runtime = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => runtime,
        Err(error) => {
            eprintln!("error: cannot start: {error}");
            return Exit::Failed.into();
        }
    };
    let outcome = runtime.block_on(run(arguments));
    // A pending read of standard input or a directory must not delay the exit.
    runtime.shutdown_background();
    match outcome {
        Ok(()) => Exit::Done.into(),
        Err(error) if output::is_closed_pipe(&error) => Exit::Done.into(),
        Err(error) => {
            print_error(&error);
            Exit::from_error(&error).into()
        }
    }
}

async fn run(arguments: CtlArguments) -> anyhow::Result<()> {
    // These run while a package is built, where there is no daemon.
    let arguments = match arguments.verb {
        CtlCommand::Completions(verb) => return verb.run::<CtlArguments>(),
        CtlCommand::Man(verb) => return verb.run::<CtlArguments>(),
        verb => CtlArguments { verb, ..arguments },
    };
    let client = DaemonClient::new(arguments.server.as_deref(), arguments.token)?;
    let format = arguments.format;
    match arguments.verb {
        CtlCommand::Push(verb) => verb.run(&client, format).await,
        CtlCommand::Services(verb) => verb.run(&client, format).await,
        CtlCommand::Servants(verb) => verb.run(&client, format).await,
        CtlCommand::Top(verb) => verb.run(&client, format).await,
        CtlCommand::Logs(verb) => verb.run(&client, format).await,
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

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory;
        CtlArguments::command().debug_assert();
    }

    #[test]
    fn every_verb_explains_itself() {
        use clap::CommandFactory;
        for verb in CtlArguments::command().get_subcommands() {
            assert!(verb.get_about().is_some(), "{} has no help", verb.get_name());
            for argument in verb.get_arguments() {
                assert!(argument.get_help().is_some(), "{} {} has no help", verb.get_name(), argument.get_id());
            }
        }
    }

    #[test]
    fn the_format_may_stand_before_or_after_the_verb() {
        for line in [["cloudroidctl", "--format", "json", "status"], ["cloudroidctl", "status", "--format", "json"]] {
            assert_eq!(CtlArguments::try_parse_from(line).expect("valid").format, OutputFormat::Json);
        }
    }
}
