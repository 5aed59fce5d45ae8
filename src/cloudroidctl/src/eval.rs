//! `eval`: whether a package is worth outsourcing from a robot of some size, measured: the same requests on as many cores and as
//! much memory as the robot has, and outsourced, over the network from where this is typed.

mod check;
mod measure;
mod network;
mod plot;
mod probe;
mod robot;
mod shown;
mod side;
mod verdict;

use std::fs;
use std::io::IsTerminal;
use std::path::PathBuf;

use anyhow::{Context, bail};
use api::Size;
use bytes::Bytes;

use crate::calibrate::{agrees, check_place, write};
use crate::client::Client;
use crate::output::{self, Format};
use check::unusable;
use network::Network;
use robot::Class;
use verdict::Evaluation;

/// Evaluate a service on a recording: native on a robot of some size against outsourced, with phases, a verdict and an SLA.
///
/// Both are measured on this server, native with as many cores and as much memory as the robot has; outsourced requests go over the
/// network from where this is typed. Servants of its own are started, give way to robots, and are ended afterwards.
#[derive(Debug, clap::Args)]
pub struct Eval {
    /// The service; push a package first.
    #[arg(value_name = "PACKAGE")]
    service: String,
    /// A recording of its inputs: a rosbag file, not compressed. It is replayed at its own pace.
    #[arg(long, value_name = "FILE")]
    bag: PathBuf,
    /// What the robot has: pi is a quarter of a core and 1G, ultrabook half a core and 4G.
    #[arg(long, value_enum, default_value_t = Class::Pi)]
    robot: Class,
    /// The robot's cores, instead of those of its class.
    #[arg(long, value_name = "N", value_parser = robot::cores, allow_hyphen_values = true)]
    robot_cpus: Option<f64>,
    /// The robot's memory, instead of that of its class.
    #[arg(long, value_name = "BYTES", value_parser = robot::memory)]
    robot_memory: Option<Size>,
    /// Cores of the outsourced servant; by default those that it was pushed with, else one core, which the row promises then.
    #[arg(long, value_name = "N", value_parser = robot::cores, allow_hyphen_values = true)]
    cpus: Option<f64>,
    /// What a network adds to what is measured, where this is typed at the server itself: lan (1 ms each way, 100 Mbit/s), wan (30 ms,
    /// 20 Mbit/s), or milliseconds for each request.
    #[arg(long, value_name = "lan|wan|MS")]
    network: Option<Network>,
    /// Requests on each side, at most; 40 by default.
    #[arg(long, value_name = "N", value_parser = robot::requests)]
    requests: Option<usize>,
    /// Each request follows the last answer at once, instead of the recording's pace.
    #[arg(long)]
    fast: bool,
    /// The input whose messages are the requests; by default the recording's first topic that is an input.
    #[arg(long, value_name = "TOPIC")]
    input: Option<String>,
    /// The output whose messages are the answers over the network; by default that whose message comes first.
    #[arg(long, value_name = "TOPIC")]
    output: Option<String>,
    /// Where to draw the distribution of response times; SERVICE-evaluation.svg by default.
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Write the row of the dictionary without asking.
    #[arg(long)]
    yes: bool,
}

impl Eval {
    /// Measures both sides, shows, asks, writes.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let file =
            fs::read(&self.bag).with_context(|| format!("cannot read {}", self.bag.display()))?;
        let file = Bytes::from(file);
        // What cannot be replayed is told before anything is sent or started.
        let recorded = ros::bag::read(&file, probe::RECORDED)
            .map_err(|why| unusable(format!("{} cannot be replayed: {why}", self.bag.display())))?;
        let service = self.check(client).await?;
        self.check_room(client).await?;
        let plot = self
            .plot
            .clone()
            .unwrap_or_else(|| PathBuf::from(format!("{}-evaluation.svg", self.service)));
        check_place(&plot, "plot")?;
        let mut measured = tokio::select! {
            measured = self.measure(client, format, file, &recorded, &service) => measured?,
            _ = tokio::signal::ctrl_c() => bail!("cancelled; nothing was written"),
        };
        // What was measured is shown all the same.
        let drawn = fs::write(&plot, plot::draw(&measured))
            .with_context(|| format!("cannot write the plot {}", plot.display()));
        // In JSON all is one value.
        let is_written = self.yes && matches!(format, Format::Json);
        let written = match is_written {
            true => self.write(client, &mut measured).await.map(drop),
            false => Ok(()),
        };
        match format {
            Format::Json => output::json(&measured)?,
            Format::Table => shown::print(&measured, &plot)?,
        }
        if let Err(error) = drawn {
            output::complain(&format!("warning: {error:#}"));
        }
        if let Some(why) = &measured.outsourced.broken {
            bail!(
                "asking the servant over the network failed: {why}; what was measured before is shown"
            );
        }
        written?;
        match is_written {
            true => Ok(()),
            false => self.propose(client, format, measured).await,
        }
    }

    /// Writes the row that is suggested; numbers of others that promise the same limits.
    async fn write(&self, client: &Client, measured: &mut Evaluation) -> anyhow::Result<Vec<i64>> {
        let Some(sla) = &mut measured.sla else {
            return Ok(Vec::new());
        };
        let rows = write(client, &self.service, vec![sla.row.clone()]).await?;
        Ok(sla.note_written(&rows))
    }

    /// Writes the row, where there is one and who asked says yes.
    async fn propose(
        &self,
        client: &Client,
        format: Format,
        mut measured: Evaluation,
    ) -> anyhow::Result<()> {
        if measured.sla.is_none() {
            return Ok(());
        }
        let say = |words: &str| match format {
            Format::Json => Ok(()),
            Format::Table => output::line(words),
        };
        if !self.yes && !agrees(&self.service)? {
            // Who was asked knows how to answer.
            return say(match std::io::stdin().is_terminal() {
                true => "nothing was written",
                false => "nothing was written; --yes writes the row without asking",
            });
        }
        let name = &self.service;
        let others = self.write(client, &mut measured).await?;
        say(&format!(
            "1 row written; see it with: cloudroidctl sla list {name}"
        ))?;
        if others.is_empty() {
            return Ok(());
        }
        let others: Vec<String> = others.iter().map(i64::to_string).collect();
        let others = others.join(" ");
        say(&format!(
            "the dictionary has had rows for as many cores before ({others}); remove what is outdated with: cloudroidctl sla rm {name} {others}"
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_cannot_be_measured_are_usage_errors_that_name_the_option() {
        use clap::Parser;
        #[derive(Debug, Parser)]
        struct Line {
            #[command(flatten)]
            eval: Eval,
        }
        for (option, value, range) in [
            ("--robot-memory", "1", "16M or more"),
            ("--robot-cpus", "nan", "between 0.01 and 4096"),
            ("--robot-cpus", "-1", "between 0.01 and 4096"),
            ("--cpus", "0", "between 0.01 and 4096"),
            ("--requests", "0", "between 10 and 10000"),
        ] {
            let line = ["eval", "people", "--bag", "x.bag", option, value];
            let refused = Line::try_parse_from(line).expect_err(option);
            let told = refused.to_string();
            assert_eq!(refused.exit_code(), 2);
            assert!(told.contains(option) && told.contains(range), "{told}");
        }
    }
}
