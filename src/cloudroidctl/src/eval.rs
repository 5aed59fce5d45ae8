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
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, bail};
use api::calibration::{OUT_OF_MEMORY, Point};
use api::interface::Direction;
use api::{
    Calibration, CalibrationEvent, CalibrationOptions, Problem, Servant, ServiceDetail, Size,
};
use bytes::Bytes;
use futures_util::StreamExt;
use http_body_util::{BodyExt, Full};
use hyper::Method;

use crate::calibrate::{agrees, check_place, in_a_line, write};
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
/// How often, and how often at most, it is looked whether its servant has gone.
const LOOK: Duration = Duration::from_millis(50);
const LOOKS: usize = 200;

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

    /// Refuses cores that no servant here can have, before minutes of measuring.
    async fn check_room(&self, client: &Client) -> anyhow::Result<()> {
        for (flag, cpus) in [("--robot-cpus", self.robot_cpus), ("--cpus", self.cpus)] {
            let Some(cpus) = cpus else { continue };
            let path = format!(
                "/api/v1/services/{}/fit?cpus={cpus}",
                escaped(&self.service)
            );
            // What robots may ask for is no matter here; what cannot be said is said when it is measured.
            let fit = client.get::<api::Fit>(&path).await;
            let never = fit
                .ok()
                .and_then(|fit| fit.never)
                .filter(|why| is_too_big(why));
            if let Some(why) = never {
                return Err(Problem {
                    status: 422,
                    detail: format!("{flag} {cpus} cannot be measured, now and later: {why}"),
                    next: Some(format!("name fewer with {flag}")),
                    ..Problem::default()
                }
                .into());
            }
        }
        Ok(())
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
        if let Some(named) = &self.output {
            let outputs = interface.topics.iter();
            let outputs = outputs.filter(|topic| topic.direction == Direction::Output);
            let outputs: Vec<&str> = outputs.map(|topic| topic.name.as_str()).collect();
            if !outputs.contains(&named.as_str()) {
                return Err(unusable(format!(
                    "{name} has no output {named}; its outputs are: {}",
                    outputs.join(", ")
                )));
            }
        }
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
            Err(error) => Side::starved(&robot, out_of_memory(for_robot(error))?),
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
        let servant = measured.servant.as_deref();
        let place = servant.map(|servant| format!("/api/v1/servants/{}", escaped(servant)));
        let limits = limits(client, place.as_deref()).await;
        let asked = match &measured.servant {
            Some(servant) if answers(&measured.calibration) => {
                tell("   the same over the network, from here")?;
                let probe = Probe {
                    service,
                    calibration: &measured.calibration,
                    recorded,
                    input: self.input.as_deref(),
                    output: self.output.as_deref(),
                    fast: self.fast,
                    requests: self.requests.unwrap_or(probe::REQUESTS),
                };
                match probe.ask(client, servant).await {
                    Ok(asked) => asked,
                    Err(error) => Asked::broken(format!("{error:#}")),
                }
            }
            // Nor would it answer from here.
            _ => Asked::unanswered(point(&measured.calibration).requests),
        };
        let now = self::limits(client, place.as_deref()).await;
        if now.is_some() && now != limits {
            bail!(
                "somebody has changed the limits of the servant while it was measured; evaluate again"
            );
        }
        let mut outsourced = Side::outsourced(&measured.calibration, &asked, self.network);
        outsourced.memory_limit = limits.and_then(|limits| limits.memory);
        if let Some(rrt) = outsourced.rrt {
            tell(&format!(
                "   {} of {} answered: {:.1} ms (median), {:.1} ms (95 %)",
                outsourced.answered, outsourced.requests, rrt.p50, rrt.p95
            ))?;
        }
        // Whoever evaluates next finds the room that this had.
        let Measured {
            calibration,
            events,
            ..
        } = measured;
        drop(events);
        if let Some(place) = &place {
            gone(client, place).await;
        }
        Ok(Evaluation::new(
            &calibration,
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
                CalibrationEvent::Measured { times, point } => {
                    tell(&format!("   {}", in_a_line(&point)))?;
                    measured = times;
                    continue;
                }
            };
            return Ok(Measured {
                calibration: *calibration,
                times: measured,
                servant,
                events,
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
    events: std::pin::Pin<Box<dyn futures_util::Stream<Item = anyhow::Result<CalibrationEvent>>>>,
}

/// What a servant is limited to, where it is there.
async fn limits(client: &Client, place: Option<&str>) -> Option<api::Limits> {
    let servant = client.get::<Servant>(place?).await;
    servant.ok().map(|servant| servant.limits)
}

/// Comes back when the servant has gone, or is not told to go.
async fn gone(client: &Client, place: &str) {
    for _ in 0..LOOKS {
        if client.get::<Servant>(place).await.is_err() {
            return;
        }
        tokio::time::sleep(LOOK).await;
    }
}

/// What cannot be used as it is given.
fn unusable(detail: String) -> anyhow::Error {
    Problem {
        status: 400,
        detail,
        ..Problem::default()
    }
    .into()
}

/// Whether it is the machine that is too small, of all reasons why a servant is never admitted.
fn is_too_big(why: &str) -> bool {
    why.contains("does not fit on this machine")
}

/// A problem of the side that stands for the robot names the option that is its.
fn for_robot(error: anyhow::Error) -> anyhow::Error {
    let named = |words: String| words.replace(" --cpus", " --robot-cpus");
    match error.downcast::<Problem>() {
        Ok(problem) => Problem {
            detail: named(problem.detail),
            next: problem.next.map(named),
            ..problem
        }
        .into(),
        Err(error) => error,
    }
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
    fn what_the_robot_cannot_have_is_named_by_its_own_option() {
        let problem = Problem {
            detail: "there is no room; name smaller limits with --cpus".into(),
            next: Some("push it with smaller --cpus".into()),
            ..Problem::default()
        };
        let told = for_robot(problem.into());
        let told = told.downcast::<Problem>().expect("a problem");
        assert!(told.detail.ends_with("with --robot-cpus"), "{told}");
        assert_eq!(
            told.next.as_deref(),
            Some("push it with smaller --robot-cpus")
        );
    }

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
