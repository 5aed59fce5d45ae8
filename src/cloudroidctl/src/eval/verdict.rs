//! What an evaluation found: both sides, which is faster, and the SLA that follows.

use api::Calibration;
use api::calibration::rounded_up;
use api::dictionary::{Row, Spread};
use serde::Serialize;

use super::network::Network;
use super::robot::Robot;
use super::side::Side;

/// Less than so many times as fast may be chance.
const WORTH: f64 = 1.1;
/// T_max over T_desire, as `cloudroidctl try` suggests it.
const PATIENCE: f64 = 2.0;

/// All that was found. Times are in milliseconds but for those of the SLA.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Evaluation {
    /// The service.
    pub service: String,
    /// The revision that was measured.
    pub revision: u64,
    /// The recording.
    pub bag: String,
    /// What the robot has.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<Robot>,
    /// Requests a second of the recording; none where each followed the answer before it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pace: Option<f64>,
    /// What was published to it.
    pub inputs: Vec<api::trial::Fed>,
    /// Topics of the recording that it has no input for.
    pub unused: Vec<String>,
    /// On the robot.
    pub native: Side,
    /// In the cloud.
    pub outsourced: Side,
    /// The network that was added.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub network: Option<Network>,
    /// So many times as fast is a request outsourced (medians).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub times_as_fast: Option<f64>,
    /// The same in words.
    pub verdict: String,
    /// What the robot may count on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sla: Option<Suggested>,
    /// Why nothing is suggested.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unsuggested: Option<String>,
}

/// A suggested SLA.
#[derive(Debug, Clone, Serialize)]
pub struct Suggested {
    /// T_desire, in seconds.
    pub desire: f64,
    /// T_max, in seconds.
    pub max: f64,
    /// Whether the robot has a local original to fall back to.
    pub has_local: bool,
    /// For the dictionary of the service.
    pub row: Row,
    /// Whether the row is in the dictionary now.
    pub written: bool,
    /// Of its times, what was added for a network that was not there, in milliseconds for each request.
    pub network_added: f64,
    /// Why these.
    pub reason: String,
}

impl Evaluation {
    /// Of both sides; `measured` is the outsourced one as the daemon saw it.
    pub fn new(
        measured: &Calibration,
        bag: String,
        robot: Robot,
        (native, outsourced): (Side, Side),
        network: Option<Network>,
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
        evaluation.verdict = evaluation.in_words();
        match evaluation.suggested(measured.rows.last()) {
            Ok(sla) => evaluation.sla = Some(sla),
            Err(why) => evaluation.unsuggested = Some(why),
        }
        evaluation
    }

    fn in_words(&self) -> String {
        let (native, outsourced) = (&self.native, &self.outsourced);
        if let Some(why) = &outsourced.broken {
            let at_the_node = outsourced.phases.map_or(String::new(), |phases| {
                format!(
                    "; at the node a request takes {:.1} ms (median)",
                    phases.compute
                )
            });
            return format!(
                "nothing can be said of it outsourced: asking over the network from here failed: {why}{at_the_node}; evaluate again, \
                 if it fails again see cloudroidctl events"
            );
        }
        let Some(there) = outsourced.rrt else {
            return format!(
                "outsourced, none of {} requests was answered within 10 s: look whether an input is missing in the recording, or a \
                 parameter; nothing can be said",
                outsourced.requests
            );
        };
        let outsourced_takes = format!("outsourced, a request takes {:.1} ms (median)", there.p50);
        let worth = if let Some(why) = &native.out_of_memory {
            format!("only outsourced: {why}; {outsourced_takes}")
        } else if let Some((here, factor)) = native.rrt.zip(self.times_as_fast) {
            let both = format!(
                "{:.1} ms instead of {:.1} ms (medians)",
                there.p50, here.p50
            );
            if factor >= WORTH {
                format!("worth it: outsourced, it answers {factor:.1} times as fast, {both}")
            } else if factor > 1.0 / WORTH {
                format!(
                    "no difference in time: {both}; outsourcing spares the robot its cores alone"
                )
            } else {
                format!(
                    "not worth it for its time: outsourced, it takes {:.1} times as long, {both}",
                    1.0 / factor
                )
            }
        } else {
            format!(
                "only outsourced: on the robot none of {} requests was answered within 10 s; {outsourced_takes}",
                native.requests
            )
        };
        let worth = format!("{worth}; messages went as they are, without a codec");
        match self.pace {
            Some(pace) if native.rrt.is_some() && !native.keeps(Some(pace)) => format!(
                "{worth}; the recording asks {pace:.1} times a second, which {}",
                match outsourced.keeps(Some(pace)) {
                    true => "only the outsourced one keeps up with",
                    false => "neither keeps up with",
                }
            ),
            _ => worth,
        }
    }

    /// What follows from the outsourced times: the row that the daemon proposes for its limits, with the time that was seen from here.
    fn suggested(&self, proposed: Option<&Row>) -> Result<Suggested, String> {
        const LACKS: &str =
            "outsourced, too few requests were answered, or not at the recording's pace";
        if self.outsourced.broken.is_some() {
            return Err("asking over the network was broken off".to_owned());
        }
        let measured = proposed.zip(self.outsourced.rrt);
        let (row, rrt) = measured.ok_or_else(|| LACKS.to_owned())?;
        if !self.outsourced.answers_enough() || !self.outsourced.keeps(self.pace) {
            return Err(LACKS.to_owned());
        }
        if self
            .times_as_fast
            .is_some_and(|factor| factor <= 1.0 / WORTH)
        {
            return Err("it is faster on the robot".to_owned());
        }
        let phases = self.outsourced.phases.unwrap_or_default();
        let network_added = phases.up.unwrap_or(0.0) + phases.down.unwrap_or(0.0);
        let desire = rounded_up(rrt.p95) / 1000.0;
        let max = rounded_up(desire * PATIENCE * 1000.0) / 1000.0;
        let row = Row {
            value: desire,
            spread: Some(Spread {
                p50: rrt.p50 / 1000.0,
                p95: rrt.p95 / 1000.0,
                requests: self.outsourced.answered as u64,
            }),
            ..row.clone()
        };
        Ok(Suggested {
            desire,
            max,
            has_local: self.native.out_of_memory.is_none(),
            reason: format!(
                "desire is what 95 % of {} outsourced requests took ({:.1} ms{}), rounded up; max is twice that",
                self.outsourced.answered,
                rrt.p95,
                match network_added > 0.0 {
                    true => format!(", {network_added:.1} ms of it the added network"),
                    false => String::new(),
                }
            ),
            row,
            written: false,
            network_added,
        })
    }
}

impl Suggested {
    /// Takes the row as it stands among `rows` of the dictionary, where it was written last; numbers of others that promise the same
    /// limits for the same parameters, as an earlier evaluation wrote them.
    pub fn note_written(&mut self, rows: &[Row]) -> Vec<i64> {
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

    /// Lines of `stub.toml`.
    pub fn stub_toml(&self) -> Vec<String> {
        let mut lines = vec![
            format!("desire = {}", self.desire),
            format!("max = {}", self.max),
        ];
        if !self.has_local {
            lines.push("local = \"none\"    # the robot has no memory for it".to_owned());
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::eval::network::Network;
    use crate::eval::probe::Asked;
    use crate::eval::side::tests::{asked, calibration, robot};

    fn evaluated(native: Side, outsourced: &Calibration, asked: &Asked) -> Evaluation {
        let side = Side::outsourced(outsourced, asked, None);
        Evaluation::new(outsourced, "x.bag".into(), robot(), (native, side), None)
    }

    fn native(compute: f64) -> Side {
        Side::native(&calibration(0.25, compute, 20), vec![compute; 20], &robot())
    }

    #[test]
    fn the_verdict_says_what_is_faster_and_by_how_much() {
        let cloud = calibration(1.0, 40.0, 20);
        for (native, asked, words) in [
            (
                native(200.0),
                asked(50.0),
                "worth it: outsourced, it answers 4.0 times as fast, 50.0 ms instead of 200.0 ms",
            ),
            (native(51.0), asked(50.0), "no difference in time"),
            (
                native(25.0),
                asked(50.0),
                "not worth it for its time: outsourced, it takes 2.0 times as long",
            ),
            (
                Side::starved(&robot(), "people needs more than 1G".into()),
                asked(50.0),
                "only outsourced: people needs more than 1G; outsourced, a request takes 50.0 ms",
            ),
            (
                Side::native(&calibration(0.25, 0.0, 0), vec![], &robot()),
                asked(50.0),
                "on the robot none of 20 requests was answered within 10 s",
            ),
            (
                native(25.0),
                Asked::unanswered(3),
                "outsourced, none of 3 requests was answered within 10 s",
            ),
        ] {
            let verdict = evaluated(native, &cloud, &asked).verdict;
            assert!(verdict.contains(words), "{words}: {verdict}");
        }
    }

    #[test]
    fn a_pace_that_only_one_keeps_is_told() {
        let cloud = Calibration {
            pace: Some(10.0),
            ..calibration(1.0, 40.0, 20)
        };
        let verdict = |native| evaluated(native, &cloud, &asked(50.0)).verdict;
        let told = verdict(native(200.0));
        assert!(
            told.contains("10.0 times a second, which only the outsourced"),
            "{told}"
        );
        let told = verdict(native(80.0));
        assert!(!told.contains("times a second"), "{told}");
    }

    #[test]
    fn the_suggested_sla_is_the_outsourced_95th_percentile_as_it_was_seen_from_the_robot() {
        let cloud = calibration(1.0, 40.0, 20);
        let sla = evaluated(native(200.0), &cloud, &asked(51.2))
            .sla
            .expect("an SLA");
        assert_eq!((sla.desire, sla.max), (0.052, 0.11));
        assert_eq!((sla.row.value, sla.row.limits.cpus), (0.052, Some(1.0)));
        assert_eq!(sla.row.spread.map(|spread| spread.requests), Some(20));
        assert_eq!(sla.stub_toml(), ["desire = 0.052", "max = 0.11"]);
        let starved = Side::starved(&robot(), "x".into());
        let sla = evaluated(starved, &cloud, &asked(51.2))
            .sla
            .expect("an SLA");
        assert!(sla.stub_toml()[2].starts_with("local = \"none\""));
    }

    #[test]
    fn what_is_not_worth_it_is_not_suggested() {
        let cloud = calibration(1.0, 40.0, 20);
        let found = evaluated(native(25.0), &cloud, &asked(50.0));
        assert!(found.sla.is_none(), "{:?}", found.sla);
        let why = found.unsuggested.unwrap_or_default();
        assert!(why.contains("faster on the robot"), "{why}");
    }

    #[test]
    fn what_failed_on_the_way_is_told_with_what_was_measured_before() {
        let cloud = calibration(1.0, 40.0, 20);
        let found = evaluated(
            native(200.0),
            &cloud,
            &Asked::broken("no bytes came".into()),
        );
        for words in [
            "over the network from here failed: no bytes came",
            "40.0 ms",
            "again",
        ] {
            assert!(found.verdict.contains(words), "{}", found.verdict);
        }
        assert_eq!(found.native.rrt.map(|rrt| rrt.p50), Some(200.0));
        assert!(found.sla.is_none());
    }

    #[test]
    fn a_row_of_the_same_limits_is_named_and_the_added_network_is_told() {
        let cloud = calibration(1.0, 40.0, 20);
        let network: Option<Network> = "20".parse().ok();
        let side = Side::outsourced(&cloud, &asked(50.0), network);
        let found = Evaluation::new(
            &cloud,
            "x.bag".into(),
            robot(),
            (native(200.0), side),
            network,
        );
        let mut sla = found.sla.expect("an SLA");
        assert_eq!(sla.network_added, 20.0);
        assert!(
            sla.reason.contains("20.0 ms of it the added network"),
            "{}",
            sla.reason
        );
        let row = |id, cpus| Row {
            id,
            limits: api::Limits {
                cpus: Some(cpus),
                ..sla.row.limits
            },
            ..sla.row.clone()
        };
        let rows = [row(3, 1.0), row(5, 1.0), row(4, 2.0)];
        assert_eq!(sla.note_written(&rows), [3]);
        assert!(sla.written && sla.row.id == 5);
    }

    #[test]
    fn nothing_is_suggested_of_what_answers_too_little_or_too_late() {
        let cloud = calibration(1.0, 40.0, 20);
        let few = Asked {
            times: vec![Some(50.0); 9],
            ..asked(50.0)
        };
        assert!(evaluated(native(200.0), &cloud, &few).sla.is_none());
        let mut lost = asked(50.0);
        lost.times[0] = None;
        lost.times[1] = None;
        assert!(evaluated(native(200.0), &cloud, &lost).sla.is_none());
        let late = Calibration {
            pace: Some(30.0),
            ..cloud.clone()
        };
        assert!(evaluated(native(200.0), &late, &asked(50.0)).sla.is_none());
        let unproposed = Calibration {
            rows: vec![],
            ..cloud
        };
        assert!(
            evaluated(native(200.0), &unproposed, &asked(50.0))
                .sla
                .is_none()
        );
    }
}
