//! `eval`: whether a package is worth outsourcing from a robot of some size, measured: the same requests on as many cores and as
//! much memory as the robot has, and outsourced, over the network from where this is typed.

mod network;
mod plot;
mod probe;
mod robot;
mod shown;
mod side;
mod verdict;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use api::calibration::{OUT_OF_MEMORY, Point};
use api::interface::Direction;
use api::{Calibration, CalibrationEvent, CalibrationOptions, Problem, ServiceDetail, Size};
use bytes::Bytes;
use futures_util::StreamExt;
use http_body_util::{BodyExt, Full};
use hyper::Method;

use crate::calibrate::{agrees, check_place, write};
use crate::client::{self, Client, escaped};
use crate::output::{self, Format};
use network::Network;
use probe::{Asked, Probe};
use robot::{Class, Robot};
use side::Side;
use verdict::Evaluation;

/// Seconds for which the outsourced servant stays for what is asked over the network: each request may take as long as the
/// daemon waits for one.
const KEEP: f64 = 180.0;

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
    #[arg(long, value_name = "N")]
    robot_cpus: Option<f64>,
    /// The robot's memory, instead of that of its class.
    #[arg(long, value_name = "BYTES")]
    robot_memory: Option<Size>,
    /// Cores of the outsourced servant; by default those that it was pushed with, else one core, which the row promises then.
    #[arg(long, value_name = "N")]
    cpus: Option<f64>,
    /// What a network adds to what is measured, where this is typed at the server itself: lan (1 ms each way, 100 Mbit/s), wan (30 ms,
    /// 20 Mbit/s), or milliseconds for each request.
    #[arg(long, value_name = "lan|wan|MS")]
    network: Option<Network>,
    /// Requests on each side, at most; 40 by default.
    #[arg(long, value_name = "N")]
    requests: Option<usize>,
    /// Each request follows the last answer at once, instead of the recording's pace.
    #[arg(long)]
    fast: bool,
    /// The input whose messages are the requests; by default the recording's first topic that is an input.
    #[arg(long, value_name = "TOPIC")]
    input: Option<String>,
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
            .with_context(|| format!("{} cannot be replayed", self.bag.display()))?;
        let service = self.check(client).await?;
        let plot = self
            .plot
            .clone()
            .unwrap_or_else(|| PathBuf::from(format!("{}-evaluation.svg", self.service)));
        check_place(&plot, "plot")?;
        let measured = tokio::select! {
            measured = self.measure(client, format, file, &recorded, &service) => measured?,
            _ = tokio::signal::ctrl_c() => bail!("cancelled; nothing was written"),
        };
        // What was measured is shown all the same.
        let drawn = fs::write(&plot, plot::draw(&measured))
            .with_context(|| format!("cannot write the plot {}", plot.display()));
        match format {
            Format::Json => output::json(&measured)?,
            Format::Table => shown::print(&measured, &plot)?,
        }
        if let Err(error) = drawn {
            output::complain(&format!("warning: {error:#}"));
        }
        self.propose(client, format, measured).await
    }

    /// Writes the row, where there is one and who asked says yes.
    async fn propose(
        &self,
        client: &Client,
        format: Format,
        measured: Evaluation,
    ) -> anyhow::Result<()> {
        let Some(sla) = measured.sla else {
            return Ok(());
        };
        let say = |words: &str| match format {
            Format::Json => Ok(()),
            Format::Table => output::line(words),
        };
        if !self.yes && !agrees(&self.service)? {
            return say("nothing was written; --yes writes the row without asking");
        }
        write(client, &self.service, vec![sla.row]).await?;
        say(&format!(
            "1 row written; see it with: cloudroidctl sla list {}",
            self.service
        ))
    }

    /// The service, where a recording can hold its requests.
    async fn check(&self, client: &Client) -> anyhow::Result<ServiceDetail> {
        let name = &self.service;
        let path = Path::new(name);
        // A service may have the name of a directory that lies here.
        if name.contains('/') || matches!(&**name, "." | "..") {
            bail!(
                "{name} is a directory, and services are evaluated: publish it first with: cloudroidctl push {name}; \
                 then: cloudroidctl eval NAME --bag {}",
                self.bag.display()
            );
        }
        let address = format!("/api/v1/services/{}", escaped(name));
        let asked = client.get(&address).await;
        let service: ServiceDetail = asked.map_err(unpublished(name, path.is_dir()))?;
        let interface = &service.interface;
        let is_fed = |topic: &api::interface::Topic| topic.direction == Direction::Input;
        if !interface.topics.iter().any(is_fed) {
            let calls: Vec<&str> = interface
                .services
                .iter()
                .map(|service| service.name.as_str())
                .chain(interface.actions.iter().map(|action| action.name.as_str()))
                .collect();
            match calls.is_empty() {
                true => bail!("{name} has no inputs, so that there is nothing to ask it"),
                false => bail!(
                    "requests of {name} are calls and goals ({}), and a recording holds messages of topics alone: measure them at their \
                     robot with: cloudroidctl explain ROBOT; and write rows with: cloudroidctl sla set --spread",
                    calls.join(", ")
                ),
            }
        }
        Ok(service)
    }

    async fn measure(
        &self,
        client: &Client,
        format: Format,
        file: Bytes,
        recorded: &[ros::bag::Recorded],
        service: &ServiceDetail,
    ) -> anyhow::Result<Evaluation> {
        let robot = Robot::new(self.robot, self.robot_cpus, self.robot_memory);
        let tell = |words: &str| match format {
            Format::Json => Ok(()),
            Format::Table => output::line(words),
        };
        tell(&format!("== native: as on {robot}"))?;
        let options = CalibrationOptions {
            cpus: vec![robot.cpus],
            memory: Some(robot.memory),
            ..self.options()
        };
        let native = match self.ask(client, options, file.clone(), &tell).await {
            Ok(measured) => Side::native(&measured.calibration, measured.times, &robot),
            Err(error) => Side::starved(&robot, out_of_memory(error)?),
        };
        tell("== outsourced")?;
        let options = CalibrationOptions {
            cpus: self.cpus.into_iter().collect(),
            own: self.cpus.is_none(),
            keep: Some(KEEP),
            ..self.options()
        };
        // Its servant lives for as long as this does.
        let measured = self.ask(client, options, file, &tell).await?;
        let asked = match &measured.servant {
            Some(servant) if answers(&measured.calibration) => {
                tell("   the same over the network, from here")?;
                let probe = Probe {
                    service,
                    calibration: &measured.calibration,
                    recorded,
                    input: self.input.as_deref(),
                    fast: self.fast,
                    requests: self.requests.unwrap_or(probe::REQUESTS),
                };
                probe.ask(client, servant).await?
            }
            // Nor would it answer from here.
            _ => Asked::unanswered(point(&measured.calibration).requests),
        };
        let outsourced = Side::outsourced(&measured.calibration, &asked, self.network);
        Ok(Evaluation::new(
            &measured.calibration,
            self.bag.display().to_string(),
            robot,
            (native, outsourced),
            self.network,
        ))
    }

    fn options(&self) -> CalibrationOptions {
        CalibrationOptions {
            requests: self.requests,
            fast: self.fast,
            input: self.input.clone(),
            times: true,
            ..CalibrationOptions::default()
        }
    }

    /// Has the daemon measure at one limit; the servant stays until what is returned is dropped, where it was to be kept.
    async fn ask(
        &self,
        client: &Client,
        options: CalibrationOptions,
        file: Bytes,
        tell: &dyn Fn(&str) -> anyhow::Result<()>,
    ) -> anyhow::Result<Measured> {
        let path = format!(
            "/api/v1/services/{}/calibration?options={}",
            escaped(&self.service),
            escaped(&serde_json::to_string(&options)?)
        );
        let body = Full::new(file)
            .map_err(|never| match never {})
            .boxed_unsync();
        let answer = client.send(Method::POST, &path, body).await?;
        let mut events = Box::pin(client::lines(answer));
        let mut measured = Vec::new();
        while let Some(event) = events.next().await {
            let (calibration, servant) = match event? {
                CalibrationEvent::Done { calibration } => (calibration, None),
                CalibrationEvent::Kept {
                    servant,
                    calibration,
                } => (calibration, Some(servant)),
                CalibrationEvent::Error { problem } => return Err(problem.into()),
                CalibrationEvent::Step { title } => {
                    tell(&format!("   {title}"))?;
                    continue;
                }
                CalibrationEvent::Measured { times, .. } => {
                    measured = times;
                    continue;
                }
            };
            return Ok(Measured {
                calibration: *calibration,
                times: measured,
                servant,
                _events: events,
            });
        }
        bail!("the daemon broke off the measurement; nothing was written")
    }
}

/// What the daemon has measured at one limit.
struct Measured {
    calibration: Calibration,
    /// Of requests that were answered, in milliseconds.
    times: Vec<f64>,
    /// It stays for as long as the events are there.
    servant: Option<String>,
    _events: std::pin::Pin<Box<dyn futures_util::Stream<Item = anyhow::Result<CalibrationEvent>>>>,
}

/// At the only limit.
fn point(calibration: &Calibration) -> Point {
    calibration.points.first().copied().unwrap_or_default()
}

fn answers(calibration: &Calibration) -> bool {
    point(calibration).answered > 0
}

/// Why the kernel has ended a servant; every other error is none of the robot's.
fn out_of_memory(error: anyhow::Error) -> anyhow::Result<String> {
    match error.downcast_ref::<Problem>() {
        Some(problem) if problem.kind == OUT_OF_MEMORY => Ok(problem.detail.clone()),
        _ => Err(error),
    }
}

/// What to do about a service that is not there.
fn unpublished(name: &str, is_directory: bool) -> impl FnOnce(anyhow::Error) -> anyhow::Error {
    let next = match is_directory {
        true => format!(
            "{name} is a directory here, and services are evaluated: publish it first with: cloudroidctl push {name}; or name one of those"
        ),
        false => format!(
            "name one of those, or publish the package first: cloudroidctl push DIRECTORY --name {name} (--apt {name}, where Debian has it)"
        ),
    };
    move |error| match error.downcast::<Problem>() {
        Ok(problem) if problem.status == 404 => Problem {
            next: Some(next),
            ..problem
        }
        .into(),
        Ok(problem) => problem.into(),
        Err(error) => error,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn want_of_memory_is_an_answer_and_other_problems_are_not() {
        let problem = |kind: &str| Problem {
            kind: kind.to_owned(),
            detail: "needs more than 1G".to_owned(),
            ..Problem::default()
        };
        let told = out_of_memory(problem("urn:cloudroid:out-of-memory").into());
        assert_eq!(told.expect("an answer"), "needs more than 1G");
        out_of_memory(problem("urn:cloudroid:full").into()).expect_err("no answer");
        out_of_memory(anyhow::anyhow!("broken")).expect_err("no answer");
    }

    #[test]
    fn an_unknown_service_is_to_be_pushed() {
        let of = |status, is_directory| {
            let problem = Problem {
                status,
                next: Some("see the list".to_owned()),
                ..Problem::default()
            };
            let told = unpublished("people", is_directory)(problem.into());
            told.downcast::<Problem>()
                .expect("a problem")
                .next
                .unwrap_or_default()
        };
        assert!(of(404, false).contains("cloudroidctl push DIRECTORY --name people"));
        assert!(of(404, true).contains("people is a directory here"));
        assert_eq!(of(403, true), "see the list");
    }
}
