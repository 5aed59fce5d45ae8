//! Why a robot is slow, or answered locally, now: `GET /api/v1/robots/NAME/explain`.

use serde::{Deserialize, Serialize};

use crate::event::Event;
use crate::servant::Servant;

/// All that is known of one robot, and what follows from it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Explanation {
    /// The robot.
    pub robot: String,
    /// What follows, the weightiest first; empty when nothing is wrong.
    pub causes: Vec<Cause>,
    /// Servants that the robot has.
    pub servants: Vec<Served>,
    /// What happened to it last, oldest first.
    pub events: Vec<Event>,
}

/// One reason.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Cause {
    /// How much it matters.
    pub weight: Weight,
    /// What is so, with its figures.
    pub what: String,
    /// What to do about it.
    pub next: String,
}

/// How much a cause matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(rename_all = "lowercase")]
pub enum Weight {
    /// Nothing works with it.
    Blocks,
    /// It costs response time.
    Slows,
    /// Worth knowing.
    Hint,
}

/// A servant of the robot, and the links to it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Served {
    /// As in a list.
    pub servant: Servant,
    /// Share of the last moment in which it wanted to run and had used its cores up, 0 to 1.
    pub throttled: f64,
    /// Cores that it used in the last moment.
    pub cores: f64,
    /// One for each node that a stub stands for.
    pub links: Vec<Link>,
}

/// A node's link and its last requests. Times are in milliseconds.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Link {
    /// The node.
    pub node: String,
    /// Its connection is there and not silent.
    pub up: bool,
    /// Last round trip.
    pub round_trip: Option<f64>,
    /// The robot's clock minus this machine's.
    pub clock: Option<f64>,
    /// Bytes a second downwards, when it had to hurry.
    pub throughput: Option<f64>,
    /// Messages that were dropped on either side.
    pub dropped: u64,
    /// Of which topics, where and why: a sentence each.
    #[serde(default)]
    pub drops: Vec<String>,
    /// T_desire.
    pub desire: Option<f64>,
    /// T_max.
    pub max: Option<f64>,
    /// Q_t, where the robot says it.
    #[serde(default)]
    pub threshold: Option<f64>,
    /// The least rate of an output, where that is promised instead: frames per second.
    #[serde(default)]
    pub frames_per_second: Option<f64>,
    /// The rate that is wished for, where it is another.
    #[serde(default)]
    pub desired_frames_per_second: Option<f64>,
    /// The greatest age of an output, where that is promised instead.
    #[serde(default)]
    pub age: Option<f64>,
    /// The age that is wished for, where it is another.
    #[serde(default)]
    pub desired_age: Option<f64>,
    /// Where no time is promised: seconds for which the link is down before the local original takes over. Such links have no
    /// Q, and none of their requests counts as late.
    #[serde(default)]
    pub fallback_after: Option<f64>,
    /// Q after the last request.
    pub satisfaction: Option<f64>,
    /// So many requests are known.
    pub requests: usize,
    /// Of them passed T_max, or were never answered by the cloud.
    pub late: usize,
    /// Of them were answered by the local original.
    pub local: usize,
    /// Where their time went.
    pub phases: Vec<Part>,
    /// Where most of the time of the late ones went; none when none was answered.
    #[serde(default)]
    pub late_in: Option<Part>,
    /// Messages that the robot did not send in the last minute, since newer ones had come or they were too old.
    #[serde(default)]
    pub unsent: u64,
    /// The number of the last inputs that the node was given and that have a stamp.
    #[serde(default)]
    pub given: usize,
    /// Of these, the inputs that it has left out, since newer ones had come.
    #[serde(default)]
    pub left_out: usize,
    /// Inputs that the node listens to and nobody on the robot publishes.
    pub unfed: Vec<String>,
    /// Services that the node has looked for in vain.
    #[serde(default)]
    pub unserved: Vec<String>,
    /// Nodes of the robot with which no messages of the node pass, and why: a sentence each.
    #[serde(default)]
    pub refused: Vec<String>,
    /// Other machines that are connected as the same robot.
    #[serde(default, alias = "twins")]
    pub duplicates: Vec<String>,
}

/// A part of the response time, over the last requests.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Part {
    /// `serialise`, `up`, `queue`, `compute`, `down` or `total`.
    pub name: String,
    /// Median.
    pub p50: f64,
    /// 90th percentile.
    pub p90: f64,
    /// Maximum.
    pub max: f64,
}

impl Part {
    /// Of times in any order (nearest ranks), those left out that are no numbers; none of none.
    pub fn of(name: &str, mut times: Vec<f64>) -> Option<Part> {
        times.retain(|time| time.is_finite());
        times.sort_by(f64::total_cmp);
        let rank = |percent| qos::nearest_rank(&times, percent);
        Some(Part {
            name: name.to_owned(),
            p50: rank(50)?,
            p90: rank(90)?,
            max: rank(100)?,
        })
    }
}

impl Link {
    /// A part by name.
    pub fn part(&self, name: &str) -> Option<&Part> {
        self.phases.iter().find(|part| part.name == name)
    }

    /// The part with the greatest median.
    pub fn dominant(&self) -> Option<&Part> {
        dominant(&self.phases)
    }
}

/// The part with the greatest median, the whole not counted.
pub fn dominant(parts: &[Part]) -> Option<&Part> {
    parts
        .iter()
        .filter(|part| part.name != "total" && part.p50 > 0.0)
        .max_by(|a, b| a.p50.total_cmp(&b.p50))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_leave_out_what_is_no_number() {
        let times = [f64::NAN, 10.0, 9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0];
        let part = Part::of("up", times.to_vec()).expect("times");
        assert_eq!((part.p50, part.p90, part.max), (5.0, 9.0, 10.0));
        assert_eq!(Part::of("up", vec![f64::NAN]), None);
    }
}
