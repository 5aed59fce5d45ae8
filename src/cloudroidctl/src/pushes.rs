//! `pushes`: pushes that run on the server, and those that ended lately.

use anyhow::bail;
use api::{Problem, PushEvent, PushState, PushStatus};
use futures_util::StreamExt;

use crate::client::DaemonClient;
use crate::output::{self, OutputFormat, Table};
use crate::push::progress;

/// Number of ended pushes that are listed without `--all`.
const MAX_LISTED_ENDED: usize = 10;

/// List pushes: who pushes what, at which step it is, and for how long.
///
/// The server continues a push without its client. Whoever may see a service sees its pushes; whoever started a push,
/// operators and admins may cancel it.
#[derive(Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true)]
pub struct PushesArgs {
    /// Also list pushes that ended long ago; the server keeps 100, for 14 days.
    #[arg(long)]
    all: bool,
    #[command(subcommand)]
    verb: Option<PushesCommand>,
}

#[derive(Debug, clap::Subcommand)]
enum PushesCommand {
    Logs(PushLogs),
    Cancel(CancelPush),
}

/// Print what a push printed, also of one that has ended.
#[derive(Debug, clap::Args)]
struct PushLogs {
    /// Number of the push.
    number: u64,
    /// Keep printing until the push ends, with the exit status that push would have had.
    #[arg(short, long)]
    follow: bool,
}

/// Cancel a push; it ends when its containers and files are removed.
#[derive(Debug, clap::Args)]
struct CancelPush {
    /// Number of the push.
    number: u64,
}

impl PushesArgs {
    /// Sends the request and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        match self.verb {
            None => list(client, format, self.all).await,
            Some(PushesCommand::Logs(verb)) => verb.run(client, format).await,
            Some(PushesCommand::Cancel(verb)) => verb.run(client, format).await,
        }
    }
}

async fn list(client: &DaemonClient, format: OutputFormat, all: bool) -> anyhow::Result<()> {
    let mut pushes: Vec<PushStatus> = client.get("/api/v1/pushes").await?;
    if !all {
        let mut ended = 0;
        pushes.retain(|push| {
            ended += usize::from(push.state != PushState::Running);
            push.state == PushState::Running || ended <= MAX_LISTED_ENDED
        });
    }
    if format == OutputFormat::Json {
        return output::json(&pushes);
    }
    let mut table = Table::new(&["NUMBER", "STATE", "SERVICE", "WHAT", "WHO", "BEGAN", "STEP"]);
    for push in pushes {
        table.row([
            push.number.to_string(),
            push.state.name().to_owned(),
            push.service.clone().unwrap_or_else(|| "-".to_owned()),
            push.source.clone(),
            push.by.clone(),
            format!("{} ago", output::age(push.began)),
            format_step(&push),
        ]);
    }
    table.print_list("no pushes that you may see; push a package with: cloudroidctl push PATH")
}

/// Describes where a push is, or why it failed.
fn format_step(push: &PushStatus) -> String {
    if let Some(message) = &push.message {
        return message.clone();
    }
    let Some(began) = push.step_began.filter(|_| push.state == PushState::Running) else {
        return String::new();
    };
    let mut parts = vec![output::age(began)];
    if let Some(count) = &push.progress {
        parts.push(progress::format_count(&count.unit, count.done, count.total));
    }
    let last = push.last_took.map(progress::format_last).unwrap_or_default();
    format!("{}: {}{last}", push.step, parts.join(", "))
}

impl PushLogs {
    async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let path = format!("/api/v1/pushes/{}/output?follow={}", self.number, self.follow);
        let mut events = client.get_lines::<PushEvent>(&path).await?;
        let mut is_over = false;
        while let Some(event) = events.next().await {
            let event = event?;
            if format == OutputFormat::Json {
                output::json_line(&event)?;
            } else {
                print(&event)?;
            }
            match event {
                PushEvent::Error { problem } if self.follow => return Err(problem.into()),
                PushEvent::Error { .. } | PushEvent::Done { .. } | PushEvent::Underlay { .. } => is_over = true,
                _ => {}
            }
        }
        if self.follow && !is_over {
            bail!("push {} did not end as long as it was followed; see cloudroidctl pushes", self.number);
        }
        Ok(())
    }
}

impl CancelPush {
    async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let number = self.number;
        let push: PushStatus = client.delete(&format!("/api/v1/pushes/{number}")).await?;
        let path = format!("/api/v1/pushes/{number}/output?follow=true");
        let mut events = client.get_lines::<PushEvent>(&path).await?;
        while let Some(event) = events.next().await {
            if let PushEvent::Done { .. } | PushEvent::Underlay { .. } = event? {
                bail!("push {number} was published before it could be cancelled");
            }
        }
        match format {
            OutputFormat::Json => output::json(&PushStatus { state: PushState::Cancelled, can_cancel: false, ..push }),
            OutputFormat::Table => output::line(&format!("cancelled push {number}; nothing was published")),
        }
    }
}

fn print(event: &PushEvent) -> anyhow::Result<()> {
    match event {
        PushEvent::Step { title, .. } => output::line(&format!("== {title}")),
        PushEvent::Log { line } => output::line(&format!("  | {line}")),
        PushEvent::Warning { message } => output::line(&format!("warning: {message}")),
        PushEvent::Done { service, took, unchanged, .. } => {
            let outcome = if *unchanged { "unchanged:" } else { "published" };
            output::line(&format!("== {outcome} {} in {:.1} s", service.summary.name, *took as f64 / 1000.0))
        }
        PushEvent::Underlay { underlay, took, unchanged, .. } => {
            let outcome = if *unchanged { "unchanged:" } else { "published" };
            output::line(&format!("== {outcome} underlay {} in {:.1} s", underlay.name, *took as f64 / 1000.0))
        }
        PushEvent::Error { problem: Problem { detail, .. } } => output::line(&format!("== failed: {detail}")),
        PushEvent::Accepted { .. } | PushEvent::Progress { .. } => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use api::PushCount;
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        pushes: PushesArgs,
    }

    #[test]
    fn a_number_says_which_push() {
        let parse = |line: &str| Line::try_parse_from(std::iter::once("pushes").chain(line.split_whitespace()));
        for line in ["", "--all", "logs 7", "logs 7 --follow", "logs -f 7", "cancel 7"] {
            parse(line).expect(line);
        }
        for line in ["logs", "cancel", "cancel maps", "7"] {
            assert_eq!(parse(line).expect_err(line).exit_code(), 2, "{line}");
        }
    }

    #[test]
    fn a_step_is_told_with_its_progress_and_its_last_duration() {
        let mut push = PushStatus {
            number: 1,
            service: None,
            source: "./maps".into(),
            by: "ada".into(),
            state: PushState::Running,
            began: 0,
            ended: None,
            step: "installing 9 packages".into(),
            step_began: Some(0),
            last_took: Some(102_000),
            progress: Some(PushCount { unit: "packages".into(), done: 3, total: Some(9) }),
            message: None,
            can_read: true,
            can_cancel: true,
        };
        let told = format_step(&push);
        assert!(told.starts_with("installing 9 packages: "), "{told}");
        assert!(told.ends_with(", 3 of 9 packages (last time 102 s)"), "{told}");
        push.message = Some("it broke".into());
        assert_eq!(format_step(&push), "it broke");
    }
}
