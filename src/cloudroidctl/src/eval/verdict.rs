//! Result of an evaluation: both sides, the verdict and the suggested SLA.

use std::fmt;

use api::Calibration;
use api::calibration::round_up_to_two_digits;
use api::dictionary::{Row, Spread};
use serde::Serialize;

use super::network::AddedNetwork;
use super::robot::RobotResources;
use super::side::SideResult;

/// Speed-up below which the difference may be chance.
const WORTH: f64 = 1.1;
/// Ratio of T_max to T_desire, as in the suggestion of `cloudroidctl try`.
const PATIENCE: f64 = 2.0;

/// Result of an evaluation. Times are in milliseconds, except in the SLA.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Evaluation {
    /// Name of the service.
    pub service: String,
    /// Measured revision.
    pub revision: u64,
    /// Path of the recording.
    pub bag: String,
    /// Resources of the robot.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<RobotResources>,
    /// Request rate of the recording in Hz; `None` if each request followed the previous answer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pace: Option<f64>,
    /// Inputs that the recording was replayed to.
    pub inputs: Vec<api::trial::Fed>,
    /// Topics of the recording without a matching input.
    pub unused: Vec<String>,
    /// Result on the robot.
    pub native: SideResult,
    /// Result in the cloud.
    pub outsourced: SideResult,
    /// Added network.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network: Option<AddedNetwork>,
    /// Speed-up of the outsourced service (ratio of the medians).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub times_as_fast: Option<f64>,
    /// Verdict in words.
    pub verdict: String,
    /// SLA that the robot can rely on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sla: Option<SuggestedSla>,
    /// Reason why no SLA is suggested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unsuggested: Option<String>,
}

/// A suggested SLA.
#[derive(Debug, Clone, Serialize)]
pub struct SuggestedSla {
    /// T_desire, in seconds.
    pub desire: f64,
    /// T_max, in seconds.
    pub max: f64,
    /// Set if the robot has the memory for a local original to fall back to.
    pub has_local: bool,
    /// Row for the dictionary of the service.
    pub row: Row,
    /// Set if the row has been written to the dictionary.
    pub written: bool,
    /// Part of the times that is the added network, in milliseconds per request.
    pub network_added: f64,
    /// Reason for these values.
    pub reason: String,
}

/// Reason why no SLA is suggested.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum NoSuggestion {
    /// The measurement over the network was aborted.
    Aborted,
    /// Too few requests were answered, or not at the recording's rate.
    TooFewAnswers,
    /// The service is faster on the robot.
    FasterOnRobot,
}

impl fmt::Display for NoSuggestion {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            NoSuggestion::Aborted => "the measurement over the network was aborted",
            NoSuggestion::TooFewAnswers => "outsourced, too few requests were answered, or not at the recording's rate",
            NoSuggestion::FasterOnRobot => "it is faster on the robot",
        })
    }
}

impl Evaluation {
    /// Creates the evaluation of both sides; `measured` is the daemon's measurement of the outsourced one.
    pub fn new(
        measured: &Calibration,
        bag: String,
        robot: RobotResources,
        (native, outsourced): (SideResult, SideResult),
        network: Option<AddedNetwork>,
    ) -> Evaluation {
        let medians = outsourced.rrt.zip(native.rrt);
        let mut evaluation = Evaluation {
            service: measured.service.clone(),
            revision: measured.revision,
            bag,
            robot: Some(robot),
            pace: measured.pace,
            inputs: measured.inputs.clone(),
            unused: measured.unused.clone(),
            times_as_fast: medians.map(|(outsourced, native)| native.p50 / outsourced.p50),
            native,
            outsourced,
            network,
            ..Evaluation::default()
        };
        evaluation.verdict = evaluation.verdict_in_words();
        match evaluation.suggest_sla(measured.rows.last()) {
            Ok(sla) => evaluation.sla = Some(sla),
            Err(why) => evaluation.unsuggested = Some(why.to_string()),
        }
        evaluation
    }

    fn verdict_in_words(&self) -> String {
        let (native, outsourced) = (&self.native, &self.outsourced);
        if let Some(why) = &outsourced.broken {
            let at_the_node = outsourced.phases.map_or(String::new(), |phases| {
                format!("; at the node a request takes {:.1} ms (p50)", phases.compute)
            });
            return format!(
                "no verdict: sending requests over the network from here failed: {why}{at_the_node}; evaluate again; \
                    if it fails again, see cloudroidctl events"
            );
        }
        let Some(there) = outsourced.rrt else {
            return format!(
                "no verdict: outsourced, none of {} requests was answered within 10 s; check whether the recording \
                    lacks an input, or a parameter is missing",
                outsourced.requests
            );
        };
        let outsourced_takes = format!("outsourced, a request takes {:.1} ms (p50)", there.p50);
        let worth = if let Some(why) = &native.out_of_memory {
            format!("only outsourced: {why}; {outsourced_takes}")
        } else if let Some((here, factor)) = native.rrt.zip(self.times_as_fast) {
            let both = format!("{:.1} ms instead of {:.1} ms (p50)", there.p50, here.p50);
            if factor >= WORTH {
                format!("worth it: outsourced, it answers {factor:.1} times as fast, {both}")
            } else if factor > 1.0 / WORTH {
                format!("no difference in time: {both}; outsourcing only frees the robot's cores")
            } else {
                format!(
                    "not worth it for response time: outsourced, it takes {:.1} times as long, {both}",
                    1.0 / factor
                )
            }
        } else {
            format!(
                "only outsourced: on the robot none of {} requests was answered within 10 s; {outsourced_takes}",
                native.requests
            )
        };
        let worth = format!("{worth}; messages were sent without a codec");
        match self.pace {
            Some(pace) if native.rrt.is_some() && !native.keeps_pace(Some(pace)) => format!(
                "{worth}; the recording has {pace:.1} requests per second, which {}",
                if outsourced.keeps_pace(Some(pace)) {
                    "only the outsourced service keeps up with"
                } else {
                    "neither keeps up with"
                }
            ),
            _ => worth,
        }
    }

    /// Suggests an SLA from the outsourced times: the row that the daemon proposes for the limits, with the response
    /// time seen from here.
    fn suggest_sla(&self, proposed: Option<&Row>) -> Result<SuggestedSla, NoSuggestion> {
        if self.outsourced.broken.is_some() {
            return Err(NoSuggestion::Aborted);
        }
        let measured = proposed.zip(self.outsourced.rrt);
        let (row, rrt) = measured.ok_or(NoSuggestion::TooFewAnswers)?;
        if !self.outsourced.has_enough_answers() || !self.outsourced.keeps_pace(self.pace) {
            return Err(NoSuggestion::TooFewAnswers);
        }
        if self.times_as_fast.is_some_and(|factor| factor <= 1.0 / WORTH) {
            return Err(NoSuggestion::FasterOnRobot);
        }
        let phases = self.outsourced.phases.unwrap_or_default();
        let network_added = phases.up.unwrap_or(0.0) + phases.down.unwrap_or(0.0);
        let desire = round_up_to_two_digits(rrt.p95) / 1000.0;
        let max = round_up_to_two_digits(desire * PATIENCE * 1000.0) / 1000.0;
        let row = Row {
            value: desire,
            spread: Some(Spread {
                p50: rrt.p50 / 1000.0,
                p95: rrt.p95 / 1000.0,
                requests: self.outsourced.answered as u64,
            }),
            ..row.clone()
        };
        Ok(SuggestedSla {
            desire,
            max,
            has_local: self.native.out_of_memory.is_none(),
            reason: format!(
                "desire is p95 of {} outsourced requests ({:.1} ms{}), rounded up; max is twice that",
                self.outsourced.answered,
                rrt.p95,
                if network_added > 0.0 {
                    format!(", {network_added:.1} ms of it added for the network")
                } else {
                    String::new()
                }
            ),
            row,
            written: false,
            network_added,
        })
    }
}

impl SuggestedSla {
    /// Takes over the row with the highest id of `rows`, the one just written. Returns the ids of other rows that
    /// promise the same limits for the same parameters, such as those of an earlier evaluation.
    pub fn mark_written(&mut self, rows: &[Row]) -> Vec<i64> {
        let Some(newest) = rows.iter().max_by_key(|row| row.id) else {
            return Vec::new();
        };
        let same = |row: &&Row| {
            row.id != newest.id
                && row.measure == newest.measure
                && row.aux == newest.aux
                && row.limits.cpus == newest.limits.cpus
        };
        let others = rows.iter().filter(same).map(|row| row.id).collect();
        (self.row, self.written) = (newest.clone(), true);
        others
    }

    /// Returns the lines for `stub.toml`.
    pub fn stub_toml(&self) -> Vec<String> {
        let mut lines = vec![format!("desire = {}", self.desire), format!("max = {}", self.max)];
        if !self.has_local {
            lines.push("local = \"none\"    # the robot has too little memory for it".to_owned());
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::network::AddedNetwork;
    use crate::eval::probe::ProbeOutcome;
    use crate::eval::side::tests::{calibration, probe_outcome, robot};

    fn evaluate(native: SideResult, outsourced: &Calibration, asked: &ProbeOutcome) -> Evaluation {
        let side = SideResult::from_probe(outsourced, asked, None);
        Evaluation::new(outsourced, "x.bag".into(), robot(), (native, side), None)
    }

    fn native(compute: f64) -> SideResult {
        SideResult::from_calibration(&calibration(0.25, compute, 20), vec![compute; 20], &robot())
    }

    #[test]
    fn the_verdict_says_what_is_faster_and_by_how_much() {
        let cloud = calibration(1.0, 40.0, 20);
        for (native, asked, words) in [
            (
                native(200.0),
                probe_outcome(50.0),
                "worth it: outsourced, it answers 4.0 times as fast, 50.0 ms instead of 200.0 ms",
            ),
            (native(51.0), probe_outcome(50.0), "no difference in time"),
            (
                native(25.0),
                probe_outcome(50.0),
                "not worth it for response time: outsourced, it takes 2.0 times as long",
            ),
            (
                SideResult::out_of_memory(&robot(), "people needs more than 1G".into()),
                probe_outcome(50.0),
                "only outsourced: people needs more than 1G; outsourced, a request takes 50.0 ms",
            ),
            (
                SideResult::from_calibration(&calibration(0.25, 0.0, 0), vec![], &robot()),
                probe_outcome(50.0),
                "on the robot none of 20 requests was answered within 10 s",
            ),
            (native(25.0), ProbeOutcome::without_answers(3), "outsourced, none of 3 requests was answered within 10 s"),
        ] {
            let verdict = evaluate(native, &cloud, &asked).verdict;
            assert!(verdict.contains(words), "{words}: {verdict}");
        }
    }

    #[test]
    fn a_pace_that_only_one_keeps_is_told() {
        let cloud = Calibration { pace: Some(10.0), ..calibration(1.0, 40.0, 20) };
        let verdict = |native| evaluate(native, &cloud, &probe_outcome(50.0)).verdict;
        let told = verdict(native(200.0));
        assert!(told.contains("10.0 requests per second, which only the outsourced"), "{told}");
        let told = verdict(native(80.0));
        assert!(!told.contains("requests per second"), "{told}");
    }

    #[test]
    fn the_suggested_sla_is_the_outsourced_95th_percentile_as_it_was_seen_from_the_robot() {
        let cloud = calibration(1.0, 40.0, 20);
        let sla = evaluate(native(200.0), &cloud, &probe_outcome(51.2)).sla.expect("an SLA");
        assert_eq!((sla.desire, sla.max), (0.052, 0.11));
        assert_eq!((sla.row.value, sla.row.limits.cpus), (0.052, Some(1.0)));
        assert_eq!(sla.row.spread.map(|spread| spread.requests), Some(20));
        assert_eq!(sla.stub_toml(), ["desire = 0.052", "max = 0.11"]);
        let starved = SideResult::out_of_memory(&robot(), "x".into());
        let sla = evaluate(starved, &cloud, &probe_outcome(51.2)).sla.expect("an SLA");
        assert!(sla.stub_toml()[2].starts_with("local = \"none\""));
    }

    #[test]
    fn what_is_not_worth_it_is_not_suggested() {
        let cloud = calibration(1.0, 40.0, 20);
        let found = evaluate(native(25.0), &cloud, &probe_outcome(50.0));
        assert!(found.sla.is_none(), "{:?}", found.sla);
        let why = found.unsuggested.unwrap_or_default();
        assert!(why.contains("faster on the robot"), "{why}");
    }

    #[test]
    fn what_failed_on_the_way_is_told_with_what_was_measured_before() {
        let cloud = calibration(1.0, 40.0, 20);
        let found = evaluate(native(200.0), &cloud, &ProbeOutcome::from_failure("no bytes came".into()));
        for words in ["over the network from here failed: no bytes came", "40.0 ms", "again"] {
            assert!(found.verdict.contains(words), "{}", found.verdict);
        }
        assert_eq!(found.native.rrt.map(|rrt| rrt.p50), Some(200.0));
        assert!(found.sla.is_none());
    }

    #[test]
    fn a_row_of_the_same_limits_is_named_and_the_added_network_is_told() {
        let cloud = calibration(1.0, 40.0, 20);
        let network: Option<AddedNetwork> = "20".parse().ok();
        let side = SideResult::from_probe(&cloud, &probe_outcome(50.0), network);
        let found = Evaluation::new(&cloud, "x.bag".into(), robot(), (native(200.0), side), network);
        let mut sla = found.sla.expect("an SLA");
        assert_eq!(sla.network_added, 20.0);
        assert!(sla.reason.contains("20.0 ms of it added for the network"), "{}", sla.reason);
        let row = |id, cpus| Row { id, limits: api::Limits { cpus: Some(cpus), ..sla.row.limits }, ..sla.row.clone() };
        let rows = [row(3, 1.0), row(5, 1.0), row(4, 2.0)];
        assert_eq!(sla.mark_written(&rows), [3]);
        assert!(sla.written && sla.row.id == 5);
    }

    #[test]
    fn nothing_is_suggested_of_what_answers_too_little_or_too_late() {
        let cloud = calibration(1.0, 40.0, 20);
        let few = ProbeOutcome { times: vec![Some(50.0); 9], ..probe_outcome(50.0) };
        assert!(evaluate(native(200.0), &cloud, &few).sla.is_none());
        let mut lost = probe_outcome(50.0);
        lost.times[0] = None;
        lost.times[1] = None;
        assert!(evaluate(native(200.0), &cloud, &lost).sla.is_none());
        let late = Calibration { pace: Some(30.0), ..cloud.clone() };
        assert!(evaluate(native(200.0), &late, &probe_outcome(50.0)).sla.is_none());
        let unproposed = Calibration { rows: vec![], ..cloud };
        assert!(evaluate(native(200.0), &unproposed, &probe_outcome(50.0)).sla.is_none());
    }
}
