//! What a robot has seen of one run: raw, request by request.

use serde::{Deserialize, Serialize};

/// One request and its answer.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Request {
    /// When it was published, seconds from the run's beginning.
    pub at: f64,
    /// When its message was recorded, seconds of the recording.
    pub stamp: f64,
    /// Response time of the first answer, seconds; none where no answer came.
    pub response: Option<f64>,
    /// What the node itself says that it took.
    pub phases: Option<Phases>,
    /// Where the robot is, by the answer: x and y in metres, heading in radians.
    pub pose: Option<[f64; 3]>,
    /// Of the answer without its header's sequence number; equal for equal answers.
    pub digest: Option<u64>,
    /// The same of an answer that is a list of boxes, in whatever order they are.
    #[serde(default)]
    pub boxes: Option<u64>,
    /// Bytes of packets that had left the robot and had come to it when the answer was there, since its place was made.
    #[serde(default)]
    pub carried: Option<[u64; 2]>,
    /// How many answers came, of requests at a rate.
    #[serde(default)]
    pub answers: usize,
    /// The first answer was that of the local original, as the stub tells.
    #[serde(default)]
    pub local: bool,
    /// The stub's satisfaction with the cloud, Q, once this request was counted.
    #[serde(default)]
    pub satisfaction: Option<f64>,
}

/// Parts of one computation as SLAMBench divides them (Nardi et al., ICRA 2015), seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Phases {
    /// Reading the input.
    pub acquisition: f64,
    /// The algorithm.
    pub computation: f64,
    /// Making what is shown.
    pub rendering: f64,
}

/// A map that was published.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Grid {
    /// Cells.
    pub width: usize,
    /// Cells.
    pub height: usize,
    /// Metres of a cell's side.
    pub resolution: f64,
    /// Of the first cell's corner, metres.
    pub origin: [f64; 2],
    /// By rows, from the first: -1 unknown, 0 free to 100 occupied.
    pub cells: Vec<i8>,
}

/// All of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Trace {
    /// In the order they were published.
    pub requests: Vec<Request>,
    /// Seconds from the first request to the last answer.
    pub lasted: f64,
    /// Of requests at a rate: answers were late already before the first that counts.
    #[serde(default)]
    pub late_before: bool,
    /// The last map.
    pub map: Option<Grid>,
    /// Answers by the local original, where that is known.
    pub answered_locally: usize,
    /// What its log warns of.
    #[serde(default)]
    pub warnings: Vec<String>,
    /// How the node ended before its time; none where it went on to the end.
    pub node_ended: Option<String>,
}

impl Trace {
    /// Response times of what was answered, seconds.
    pub fn responses(&self) -> Vec<f64> {
        self.requests
            .iter()
            .filter_map(|one| one.response)
            .collect()
    }

    /// How many were answered.
    pub fn answered(&self) -> usize {
        self.responses().len()
    }

    /// Bytes of packets for each request, to the server and back, without the first `from` requests: counted from one answer to the last
    /// one. None without counters, or where too few were answered.
    pub fn carried_each(&self, from: usize) -> Option<[f64; 2]> {
        let known = |(index, request): (usize, &Request)| Some((index, request.carried?));
        let all: Vec<(usize, [u64; 2])> =
            self.requests.iter().enumerate().filter_map(known).collect();
        let first = all.iter().rfind(|(index, _)| *index < from)?;
        let last = all.last().filter(|last| last.0 >= from)?;
        let requests = (last.0 - first.0) as f64;
        let bytes = |way: usize| last.1[way].checked_sub(first.1[way]);
        Some([bytes(0)? as f64 / requests, bytes(1)? as f64 / requests])
    }

    /// Estimated positions: seconds of the recording, x and y in metres.
    pub fn trajectory(&self) -> Vec<(f64, f64, f64)> {
        let pose = |one: &Request| one.pose.map(|[x, y, _]| (one.stamp, x, y));
        self.requests.iter().filter_map(pose).collect()
    }
}
