//! The `/diagnostics` topic (diagnostic_msgs/DiagnosticArray), which shows the state of a node's promise to the usual
//! tools of robots.
//!
//! A separate node, `NODE_cloudroid`, publishes it, because the stub's node looks like the original's.

use std::sync::Arc;

use bytes::Bytes;
use qos::{LocalPolicy, LocalState, QosReport};
use ros::bus::{Bus, BusError, Publisher, QosProfile, RosVersion, WireType};
use ros::codec::{self, FillOptions, Time};
use ros::schema::{MessageType, Registry};
use serde_json::json;

const TOPIC: &str = "/diagnostics";
/// Levels of DiagnosticStatus.
const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;

/// Message definitions, the same in ROS 1 and 2 except for the header, which each version defines itself.
const DEFINITIONS: [(&str, &str); 3] = [
    ("diagnostic_msgs/msg/DiagnosticArray", "std_msgs/Header header\nDiagnosticStatus[] status\n"),
    (
        "diagnostic_msgs/msg/DiagnosticStatus",
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n\
         byte level\nstring name\nstring message\nstring hardware_id\nKeyValue[] values\n",
    ),
    ("diagnostic_msgs/msg/KeyValue", "string key\nstring value\n"),
];

/// The entry of one node in `/diagnostics`.
pub struct Diagnostics {
    publisher: Box<dyn Publisher>,
    /// Name of the entry.
    name: String,
    /// Id of the robot.
    robot: String,
    sequence: u32,
    schema: Arc<MessageType>,
}

impl Diagnostics {
    /// Advertises the topic on `bus`, for the node of this name.
    pub async fn new(bus: &Arc<dyn Bus>, node: &str, robot: &str) -> Result<Self, BusError> {
        let schema = schema(bus.version());
        let of = WireType::from_message(&schema);
        Ok(Self {
            publisher: bus.advertise(TOPIC, of, QosProfile::keep_last(2)).await?,
            name: format!("{}: cloudroid", node.trim_start_matches('/')),
            robot: robot.to_owned(),
            sequence: 0,
            schema,
        })
    }

    /// Publishes the state of the promise.
    pub fn publish(&mut self, report: &QosReport) {
        self.sequence = self.sequence.wrapping_add(1);
        let bytes = encode_array(&self.schema, self.sequence, &self.name, &self.robot, report);
        self.publisher.publish(bytes);
    }
}

fn schema(version: RosVersion) -> Arc<MessageType> {
    let registry = Registry::for_version(version);
    let known = DEFINITIONS
        .iter()
        .try_for_each(|(key, text)| registry.insert(key, text))
        .and_then(|()| registry.message(DEFINITIONS[0].0));
    match known {
        Ok(schema) => schema,
        Err(error) => unreachable!("the definition is ours: {error}"),
    }
}

/// Returns the level: `OK` if the cloud keeps its promise, `WARN` if a node answers but not as desired, `ERROR` if none
/// answers.
fn level(report: &QosReport) -> u8 {
    let unpromised = report.fallback_after.is_some();
    let wished_for = report.link && (unpromised || report.q >= report.threshold);
    let in_its_place = report.local != LocalPolicy::None && report.local_state != LocalState::Missing;
    if wished_for {
        OK
    } else if report.link || report.fed || in_its_place {
        WARN
    } else {
        ERROR
    }
}

fn values(report: &QosReport) -> Vec<(String, String)> {
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
        ("local original", format!("{:?}", report.local_state).to_lowercase()),
        ("local original is asked", yes(report.fed)),
        ("requests", counts.requests.to_string()),
        ("answered by the cloud", counts.from_cloud.to_string()),
        ("answered by the local original", counts.from_local.to_string()),
        ("failed", counts.failed.to_string()),
    ];
    let late = [
        ("later than T_max by the cloud", counts.late.to_string()),
        ("left out by the cloud's node", counts.left_out.to_string()),
        ("later than T_max by both", counts.unanswered_in_time.to_string()),
        ("safe stops", counts.safe_stops.to_string()),
    ];
    let late = late.into_iter().filter(|_| report.fallback_after.is_none());
    let all = std::iter::once(("link is up", yes(report.link)));
    let all = all.chain(promise).chain(standing).chain(late);
    let mut values: Vec<(String, String)> = all.map(|(key, value)| (key.to_owned(), value)).collect();
    if let Some((ago, lost)) = &report.lost {
        let key = format!("lost at the last hand-over, {ago:.0} s ago");
        values.push((key, lost.clone()));
    }
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

fn encode_array(of: &MessageType, sequence: u32, name: &str, robot: &str, report: &QosReport) -> Bytes {
    let Time { secs, nsecs } = Time::now();
    let value = |(key, value)| json!({ "key": key, "value": value });
    let header = match of.version() {
        RosVersion::One => {
            json!({ "seq": sequence, "stamp": { "secs": secs, "nsecs": nsecs } })
        }
        RosVersion::Two => json!({ "stamp": { "sec": secs, "nanosec": nsecs } }),
    };
    let said = json!({
        "header": header,
        "status": [{
            "level": level(report),
            "name": name,
            "message": report.summary,
            "hardware_id": robot,
            "values": values(report).into_iter().map(value).collect::<Vec<_>>(),
        }],
    });
    let mut out = Vec::new();
    let options = FillOptions::default();
    if let Err(error) = codec::from_json(of, said.to_string().as_bytes(), &mut out, &options) {
        unreachable!("the definition is ours: {error}");
    }
    out.into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use qos::{Governor, QosSla, RetentionLimits};
    use std::time::Instant;

    #[test]
    fn robots_of_ros_2_are_told_in_its_form() {
        let known = schema(RosVersion::Two);
        assert_eq!(known.name(), "diagnostic_msgs/msg/DiagnosticArray");
        let sla = serde_json::json!({"t_desire": 0.1, "t_max": 0.3, "local": "none"});
        let governor = Governor::<()>::new(QosSla::parse(sla).unwrap(), vec![], RetentionLimits::default());
        let report = governor.report(Instant::now());
        let told = encode_array(&known, 1, "detect: cloudroid", "rover1", &report);
        assert_eq!(told[..4], [0, 1, 0, 0]);
        let mut json = Vec::new();
        ros::codec::to_json(&known, &told, &mut json, &Default::default()).unwrap();
        let json: serde_json::Value = serde_json::from_slice(&json).unwrap();
        assert!(json["header"]["stamp"]["sec"].as_u64() > Some(1_600_000_000));
        assert_eq!(json["status"][0]["level"], ERROR);
    }

    #[test]
    fn the_array_is_what_its_definition_says() {
        let known = schema(RosVersion::One);
        assert_eq!(known.md5(), "60810da900de1dd6ddd437c3503511da");
        let sla = serde_json::json!({"t_desire": 0.1, "t_max": 0.3, "local": "none"});
        let mut governor = Governor::<()>::new(QosSla::parse(sla).unwrap(), vec![], RetentionLimits::default());
        let now = Instant::now();
        let down = encode_array(&known, 7, "detect: cloudroid", "rover1", &governor.report(now));
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
        let mut governor = Governor::<()>::new(QosSla::parse(sla).unwrap(), vec![], RetentionLimits::default());
        governor.begin(now);
        let down = governor.report(now);
        let after = ("local original stands in after [s]".to_owned(), "3".to_owned());
        assert!(super::values(&down).contains(&after));
        assert!(super::values(&down).iter().all(|(key, _)| key != "Q"));
        assert_eq!(level(&down), WARN);
        governor.link_up(now, false);
        assert_eq!(level(&governor.report(now)), OK, "nothing was promised");
    }
}
