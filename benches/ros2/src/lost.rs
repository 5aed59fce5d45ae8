//! Location of lost images between a node and a robot: each stage of the path counts what it has passed on, which
//! separates the portal's own losses from those of a slow camera or receiver.

use std::fmt;

use anyhow::Result;
use bridge::Metrics;
use serde_json::{Value, json};

use crate::world::json_number;

/// Returns the portal's counters of the images that it has passed on.
pub(crate) fn metrics_json(metrics: &Metrics) -> Value {
    json!({
        "read": metrics.published.get(), "written_off": metrics.node_dropped.get(),
        "heard": metrics.received.get(), "bus": metrics.bus_dropped.get(), "queue": metrics.dropped.get(),
    })
}

/// Images that did not reach the next stage, by stage.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct PictureLosses {
    /// Losses of the portal itself.
    pub(crate) portal: i64,
    places: Vec<(&'static str, i64)>,
}

impl PictureLosses {
    /// Computes the losses of `sent` images that a node wrote and of which a robot received `came`.
    pub(crate) fn to_robot(sent: u32, came: f64, counts: &Value) -> Result<Self> {
        let of = |name| anyhow::Ok(json_number(counts, name)? as i64);
        let (heard, bus, queue) = (of("heard")?, of("bus")?, of("queue")?);
        Ok(Self {
            portal: bus + queue,
            places: vec![
                ("the node's writer or the way to the portal", i64::from(sent) - heard - bus),
                ("the bus's queue", bus),
                ("the robot's queue in the portal", queue),
                ("the robot", heard - queue - came as i64),
            ],
        })
    }

    /// Computes the losses of `sent` images that a robot sent and of which a node received `came`. A node that keeps
    /// the last five may acknowledge an image and then replace it by a newer one: such a loss is the node's.
    pub(crate) fn from_robot(sent: u32, came: f64, counts: &Value) -> Result<Self> {
        let of = |name| anyhow::Ok(json_number(counts, name)? as i64);
        let (read, written_off) = (of("read")?, of("written_off")?);
        Ok(Self {
            portal: written_off,
            places: vec![
                ("the robot", i64::from(sent) - read),
                ("the portal's writer, which the node did not follow", written_off),
                ("the node", read - written_off - came as i64),
            ],
        })
    }
}

impl fmt::Display for PictureLosses {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lost: Vec<String> = self
            .places
            .iter()
            .filter(|(_, count)| *count != 0)
            .map(|(place, count)| format!("{count} by {place}"))
            .collect();
        match lost.as_slice() {
            [] => out.write_str("none lost anywhere"),
            some => write!(out, "lost: {}", some.join(", ")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_loss_is_its_places() {
        let counts = json!({"read": 98, "written_off": 3, "heard": 97, "bus": 1, "queue": 10});
        let lost = PictureLosses::to_robot(100, 85.0, &counts).expect("counts");
        assert_eq!(lost.portal, 11);
        assert_eq!(
            lost.to_string(),
            "lost: 2 by the node's writer or the way to the portal, 1 by the bus's queue, 10 by the robot's queue in \
             the portal, \
             2 by the robot"
        );
        let lost = PictureLosses::from_robot(100, 91.0, &counts).expect("counts");
        assert_eq!(lost.portal, 3);
        assert_eq!(
            lost.to_string(),
            "lost: 2 by the robot, 3 by the portal's writer, which the node did not follow, 4 by the node"
        );
        let whole = json!({"read": 5, "written_off": 0, "heard": 5, "bus": 0, "queue": 0});
        let lost = PictureLosses::to_robot(5, 5.0, &whole).expect("counts");
        assert_eq!(lost.to_string(), "none lost anywhere");
    }
}
