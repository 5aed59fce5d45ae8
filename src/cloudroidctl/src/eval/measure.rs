//! Measuring the two sides: the daemon asks one at the limits of the robot, and the outsourced one is asked over the network, too.

use std::time::Duration;

use anyhow::bail;
use api::calibration::{OUT_OF_MEMORY, Point};
use api::{Calibration, CalibrationEvent, CalibrationOptions, Problem, Servant, ServiceDetail};
use bytes::Bytes;
use futures_util::StreamExt;
use http_body_util::{BodyExt, Full};
use hyper::Method;

use super::Eval;
use super::probe::{self, Asked, Probe};
use super::robot::Robot;
use super::side::Side;
use super::verdict::Evaluation;
use crate::calibrate::in_a_line;
use crate::client::{self, Client, escaped};
use crate::output::{self, Format};

/// Seconds for which the outsourced servant stays for what is asked over the network: each request may take as long as the
/// daemon waits for one.
const KEEP: f64 = 180.0;
/// How often, and how often at most, it is looked whether its servant has gone.
const LOOK: Duration = Duration::from_millis(50);
const LOOKS: usize = 200;

impl Eval {
    pub(super) async fn measure(
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
pub(super) fn point(calibration: &Calibration) -> Point {
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
}
