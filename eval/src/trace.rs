//! A robot's raw observations of one run, request by request.

use serde::{Deserialize, Serialize};

use crate::statistics::mean;

/// Names of [`ResponseParts`], in their order.
pub const PART_NAMES: [&str; 4] = ["acquisition", "computation", "rendering", "transport and waiting"];

/// Means over all requests of one run, in seconds: the durations that the package reports, and the rest of the response
/// time.
pub type ResponseParts = [f64; 4];

/// One request and its answer.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RequestSample {
    /// Seconds from the start of the run until it was published.
    pub at: f64,
    /// Time of its message in the recording, in seconds.
    pub stamp: f64,
    /// Response time of the first answer in seconds; `None` without an answer.
    pub response: Option<f64>,
    pub phases: Option<ComputationPhases>,
    /// Pose of the robot in the answer: x and y in metres, heading in radians.
    pub pose: Option<[f64; 3]>,
    /// Hash of the answer without its header's sequence number; equal for equal answers.
    pub digest: Option<u64>,
    /// Hash of an answer that is a list of boxes, independent of their order.
    pub boxes: Option<u64>,
    /// Bytes of packets that the robot had sent and received since its sandbox was created, when the answer arrived.
    pub carried: Option<[u64; 2]>,
    /// Number of answers, for requests at a rate.
    pub answers: usize,
    /// True if the first answer came from the local original, according to the stub.
    pub local: bool,
    /// The stub's satisfaction with the cloud, Q, after this request had been counted.
    pub satisfaction: Option<f64>,
}

/// Parts of one computation as in SLAMBench (Nardi et al., ICRA 2015), in seconds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct ComputationPhases {
    pub acquisition: f64,
    pub computation: f64,
    pub rendering: f64,
}

/// A published map.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MapGrid {
    pub width: usize,
    pub height: usize,
    /// Side length of a cell in metres.
    pub resolution: f64,
    /// Corner of the first cell, in metres.
    pub origin: [f64; 2],
    /// Cells by rows, from the first: -1 unknown, 0 free to 100 occupied.
    pub cells: Vec<i8>,
}

/// Observations of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Trace {
    /// Requests in the order in which they were published.
    pub requests: Vec<RequestSample>,
    /// Seconds from the first request to the last answer.
    pub lasted: f64,
    /// For requests at a rate: whether answers were late even before the first counted request.
    pub late_before: bool,
    pub map: Option<MapGrid>,
    /// How often the stub asked the local original as well, no longer asked it, started its process, and stopped it.
    pub handovers: [usize; 4],
    /// Warnings in the node's log.
    pub warnings: Vec<String>,
    /// How the node ended prematurely; `None` if it ran to the end.
    pub node_ended: Option<String>,
}

impl Trace {
    /// Response times of the answered requests, in seconds.
    pub fn responses(&self) -> Vec<f64> {
        self.requests.iter().filter_map(|one| one.response).collect()
    }

    pub fn answered_count(&self) -> usize {
        self.responses().len()
    }

    /// Returns the mean parts of the response time, over the requests whose parts are known; `None` if the package did
    /// not report durations.
    pub fn mean_parts(&self) -> Option<ResponseParts> {
        let both = self.requests.iter().filter_map(|one| Some((one.response?, one.phases?)));
        let parts = both.map(|(response, ComputationPhases { acquisition, computation, rendering })| {
            [acquisition, computation, rendering, response - acquisition - computation - rendering]
        });
        let all: Vec<ResponseParts> = parts.collect();
        let mut means = ResponseParts::default();
        for (index, part) in means.iter_mut().enumerate() {
            *part = mean(&all.iter().map(|one| one[index]).collect::<Vec<_>>())?;
        }
        Some(means)
    }

    /// Returns the bytes of packets per request, to the server and back, without the first `from` requests: from one
    /// answer to the last one. `None` without counters, or with too few answers.
    pub fn bytes_per_request(&self, from: usize) -> Option<[f64; 2]> {
        let known = |(index, request): (usize, &RequestSample)| Some((index, request.carried?));
        let all: Vec<(usize, [u64; 2])> = self.requests.iter().enumerate().filter_map(known).collect();
        let first = all.iter().rfind(|(index, _)| *index < from)?;
        let last = all.last().filter(|last| last.0 >= from)?;
        let requests = (last.0 - first.0) as f64;
        let bytes = |way: usize| last.1[way].checked_sub(first.1[way]);
        Some([bytes(0)? as f64 / requests, bytes(1)? as f64 / requests])
    }

    /// Returns the estimated positions: seconds of the recording, x and y in metres.
    pub fn trajectory(&self) -> Vec<(f64, f64, f64)> {
        let pose = |one: &RequestSample| one.pose.map(|[x, y, _]| (one.stamp, x, y));
        self.requests.iter().filter_map(pose).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_of_a_response_is_transport() {
        let request = |response, computation| RequestSample {
            response: Some(response),
            phases: Some(ComputationPhases { acquisition: 0.01, computation, rendering: 0.02 }),
            ..RequestSample::default()
        };
        let mut trace = Trace::default();
        assert_eq!(trace.mean_parts(), None);
        trace.requests = vec![request(0.5, 0.4), request(0.7, 0.6), RequestSample::default()];
        let found = trace.mean_parts().expect("two are known");
        assert!(found.into_iter().zip([0.01, 0.5, 0.02, 0.07]).all(|(one, other)| (one - other).abs() < 1e-9));
    }
}
