//! Measures the two sides: the daemon runs one with the robot's limits, and the outsourced one is also asked over the
//! network.

use std::time::Duration;

use anyhow::bail;
use api::calibration::OUT_OF_MEMORY;
use api::{Calibration, CalibrationEvent, CalibrationOptions, Problem, Servant, ServiceDetail};
use bytes::Bytes;
use futures_util::StreamExt;
use http_body_util::{BodyExt, Full};
use hyper::Method;

use super::EvalArgs;
use super::probe::{self, NetworkProbe, ProbeOutcome};
use super::robot::RobotResources;
use super::side::{SideResult, only_point};
use super::verdict::Evaluation;
use crate::calibrate::format_point;
use crate::client::{self, DaemonClient, percent_encode};
use crate::output::{self, OutputFormat};

/// Time that the outsourced servant is kept for the requests over the network, in seconds: each may take as long as the
/// daemon waits for one.
const KEEP: f64 = 180.0;
/// Interval and largest number of looks whether the servant is gone.
const LOOK: Duration = Duration::from_millis(50);
const LOOKS: usize = 200;

impl EvalArgs {
    pub(super) async fn measure(
        &self,
        client: &DaemonClient,
        format: OutputFormat,
        file: Bytes,
        recorded: &[ros::bag::BagMessage],
        service: &ServiceDetail,
    ) -> anyhow::Result<Evaluation> {
        let robot = RobotResources::new(self.robot, self.robot_cpus, self.robot_memory);
        let tell = |words: &str| match format {
            OutputFormat::Json => Ok(()),
            OutputFormat::Table => output::line(words),
        };
        tell(&format!("== native: as on {robot}"))?;
        let options = CalibrationOptions { cpus: vec![robot.cpus], memory: Some(robot.memory), ..self.options() };
        let native = match self.run_calibration(client, options, file.clone(), &tell).await {
            Ok(measured) => SideResult::from_calibration(&measured.calibration, measured.times, &robot),
            Err(error) => SideResult::out_of_memory(&robot, out_of_memory_reason(rename_robot_flags(error))?),
        };
        tell("== outsourced")?;
        let options = CalibrationOptions {
            cpus: self.cpus.into_iter().collect(),
            own: self.cpus.is_none(),
            keep: Some(KEEP),
            ..self.options()
        };
        // The servant lives as long as `measured`.
        let measured = self.run_calibration(client, options, file, &tell).await?;
        let servant = measured.servant.as_deref();
        let place = servant.map(|servant| format!("/api/v1/servants/{}", percent_encode(servant)));
        let limits = fetch_limits(client, place.as_deref()).await;
        let asked = match &measured.servant {
            Some(servant) if has_answers(&measured.calibration) => {
                tell("   the same requests over the network, from this machine")?;
                let probe = NetworkProbe {
                    service,
                    calibration: &measured.calibration,
                    recorded,
                    input: self.input.as_deref(),
                    output: self.output.as_deref(),
                    fast: self.fast,
                    requests: self.requests.unwrap_or(probe::REQUESTS),
                };
                match probe.run(client, servant).await {
                    Ok(asked) => asked,
                    Err(error) => ProbeOutcome::from_failure(format!("{error:#}")),
                }
            }
            // It would not answer from here either.
            _ => ProbeOutcome::without_answers(only_point(&measured.calibration).requests),
        };
        let now = self::fetch_limits(client, place.as_deref()).await;
        if now.is_some() && now != limits {
            bail!("the servant's limits were changed during the measurement; evaluate again");
        }
        let mut outsourced = SideResult::from_probe(&measured.calibration, &asked, self.network);
        outsourced.memory_limit = limits.and_then(|limits| limits.memory);
        if let Some(rrt) = outsourced.rrt {
            tell(&format!(
                "   {} of {} answered: p50 {:.1} ms, p95 {:.1} ms",
                outsourced.answered, outsourced.requests, rrt.p50, rrt.p95
            ))?;
        }
        // The next evaluation needs this servant's capacity.
        let MeasuredCalibration { calibration, events, .. } = measured;
        drop(events);
        if let Some(place) = &place {
            wait_until_gone(client, place).await;
        }
        Ok(Evaluation::new(&calibration, self.bag.display().to_string(), robot, (native, outsourced), self.network))
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

    /// Has the daemon measure at one limit. If the servant was to be kept, it lives until the returned value is
    /// dropped.
    async fn run_calibration(
        &self,
        client: &DaemonClient,
        options: CalibrationOptions,
        file: Bytes,
        tell: &dyn Fn(&str) -> anyhow::Result<()>,
    ) -> anyhow::Result<MeasuredCalibration> {
        let path = format!(
            "/api/v1/services/{}/calibration?options={}",
            percent_encode(&self.service),
            percent_encode(&serde_json::to_string(&options)?)
        );
        let body = Full::new(file).map_err(|never| match never {}).boxed_unsync();
        let answer = client.send(Method::POST, &path, body).await?;
        let mut events = Box::pin(client::json_lines(answer));
        let mut measured = Vec::new();
        while let Some(event) = events.next().await {
            let (calibration, servant) = match event? {
                CalibrationEvent::Done { calibration } => (calibration, None),
                CalibrationEvent::Kept { servant, calibration } => (calibration, Some(servant)),
                CalibrationEvent::Error { problem } => return Err(problem.into()),
                CalibrationEvent::Step { title } => {
                    tell(&format!("   {title}"))?;
                    continue;
                }
                CalibrationEvent::Measured { times, point } => {
                    tell(&format!("   {}", format_point(&point)))?;
                    measured = times;
                    continue;
                }
            };
            return Ok(MeasuredCalibration { calibration: *calibration, times: measured, servant, events });
        }
        bail!("the daemon aborted the measurement; nothing was written")
    }
}

/// Result of the daemon's measurement at one limit.
struct MeasuredCalibration {
    calibration: Calibration,
    /// Response times of the answered requests, in milliseconds.
    times: Vec<f64>,
    /// Id of the servant, which is kept until `events` is dropped.
    servant: Option<String>,
    events: std::pin::Pin<Box<dyn futures_util::Stream<Item = anyhow::Result<CalibrationEvent>>>>,
}

/// Returns the limits of a servant, if it exists.
async fn fetch_limits(client: &DaemonClient, place: Option<&str>) -> Option<api::Limits> {
    let servant = client.get::<Servant>(place?).await;
    servant.ok().map(|servant| servant.limits)
}

/// Returns when the servant is gone, or after ten seconds.
async fn wait_until_gone(client: &DaemonClient, place: &str) {
    for _ in 0..LOOKS {
        if client.get::<Servant>(place).await.is_err() {
            return;
        }
        tokio::time::sleep(LOOK).await;
    }
}

/// Renames `--cpus` to `--robot-cpus` in a problem of the native side.
fn rename_robot_flags(error: anyhow::Error) -> anyhow::Error {
    let named = |words: String| words.replace(" --cpus", " --robot-cpus");
    match error.downcast::<Problem>() {
        Ok(problem) => Problem { detail: named(problem.detail), next: problem.next.map(named), ..problem }.into(),
        Err(error) => error,
    }
}

fn has_answers(calibration: &Calibration) -> bool {
    only_point(calibration).answered > 0
}

/// Returns the reason if the kernel killed the servant for lack of memory; passes on any other error, which has nothing
/// to do with the robot.
fn out_of_memory_reason(error: anyhow::Error) -> anyhow::Result<String> {
    match error.downcast_ref::<Problem>() {
        Some(problem) if problem.kind == OUT_OF_MEMORY => Ok(problem.detail.clone()),
        _ => Err(error),
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
        let told = out_of_memory_reason(problem("urn:cloudroid:out-of-memory").into());
        assert_eq!(told.expect("an answer"), "needs more than 1G");
        out_of_memory_reason(problem("urn:cloudroid:full").into()).expect_err("no answer");
        out_of_memory_reason(anyhow::anyhow!("broken")).expect_err("no answer");
    }

    #[test]
    fn what_the_robot_cannot_have_is_named_by_its_own_option() {
        let problem = Problem {
            detail: "there is no room; name smaller limits with --cpus".into(),
            next: Some("push it with smaller --cpus".into()),
            ..Problem::default()
        };
        let told = rename_robot_flags(problem.into());
        let told = told.downcast::<Problem>().expect("a problem");
        assert!(told.detail.ends_with("with --robot-cpus"), "{told}");
        assert_eq!(told.next.as_deref(), Some("push it with smaller --robot-cpus"));
    }
}
