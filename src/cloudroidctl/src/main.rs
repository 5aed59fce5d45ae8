//! `cloudroidctl`: what a deployer types. Every verb is one file and speaks only HTTP with the daemon; its doc
//! comments are its help.

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

use client::Client;
use exit::Exit;
use output::Format;

/// Robot packages as services: push them, watch them, end them.
#[derive(Debug, Parser)]
#[command(
    name = "cloudroidctl",
    version,
    arg_required_else_help = true,
    propagate_version = true,
    after_help = exit::table()
)]
struct Arguments {
    /// The daemon: https://HOST:PORT, http://HOST:PORT, or unix:PATH of its socket. By default the socket below CLOUDROID_HOME, that of
    /// your own or of the installed daemon, or http://127.0.0.1:9090 where there is none.
    #[arg(long, global = true, env = "CLOUDROID_SERVER", value_name = "URL")]
    server: Option<String>,
    /// Bearer token; needed over TCP where the daemon has tokens configured.
    #[arg(
        long,
        global = true,
        env = "CLOUDROID_TOKEN",
        value_name = "TOKEN",
        hide_env_values = true
    )]
    token: Option<String>,
    /// How to print: for people or for programs.
    #[arg(long, global = true, value_enum, default_value_t = Format::Table)]
    format: Format,
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    Push(Box<push::Push>),
    Services(services::Services),
    Servants(servants::Servants),
    Top(top::Top),
    Logs(logs::Logs),
    Record(record::Record),
    Replay(replay::Replay),
    Recordings(recordings::Recordings),
    Topics(published::Published),
    Goals(goals::Goals),
    Events(events::Events),
    Set(set::Set),
    Shadow(shadow::Shadow),
    Sla(sla::Sla),
    Stop(stop::Stop),
    Rm(rm::Rm),
    Rollback(rollback::Rollback),
    Diff(diff::Diff),
    Export(export::Export),
    Import(Box<import::Import>),
    Rollout(rollout::Rollout),
    Stub(stub::Stub),
    Try(Box<trial::Try>),
    Calibrate(Box<calibrate::Calibrate>),
    Eval(Box<eval::Eval>),
    Explain(explain::Explain),
    Fit(fit::Fit),
    Account(account::Accounts),
    Token(token::Tokens),
    Pair(pair::Pair),
    Unpair(pair::Unpair),
    Audit(audit::Audit),
    Policy(policy::Policy),
    Trust(trust::TrustServer),
    Status(status::Status),
    Doctor(doctor::Doctor),
    Completions(manual::Completions),
    Man(manual::Man),
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let runtime = match tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
    {
        Ok(runtime) => runtime,
        Err(error) => {
            eprintln!("error: cannot start: {error}");
            return Exit::Failed.into();
        }
    };
    let outcome = runtime.block_on(run(arguments));
    // A read of standard input or of a directory must not hold up the end.
    runtime.shutdown_background();
    match outcome {
        Ok(()) => Exit::Done.into(),
        Err(error) if output::is_closed_pipe(&error) => Exit::Done.into(),
        Err(error) => {
            complain(&error);
            Exit::of(&error).into()
        }
    }
}

async fn run(arguments: Arguments) -> anyhow::Result<()> {
    // These are asked for while a package is made, where there is no daemon.
    let arguments = match arguments.verb {
        Verb::Completions(verb) => return verb.run::<Arguments>(),
        Verb::Man(verb) => return verb.run::<Arguments>(),
        verb => Arguments { verb, ..arguments },
    };
    let client = Client::new(arguments.server.as_deref(), arguments.token)?;
    let format = arguments.format;
    match arguments.verb {
        Verb::Push(verb) => verb.run(&client, format).await,
        Verb::Services(verb) => verb.run(&client, format).await,
        Verb::Servants(verb) => verb.run(&client, format).await,
        Verb::Top(verb) => verb.run(&client, format).await,
        Verb::Logs(verb) => verb.run(&client, format).await,
        Verb::Record(verb) => verb.run(&client, format).await,
        Verb::Replay(verb) => verb.run(&client, format).await,
        Verb::Recordings(verb) => verb.run(&client, format).await,
        Verb::Topics(verb) => verb.run(&client, format).await,
        Verb::Goals(verb) => verb.run(&client, format).await,
        Verb::Events(verb) => verb.run(&client, format).await,
        Verb::Set(verb) => verb.run(&client, format).await,
        Verb::Shadow(verb) => verb.run(&client, format).await,
        Verb::Sla(verb) => verb.run(&client, format).await,
        Verb::Stop(verb) => verb.run(&client, format).await,
        Verb::Rm(verb) => verb.run(&client, format).await,
        Verb::Rollback(verb) => verb.run(&client, format).await,
        Verb::Diff(verb) => verb.run(&client, format).await,
        Verb::Export(verb) => verb.run(&client, format).await,
        Verb::Import(verb) => verb.run(&client, format).await,
        Verb::Rollout(verb) => verb.run(&client, format).await,
        Verb::Stub(verb) => verb.run(&client, format).await,
        Verb::Try(verb) => verb.run(&client, format).await,
        Verb::Calibrate(verb) => verb.run(&client, format).await,
        Verb::Eval(verb) => verb.run(&client, format).await,
        Verb::Explain(verb) => verb.run(&client, format).await,
        Verb::Fit(verb) => verb.run(&client, format).await,
        Verb::Pair(verb) => verb.run(&client, format).await,
        Verb::Unpair(verb) => verb.run(&client, format).await,
        Verb::Account(verb) => verb.run(&client, format).await,
        Verb::Token(verb) => verb.run(&client, format).await,
        Verb::Audit(verb) => verb.run(&client, format).await,
        Verb::Policy(verb) => verb.run(&client, format).await,
        Verb::Trust(verb) => verb.run(),
        Verb::Status(verb) => verb.run(&client, format).await,
        Verb::Doctor(verb) => verb.run(&client, format).await,
        Verb::Completions(_) | Verb::Man(_) => Ok(()),
    }
}

/// What went wrong, what explains it, and what to do.
fn complain(error: &anyhow::Error) {
    let Some(problem) = error.downcast_ref::<Problem>() else {
        output::complain(&format!("error: {error:#}"));
        return;
    };
    for line in &problem.log {
        output::complain(&format!("  | {line}"));
    }
    output::complain(&format!("error: {problem}"));
    if !problem.exists.is_empty() {
        output::complain(&format!("there are: {}", problem.exists.join(", ")));
    }
    if let Some(next) = &problem.next {
        output::complain(&format!("next: {next}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory;
        Arguments::command().debug_assert();
    }

    #[test]
    fn every_verb_explains_itself() {
        use clap::CommandFactory;
        for verb in Arguments::command().get_subcommands() {
            assert!(
                verb.get_about().is_some(),
                "{} has no help",
                verb.get_name()
            );
            for argument in verb.get_arguments() {
                assert!(
                    argument.get_help().is_some(),
                    "{} {} has no help",
                    verb.get_name(),
                    argument.get_id()
                );
            }
        }
    }

    #[test]
    fn the_format_may_stand_before_or_after_the_verb() {
        for line in [
            ["cloudroidctl", "--format", "json", "status"],
            ["cloudroidctl", "status", "--format", "json"],
        ] {
            assert_eq!(
                Arguments::try_parse_from(line).expect("valid").format,
                Format::Json
            );
        }
    }
}
