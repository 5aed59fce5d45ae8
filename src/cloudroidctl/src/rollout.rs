//! `rollout`: how a service comes to its next revision.

use std::time::Duration;

use anyhow::bail;
use api::rollout::{Arm, Rollout as Shown, RolloutOrder, RolloutState, RolloutTerms, Share};

use crate::client::{Client, escaped};
use crate::output::{self, Format, Table};
use crate::wait::WaitFlag;

/// Show how a service comes to its next revision, promote or abort a canary, or begin with an earlier revision.
#[derive(Debug, clap::Args)]
pub struct Rollout {
    /// The service.
    service: String,
    #[command(flatten)]
    wait: WaitFlag,
    #[command(subcommand)]
    order: Option<Order>,
}

#[derive(Debug, Clone, clap::Subcommand)]
enum Order {
    /// Show how far it has come, and how the two revisions compare.
    Status,
    /// Make the canary the current revision.
    Promote,
    /// Take the canary back; its robots get the current revision when they connect again.
    Abort,
    /// Begin with a revision that was published before.
    Start {
        /// The revision.
        revision: u64,
        #[command(flatten)]
        terms: TermFlags,
    },
}

/// On which terms a revision takes another's place.
#[derive(Debug, Default, Clone, clap::Args)]
pub struct TermFlags {
    /// Robots that the revision serves first: 3 for the first three, 10% for a tenth of those that come. It is taken back by
    /// itself when it is worse than the revision before.
    #[arg(long, value_name = "ROBOTS")]
    canary: Option<Share>,
    /// By how much a canary may be worse: of its failures the difference to the revision before (0.1 are ten in a hundred), of its
    /// response times the part by which they are longer.
    #[arg(long, value_name = "PART", requires = "canary")]
    bound: Option<f64>,
    /// Requests of each revision before they are compared; 20 by default.
    #[arg(long, value_name = "N", requires = "canary")]
    samples: Option<u32>,
    /// Promote a canary that was not worse automatically after this time, such as 30m, once it has been asked as often as --samples
    /// says (default: only by hand).
    #[arg(long, value_name = "TIME", value_parser = time, requires = "canary")]
    promote_after: Option<Duration>,
    /// Time from becoming the current revision to the end of servants of other revisions, such as 10m; without it they
    /// stay until their robots leave.
    #[arg(long, value_name = "TIME", value_parser = time)]
    deadline: Option<Duration>,
}

impl TermFlags {
    /// What was said; none where nothing was.
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

/// `500ms`, `30s`, `5m`, `1h`, or a number of seconds.
fn time(text: &str) -> Result<Duration, String> {
    let end = text
        .find(|c: char| !c.is_ascii_digit() && c != '.')
        .unwrap_or(text.len());
    let (number, unit) = text.split_at(end);
    let factor = match unit {
        "ms" => 0.001,
        "s" | "" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        _ => f64::NAN,
    };
    let seconds = number.parse::<f64>().unwrap_or(f64::NAN) * factor;
    Duration::try_from_secs_f64(seconds)
        .map_err(|_| "write a number with ms, s, m or h, such as 10m".to_owned())
}

impl Rollout {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let path = format!("/api/v1/services/{}/rollout", escaped(&self.service));
        let order = match self.order.unwrap_or(Order::Status) {
            Order::Status => None,
            Order::Promote => Some(RolloutOrder::Promote),
            Order::Abort => Some(RolloutOrder::Abort),
            Order::Start { revision, terms } => Some(RolloutOrder::Start {
                revision,
                terms: terms.terms().unwrap_or_default(),
            }),
        };
        let rollout: Shown = match order {
            None => client.get(&path).await?,
            Some(order) => client.post(&path, &order).await?,
        };
        if self.wait.is_set() {
            let rollout = over(client, &self.service, self.wait).await?;
            return told(&rollout, format).and_then(|()| promoted(&rollout));
        }
        told(&rollout, format)
    }
}

fn told(rollout: &Shown, format: Format) -> anyhow::Result<()> {
    match format {
        Format::Json => output::json(rollout),
        Format::Table => show(rollout),
    }
}

/// A service's last rollout, once it is over.
pub async fn over(client: &Client, service: &str, wait: WaitFlag) -> anyhow::Result<Shown> {
    let path = &format!("/api/v1/services/{}/rollout", escaped(service));
    let look = || async move {
        let rollout: Shown = client.get(path).await?;
        let goes_on = matches!(rollout.state, RolloutState::Canary | RolloutState::Draining);
        let why = rollout.waits.as_ref().unwrap_or(&rollout.reason);
        let words = format!("{service} is at {}: {why}", rollout.state);
        Ok(if goes_on { Err(words) } else { Ok(rollout) })
    };
    wait.until(look).await
}

/// Fails where the candidate has not become the current revision.
pub fn promoted(rollout: &Shown) -> anyhow::Result<()> {
    let Shown {
        service, candidate, ..
    } = rollout;
    match rollout.state {
        RolloutState::Promoted => Ok(()),
        state => bail!(
            "revision {candidate} of {service} has not become the current one: {state}, {}",
            rollout.reason
        ),
    }
}

/// What is to come, and what it waits for.
fn next_in_words(rollout: &Shown) -> Vec<String> {
    let terms = &rollout.terms;
    let time = |seconds: f64| format!("{seconds} s");
    let mut words = Vec::new();
    if rollout.state == RolloutState::Canary {
        words.push(format!(
            "it is taken back when it is worse by more than {}, from {} requests of each revision on",
            terms.bound, terms.samples
        ));
        words.push(match (&rollout.waits, terms.promote_after) {
            (Some(waits), Some(_)) => format!(
                "its time to become the current revision has come, and it waits: {waits}"
            ),
            (_, Some(after)) => format!(
                "it becomes the current revision {} after it has begun, unless it is worse, once it has been asked {} times",
                time(after),
                terms.samples
            ),
            (_, None) => format!(
                "it becomes the current revision when you say: cloudroidctl rollout {} promote",
                rollout.service
            ),
        });
    }
    let is_to_end = matches!(rollout.state, RolloutState::Canary | RolloutState::Draining);
    if let Some(deadline) = terms.deadline.filter(|_| is_to_end) {
        words.push(format!(
            "servants of other revisions end {} after it has become the current one",
            time(deadline)
        ));
    }
    words
}

/// Also what a push of a canary ends with.
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
    let mut table = Table::new(&["REVISION", "SERVANTS", "REQUESTS", "MEDIAN", "95 %"]);
    for (revision, arm) in [rollout.stable, rollout.candidate].into_iter().zip(seen) {
        let failed = |all: u64, failed: u64| match failed {
            0 => all.to_string(),
            _ => format!("{all}, {failed} of them failed"),
        };
        let time =
            |millis: Option<f64>| millis.map_or_else(String::new, |ms| format!("{ms:.1} ms"));
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
        rollout: Rollout,
    }

    fn parse(line: &str) -> Result<Rollout, clap::Error> {
        let words = std::iter::once("rollout").chain(line.split_whitespace());
        Line::try_parse_from(words).map(|line| line.rollout)
    }

    #[test]
    fn terms_are_read_as_they_are_typed() {
        let line =
            "s start 3 --canary 10% --bound 0.2 --samples 5 --deadline 10m --promote-after 500ms";
        let Some(Order::Start { revision, terms }) = parse(line).expect("valid").order else {
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
