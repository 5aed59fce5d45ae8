//! `/diagnostics` (diagnostic_msgs/DiagnosticArray): how a node's promise stands, where robots show such things.
//!
//! A node of its own publishes it, `NODE_cloudroid`: the stub's node looks like the original's.

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::{BufMut, Bytes, BytesMut};
use qos::{Local, LocalState, Report};
use ros::bus::{Bus, BusError, Publisher, Qos, WireType};

const TOPIC: &str = "/diagnostics";
/// DiagnosticStatus' levels.
const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;

const DEFINITION: &str = "\
Header header
DiagnosticStatus[] status
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: diagnostic_msgs/DiagnosticStatus
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
KeyValue[] values
================================================================================
MSG: diagnostic_msgs/KeyValue
string key
string value
";

/// One node's entry in `/diagnostics`.
pub struct Diagnostics {
    publisher: Box<dyn Publisher>,
    /// The entry's name.
    name: String,
    /// The robot's id.
    robot: String,
    sequence: u32,
}

impl Diagnostics {
    /// Advertises it on `bus`, for the node of this name.
    pub async fn new(bus: &Arc<dyn Bus>, node: &str, robot: &str) -> Result<Self, BusError> {
        Ok(Self {
            publisher: bus.advertise(TOPIC, wire_type(), Qos::keep_last(2)).await?,
            name: format!("{}: cloudroid", node.trim_start_matches('/')),
            robot: robot.to_owned(),
            sequence: 0,
        })
    }

    /// Publishes the state of the promise.
    pub fn publish(&mut self, report: &Report) {
        self.sequence = self.sequence.wrapping_add(1);
        let bytes = array(self.sequence, &self.name, &self.robot, report);
        self.publisher.publish(bytes);
    }
}

fn wire_type() -> WireType {
    WireType::new(
        "diagnostic_msgs/DiagnosticArray",
        "60810da900de1dd6ddd437c3503511da",
        DEFINITION,
    )
}

/// How bad it is: nobody answers; somebody does, but not as wished for; the cloud keeps its promise.
fn level(report: &Report) -> u8 {
    let unpromised = report.fallback_after.is_some();
    let wished_for = report.link && (unpromised || report.q >= report.threshold);
    let in_its_place = report.local != Local::None && report.local_state != LocalState::Missing;
    if wished_for {
        OK
    } else if report.link || report.fed || in_its_place {
        WARN
    } else {
        ERROR
    }
}

fn values(report: &Report) -> Vec<(String, String)> {
    let counts = &report.counts;
    let yes = |it: bool| if it { "yes" } else { "no" }.to_owned();
    let promise = match report.fallback_after {
        Some(after) => vec![("local original stands in after [s]", after.to_string())],
        None => vec![
            ("Q", format!("{:.2}", report.q)),
            ("Q_t", format!("{:.2}", report.threshold)),
            ("T_desire [s]", report.t_desire.to_string()),
            ("T_max [s]", report.t_max.to_string()),
        ],
    };
    let standing = [
        (
            "local original",
            format!("{:?}", report.local_state).to_lowercase(),
        ),
        ("local original is asked", yes(report.fed)),
        ("requests", counts.requests.to_string()),
        ("answered by the cloud", counts.from_cloud.to_string()),
        (
            "answered by the local original",
            counts.from_local.to_string(),
        ),
        ("failed", counts.failed.to_string()),
    ];
    let late = [
        ("later than T_max by the cloud", counts.late.to_string()),
        (
            "later than T_max by both",
            counts.unanswered_in_time.to_string(),
        ),
        ("safe stops", counts.safe_stops.to_string()),
    ];
    let late = late.into_iter().filter(|_| report.fallback_after.is_none());
    let all = std::iter::once(("link is up", yes(report.link)));
    let all = all.chain(promise).chain(standing).chain(late);
    let mut values: Vec<(String, String)> =
        all.map(|(key, value)| (key.to_owned(), value)).collect();
    for pair in &report.pairs {
        values.push(("request".to_owned(), pair.clone()));
    }
    for phase in &report.phases {
        values.push((
            format!("{} [ms]: median, 90 %, 99 %", phase.phase),
            format!("{:.1}, {:.1}, {:.1}", phase.p50, phase.p90, phase.p99),
        ));
    }
    values
}

fn array(sequence: u32, name: &str, robot: &str, report: &Report) -> Bytes {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    let since = since.unwrap_or_default();
    let mut out = BytesMut::with_capacity(1024);
    out.put_u32_le(sequence);
    // ROS's time ends in 2106.
    out.put_u32_le(u32::try_from(since.as_secs()).unwrap_or(u32::MAX));
    out.put_u32_le(since.subsec_nanos());
    string(&mut out, "");
    out.put_u32_le(1);
    out.put_u8(level(report));
    string(&mut out, name);
    string(&mut out, &report.summary);
    string(&mut out, robot);
    let values = values(report);
    length(&mut out, values.len());
    for (key, value) in values {
        string(&mut out, &key);
        string(&mut out, &value);
    }
    out.freeze()
}

fn length(out: &mut BytesMut, length: usize) {
    out.put_u32_le(u32::try_from(length).unwrap_or(u32::MAX));
}

fn string(out: &mut BytesMut, text: &str) {
    length(out, text.len());
    out.put_slice(text.as_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;
    use qos::{Governor, Limits, Sla};
    use ros::schema::MessageType;
    use std::time::Instant;

    #[test]
    fn the_array_is_what_its_definition_says() {
        let wire_type = wire_type();
        let known = MessageType::from_full_text(&wire_type.name, DEFINITION).unwrap();
        assert_eq!(wire_type.digest, known.md5());
        let sla = serde_json::json!({"t_desire": 0.1, "t_max": 0.3, "local": "none"});
        let mut governor = Governor::<()>::new(Sla::parse(sla).unwrap(), vec![], Limits::default());
        let now = Instant::now();
        let down = array(7, "detect: cloudroid", "rover1", &governor.report(now));
        let mut json = Vec::new();
        ros::codec::to_json(&known, &down, &mut json, &Default::default()).unwrap();
        let json: serde_json::Value = serde_json::from_slice(&json).unwrap();
        let status = &json["status"][0];
        assert_eq!(json["header"]["seq"], 7);
        assert_eq!(status["level"], ERROR, "no link, no local original: {json}");
        assert_eq!(status["hardware_id"], "rover1");
        let values = status["values"].as_array().unwrap();
        let q = values.iter().find(|value| value["key"] == "Q").unwrap();
        assert_eq!(q["value"], "8.00");
        governor.link_up(now, false);
        assert_eq!(level(&governor.report(now)), OK);
        let sla = serde_json::json!({"measure": {"link": {"after": 3}}, "initial": 1});
        let mut governor = Governor::<()>::new(Sla::parse(sla).unwrap(), vec![], Limits::default());
        governor.begin(now);
        let down = governor.report(now);
        let after = (
            "local original stands in after [s]".to_owned(),
            "3".to_owned(),
        );
        assert!(super::values(&down).contains(&after));
        assert!(super::values(&down).iter().all(|(key, _)| key != "Q"));
        assert_eq!(level(&down), WARN);
        governor.link_up(now, false);
        assert_eq!(level(&governor.report(now)), OK, "nothing was promised");
    }
}
