//! Where pictures are lost between a node and a robot: what each place on the way has passed on is counted there, so that the portal's own
//! losses are told apart from those of a camera or an eye that is slow.

use std::fmt;

use anyhow::Result;
use bridge::Metrics;
use serde_json::{Value, json};

use crate::world::number;

/// What a portal tells of the pictures that it has passed on.
pub(crate) fn counts(metrics: &Metrics) -> Value {
    json!({
        "read": metrics.published.get(), "written_off": metrics.node_dropped.get(),
        "heard": metrics.received.get(), "bus": metrics.bus_dropped.get(), "queue": metrics.dropped.get(),
    })
}

/// Pictures that did not come to the next place, by place.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Lost {
    /// The portal's own.
    pub(crate) portal: i64,
    places: Vec<(&'static str, i64)>,
}

impl Lost {
    /// Of so many that a node wrote, of which a robot had `came`.
    pub(crate) fn to_robot(sent: u32, came: f64, counts: &Value) -> Result<Self> {
        let of = |name| anyhow::Ok(number(counts, name)? as i64);
        let (heard, bus, queue) = (of("heard")?, of("bus")?, of("queue")?);
        Ok(Self {
            portal: bus + queue,
            places: vec![
                (
                    "the node's writer or the way to the portal",
                    i64::from(sent) - heard - bus,
                ),
                ("the bus's queue", bus),
                ("the robot's queue in the portal", queue),
                ("the robot", heard - queue - came as i64),
            ],
        })
    }

    /// Of so many that a robot sent, of which a node took `came`. A node that has acknowledged one and keeps the last five may have put a newer
    /// one into its place: that is the node's.
    pub(crate) fn from_robot(sent: u32, came: f64, counts: &Value) -> Result<Self> {
        let of = |name| anyhow::Ok(number(counts, name)? as i64);
        let (read, written_off) = (of("read")?, of("written_off")?);
        Ok(Self {
            portal: written_off,
            places: vec![
                ("the robot", i64::from(sent) - read),
                (
                    "the portal's writer, which the node did not follow",
                    written_off,
                ),
                ("the node", read - written_off - came as i64),
            ],
        })
    }
}

impl fmt::Display for Lost {
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
        let lost = Lost::to_robot(100, 85.0, &counts).expect("counts");
        assert_eq!(lost.portal, 11);
        assert_eq!(
            lost.to_string(),
            "lost: 2 by the node's writer or the way to the portal, 1 by the bus's queue, 10 by the robot's queue in the portal, \
             2 by the robot"
        );
        let lost = Lost::from_robot(100, 91.0, &counts).expect("counts");
        assert_eq!(lost.portal, 3);
        assert_eq!(
            lost.to_string(),
            "lost: 2 by the robot, 3 by the portal's writer, which the node did not follow, 4 by the node"
        );
        let whole = json!({"read": 5, "written_off": 0, "heard": 5, "bus": 0, "queue": 0});
        let lost = Lost::to_robot(5, 5.0, &whole).expect("counts");
        assert_eq!(lost.to_string(), "none lost anywhere");
    }
}
