//! `eval`: measures whether outsourcing a package from a robot of some size is worthwhile: the same requests with as
//! many cores and as much memory as the robot has, and outsourced over the network from this machine.

mod check;
mod measure;
mod network;
mod plot;
mod probe;
mod report;
mod robot;
mod side;
mod verdict;

use std::fs;
use std::io::IsTerminal;
use std::path::PathBuf;

use anyhow::{Context, bail};
use api::Size;
use bytes::Bytes;

use crate::calibrate::{check_writable, write_rows};
use crate::client::DaemonClient;
use crate::confirm;
use crate::output::{self, OutputFormat};
use check::invalid_input;
use network::AddedNetwork;
use robot::RobotClass;
use verdict::Evaluation;

/// Evaluate a service on a recording: compare it on a robot of some size with the outsourced one, with phases, a
/// verdict and an SLA.
///
/// Both are measured on the server: native with as many cores and as much memory as the robot has, outsourced with
/// requests over the network from this machine. Starts servants of its own, which give way to robots and are ended
/// afterwards.
#[derive(Debug, clap::Args)]
pub struct EvalArgs {
    /// Service to evaluate; its package must have been pushed.
    #[arg(value_name = "PACKAGE")]
    service: String,
    /// Recording of the service's inputs: an uncompressed rosbag file, replayed at its own rate.
    #[arg(long, value_name = "FILE")]
    bag: PathBuf,
    /// Class of the robot: pi has a quarter of a core and 1G of memory, ultrabook half a core and 4G.
    #[arg(long, value_enum, default_value_t = RobotClass::Pi)]
    robot: RobotClass,
    /// Cores of the robot (default: those of its class).
    #[arg(long, value_name = "N", value_parser = robot::cores, allow_hyphen_values = true)]
    robot_cpus: Option<f64>,
    /// Memory of the robot (default: that of its class).
    #[arg(long, value_name = "BYTES", value_parser = robot::memory)]
    robot_memory: Option<Size>,
    /// Cores of the outsourced servant (default: the limit it was pushed with, otherwise one core, which the entry
    /// then reserves).
    #[arg(long, value_name = "N", value_parser = robot::cores, allow_hyphen_values = true)]
    cpus: Option<f64>,
    /// Network to add to the measured times, when this is run on the server itself: lan (1 ms each way, 100 Mbit/s),
    /// wan (30 ms, 20 Mbit/s), or milliseconds per request.
    #[arg(long, value_name = "lan|wan|MS")]
    network: Option<AddedNetwork>,
    /// Largest number of requests on each side (default: 40).
    #[arg(long, value_name = "N", value_parser = robot::requests)]
    requests: Option<usize>,
    /// Send each request as soon as the previous one is answered, instead of at the recording's rate.
    #[arg(long)]
    fast: bool,
    /// Input whose messages are the requests (default: the recording's first topic that is an input).
    #[arg(long, value_name = "TOPIC")]
    input: Option<String>,
    /// Output whose messages are the answers over the network (default: the first one to publish).
    #[arg(long, value_name = "TOPIC")]
    output: Option<String>,
    /// Output file of the plot of response times (default: SERVICE-evaluation.svg).
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Write the entry to the SLA table without asking for confirmation.
    #[arg(long)]
    yes: bool,
}

impl EvalArgs {
    /// Measures both sides, prints the result and writes the row if that is confirmed.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let file = fs::read(&self.bag).with_context(|| format!("cannot read {}", self.bag.display()))?;
        let file = Bytes::from(file);
        // A recording that cannot be replayed is reported before anything is sent or started.
        let recorded = ros::bag::read(&file, probe::MAX_RECORDED)
            .map_err(|why| invalid_input(format!("{} cannot be replayed: {why}", self.bag.display())))?;
        let service = self.check(client).await?;
        self.check_capacity(client).await?;
        let plot = self.plot.clone().unwrap_or_else(|| PathBuf::from(format!("{}-evaluation.svg", self.service)));
        check_writable(&plot, "plot")?;
        let mut measured = tokio::select! {
            measured = self.measure(client, format, file, &recorded, &service) => measured?,
            _ = tokio::signal::ctrl_c() => bail!("cancelled; nothing was written"),
        };
        // The result is printed even if the plot cannot be written.
        let drawn = fs::write(&plot, plot::draw(&measured))
            .with_context(|| format!("cannot write the plot {}", plot.display()));
        // The JSON output is one value, which includes the written row.
        let is_written = self.yes && matches!(format, OutputFormat::Json);
        let written = if is_written { self.write_row(client, &mut measured).await.map(drop) } else { Ok(()) };
        match format {
            OutputFormat::Json => output::json(&measured)?,
            OutputFormat::Table => report::print(&measured, &plot)?,
        }
        if let Err(error) = drawn {
            output::eprint_line(&format!("warning: {error:#}"));
        }
        if let Some(why) = &measured.outsourced.broken {
            bail!(
                "sending requests to the servant over the network failed: {why}; shown is what was measured before \
                    that"
            );
        }
        written?;
        if is_written { Ok(()) } else { self.propose(client, format, measured).await }
    }

    /// Writes the suggested row; returns the ids of other rows for the same limits.
    async fn write_row(&self, client: &DaemonClient, measured: &mut Evaluation) -> anyhow::Result<Vec<i64>> {
        let Some(sla) = &mut measured.sla else {
            return Ok(Vec::new());
        };
        let rows = write_rows(client, &self.service, vec![sla.row.clone()]).await?;
        Ok(sla.mark_written(&rows))
    }

    /// Writes the suggested row, if there is one and this is confirmed.
    async fn propose(
        &self,
        client: &DaemonClient,
        format: OutputFormat,
        mut measured: Evaluation,
    ) -> anyhow::Result<()> {
        if measured.sla.is_none() {
            return Ok(());
        }
        let say = |words: &str| match format {
            OutputFormat::Json => Ok(()),
            OutputFormat::Table => output::line(words),
        };
        if !self.yes && !confirm::ask(format!("write these entries to the SLA table of {}?", self.service)).await? {
            // After a prompt there is no need to mention --yes.
            return say(if std::io::stdin().is_terminal() {
                "nothing was written"
            } else {
                "nothing was written; --yes writes the entry without asking"
            });
        }
        let name = &self.service;
        let others = self.write_row(client, &mut measured).await?;
        say(&format!("1 entry written; see it with: cloudroidctl sla list {name}"))?;
        if others.is_empty() {
            return Ok(());
        }
        let others: Vec<String> = others.iter().map(i64::to_string).collect();
        let others = others.join(" ");
        say(&format!(
            "the SLA table already had entries for the same number of cores ({others}); remove outdated ones with: \
                cloudroidctl sla rm {name} {others}"
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
            eval: EvalArgs,
        }
        for (option, value, range) in [
            ("--robot-memory", "1", "at least 16M"),
            ("--robot-cpus", "nan", "0.01 to 4096"),
            ("--robot-cpus", "-1", "0.01 to 4096"),
            ("--cpus", "0", "0.01 to 4096"),
            ("--requests", "0", "10 to 10000"),
        ] {
            let line = ["eval", "people", "--bag", "x.bag", option, value];
            let refused = Line::try_parse_from(line).expect_err(option);
            let told = refused.to_string();
            assert_eq!(refused.exit_code(), 2);
            assert!(told.contains(option) && told.contains(range), "{told}");
        }
    }
}
