//! `rollout`: transition of a service to another revision.

use std::time::Duration;

use anyhow::bail;
use api::rollout::{Arm, Rollout as Shown, RolloutOrder, RolloutState, RolloutTerms, Share};

use crate::client::{DaemonClient, percent_encode};
use crate::output::{self, OutputFormat, Table, count};
use crate::wait::WaitFlag;

/// Show the rollout of a service's next revision, promote or abort a canary, or start a rollout of an earlier revision.
#[derive(Debug, clap::Args)]
pub struct RolloutArgs {
    /// Service that is rolled out.
    service: String,
    #[command(flatten)]
    wait: WaitFlag,
    #[command(subcommand)]
    order: Option<RolloutCommand>,
}

#[derive(Debug, Clone, clap::Subcommand)]
enum RolloutCommand {
    /// Show the progress and the comparison of the two revisions.
    Status,
    /// Make the canary the current revision.
    Promote,
    /// Abort the canary; its robots get the current revision when they connect again.
    Abort,
    /// Start a rollout of a published revision.
    Start {
        /// Revision to roll out.
        revision: u64,
        #[command(flatten)]
        terms: TermFlags,
    },
}

/// Terms on which a revision replaces another.
#[derive(Debug, Default, Clone, clap::Args)]
pub struct TermFlags {
    /// Robots that the new revision serves first: 3 for the first three, 10% for a tenth of the robots that connect. It
    /// is aborted automatically if it is worse than the previous revision.
    #[arg(long, value_name = "ROBOTS")]
    canary: Option<Share>,
    /// Allowed regression of a canary (default: 0.1, which is 10 %): difference of the failure rates, and relative
    /// increase of the response times.
    #[arg(long, value_name = "PART", requires = "canary")]
    bound: Option<f64>,
    /// Number of requests of each revision before they are compared (default: 20).
    #[arg(long, value_name = "N", requires = "canary")]
    samples: Option<u32>,
    /// Promote a canary that is not worse automatically after this time, such as 30m, once it has served --samples
    /// requests (default: only by hand).
    #[arg(long, value_name = "TIME", value_parser = time, requires = "canary")]
    promote_after: Option<Duration>,
    /// Time after the promotion until servants of other revisions are ended, such as 10m (default: when their robots
    /// disconnect).
    #[arg(long, value_name = "TIME", value_parser = time)]
    deadline: Option<Duration>,
}

impl TermFlags {
    /// Returns the terms, or `None` if no flag is given.
    pub fn terms(&self) -> Option<RolloutTerms> {
        let of = RolloutTerms::default();
        let terms = RolloutTerms {
            canary: self.canary,
            bound: self.bound.unwrap_or(of.bound),
            samples: self.samples.unwrap_or(of.samples),
            deadline: self.deadline.map(|time| time.as_secs_f64()),
            promote_after: self.promote_after.map(|time| time.as_secs_f64()),
        };
        (terms != of).then_some(terms)
    }
}

/// Parses `500ms`, `30s`, `5m`, `1h`, or a number of seconds.
fn time(text: &str) -> anyhow::Result<Duration> {
    let end = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (number, unit) = text.split_at(end);
    let factor = match unit {
        "ms" => 0.001,
        "s" | "" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => f64::NAN,
    };
    let seconds = number.parse::<f64>().unwrap_or(f64::NAN) * factor;
    let Ok(time) = Duration::try_from_secs_f64(seconds) else {
        bail!("write a number with ms, s, m or h, such as 10m");
    };
    Ok(time)
}

impl RolloutArgs {
    /// Sends the request and prints the rollout.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let path = format!("/api/v1/services/{}/rollout", percent_encode(&self.service));
        let order = match self.order.unwrap_or(RolloutCommand::Status) {
            RolloutCommand::Status => None,
            RolloutCommand::Promote => Some(RolloutOrder::Promote),
            RolloutCommand::Abort => Some(RolloutOrder::Abort),
            RolloutCommand::Start { revision, terms } => {
                Some(RolloutOrder::Start { revision, terms: terms.terms().unwrap_or_default() })
            }
        };
        let rollout: Shown = match order {
            None => client.get(&path).await?,
            Some(order) => client.post(&path, &order).await?,
        };
        if self.wait.is_set() {
            let rollout = wait_until_over(client, &self.service, self.wait).await?;
            return print_rollout(&rollout, format).and_then(|()| require_promoted(&rollout));
        }
        print_rollout(&rollout, format)
    }
}

fn print_rollout(rollout: &Shown, format: OutputFormat) -> anyhow::Result<()> {
    match format {
        OutputFormat::Json => output::json(rollout),
        OutputFormat::Table => show(rollout),
    }
}

/// Returns a service's last rollout when it has ended.
pub async fn wait_until_over(client: &DaemonClient, service: &str, wait: WaitFlag) -> anyhow::Result<Shown> {
    let path = &format!("/api/v1/services/{}/rollout", percent_encode(service));
    let look = || async move {
        let rollout: Shown = client.get(path).await?;
        let goes_on = matches!(rollout.state, RolloutState::Canary | RolloutState::Draining);
        let why = rollout.waits.as_ref().unwrap_or(&rollout.reason);
        let words = format!("{service} is at {}: {why}", rollout.state);
        Ok(if goes_on { Err(words) } else { Ok(rollout) })
    };
    wait.poll_until(look).await
}

/// Fails unless the candidate has become the current revision.
pub fn require_promoted(rollout: &Shown) -> anyhow::Result<()> {
    let Shown { service, candidate, .. } = rollout;
    match rollout.state {
        RolloutState::Promoted => Ok(()),
        state => bail!("revision {candidate} of {service} was not promoted: {state}, {}", rollout.reason),
    }
}

/// Returns the next steps and their conditions in words.
fn next_in_words(rollout: &Shown) -> Vec<String> {
    let terms = &rollout.terms;
    let time = |seconds: f64| format!("{seconds} s");
    let mut words = Vec::new();
    if rollout.state == RolloutState::Canary {
        words.push(format!(
            "rolled back when worse by more than {}, after at least {} to each revision",
            terms.bound,
            count(terms.samples, "request")
        ));
        words.push(match (&rollout.waits, terms.promote_after) {
            (Some(waits), Some(_)) => format!("its promotion is due but waits: {waits}"),
            (_, Some(after)) => format!(
                "promoted {} after its start, unless it is worse, and after at least {}",
                time(after),
                count(terms.samples, "request")
            ),
            (_, None) => format!("promote it with: cloudroidctl rollout {} promote", rollout.service),
        });
    }
    let is_to_end = matches!(rollout.state, RolloutState::Canary | RolloutState::Draining);
    if let Some(deadline) = terms.deadline.filter(|_| is_to_end) {
        words.push(format!("servants of other revisions end {} after the promotion", time(deadline)));
    }
    words
}

/// Prints a rollout. Also used by a push of a canary.
pub fn show(rollout: &Shown) -> anyhow::Result<()> {
    output::line(&format!(
        "{}, revision {} after {}: {}, {} ago: {}",
        rollout.service,
        rollout.candidate,
        rollout.stable,
        rollout.state,
        output::age(rollout.changed),
        rollout.reason
    ))?;
    for words in next_in_words(rollout) {
        output::line(&format!("  {words}"))?;
    }
    let seen = [&rollout.of_stable, &rollout.of_candidate];
    let is_canary = rollout.state == RolloutState::Canary;
    if !is_canary && seen.iter().all(|arm| **arm == Arm::default()) {
        return Ok(());
    }
    let mut table = Table::new(&["REVISION", "SERVANTS", "REQUESTS", "P50", "P95"]);
    for (revision, arm) in [rollout.stable, rollout.candidate].into_iter().zip(seen) {
        let failed = |all: u64, failed: u64| match failed {
            0 => all.to_string(),
            _ => format!("{all}, {failed} of them failed"),
        };
        let time = |millis: Option<f64>| millis.map_or_else(String::new, |ms| format!("{ms:.1} ms"));
        table.row([
            revision.to_string(),
            failed(arm.servants, arm.servants_failed),
            failed(arm.requests, arm.requests_failed),
            time(arm.p50),
            time(arm.p95),
        ]);
    }
    output::line("")?;
    table.print()
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        rollout: RolloutArgs,
    }

    fn parse(line: &str) -> Result<RolloutArgs, clap::Error> {
        let words = std::iter::once("rollout").chain(line.split_whitespace());
        Line::try_parse_from(words).map(|line| line.rollout)
    }

    #[test]
    fn terms_are_read_as_they_are_typed() {
        let line = "s start 3 --canary 10% --bound 0.2 --samples 5 --deadline 10m --promote-after 500ms";
        let Some(RolloutCommand::Start { revision, terms }) = parse(line).expect("valid").order else {
            panic!("it begins");
        };
        let expected = RolloutTerms {
            canary: Some(Share::Percent(10.0)),
            bound: 0.2,
            samples: 5,
            deadline: Some(600.0),
            promote_after: Some(0.5),
        };
        assert_eq!((revision, terms.terms()), (3, Some(expected)));
        assert!(parse("s").expect("valid").order.is_none());
        for line in [
            "",
            "s begin",
            "s start",
            "s start 3 --canary none",
            "s start 3 --bound 0.1",
            "s start 3 --deadline soon",
            "s start 3 --deadline -1s",
        ] {
            assert_eq!(parse(line).expect_err(line).exit_code(), 2, "{line}");
        }
    }
}
