//! `qos` in `advertise`, `publish` and `subscribe`: the quality of service requested by a client, in the terms of ROS
//! 2, as read by rosbridge_suite 4. Policies are words or the numbers of `rmw/types.h`; a policy that is left out or
//! `system_default` is not requested.

use std::time::Duration;

use crate::fields::Fields;
use crate::{Payload, Problem, Writer};

const QOS: &str = "an object such as {\"reliability\": \"best_effort\", \"depth\": 5}";
const SECONDS: &str = "a number of seconds, {\"sec\": 0, \"nanosec\": 0} or infinite,";
const SECONDS_OR_BEST: &str = "a number of seconds, {\"sec\": 0, \"nanosec\": 0}, infinite or best_available";
/// Seconds that rmw treats as infinite: the largest int64 of nanoseconds.
const NO_END: u64 = i64::MAX as u64 / 1_000_000_000;

/// Number of messages kept for slow subscribers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum HistoryPolicy {
    /// The last ones, up to `depth`.
    KeepLast,
    /// All, as far as there is room.
    KeepAll,
}

/// Delivery guarantee of messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ReliabilityPolicy {
    /// Resent until received.
    Reliable,
    /// Sent once.
    BestEffort,
    /// The better one that the existing endpoints support.
    BestAvailable,
}

/// Messages delivered to new subscribers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DurabilityPolicy {
    /// New subscribers also get messages published earlier.
    TransientLocal,
    /// New subscribers get only messages published from then on.
    Volatile,
    /// The better one that the existing endpoints support.
    BestAvailable,
}

/// Assertion that a publisher is alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum LivelinessPolicy {
    /// The middleware, for as long as the node runs.
    Automatic,
    /// The publisher's program.
    ManualByTopic,
    /// The better one that the existing endpoints support.
    BestAvailable,
}

/// Duration of a policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Period {
    /// A finite duration; never zero, which means unspecified in rmw.
    Of(Duration),
    /// No limit.
    Infinite,
    /// The shortest one that the existing endpoints support.
    BestAvailable,
}

/// Policies requested or offered by a client; `None` for those left to the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct QosRequest {
    /// History policy.
    pub history: Option<HistoryPolicy>,
    /// Number of messages for [`HistoryPolicy::KeepLast`]; never 0.
    pub depth: Option<usize>,
    /// Reliability policy.
    pub reliability: Option<ReliabilityPolicy>,
    /// Durability policy.
    pub durability: Option<DurabilityPolicy>,
    /// Maximum time between two messages.
    pub deadline: Option<Period>,
    /// Time after which a message is discarded as too old; never [`Period::BestAvailable`].
    pub lifespan: Option<Period>,
    /// Liveliness policy.
    pub liveliness: Option<LivelinessPolicy>,
    /// Time within which a publisher must assert its liveliness.
    pub liveliness_lease_duration: Option<Period>,
}

/// A policy that is chosen by a keyword.
struct PolicyField<T: 'static> {
    key: &'static str,
    /// Name of the field in error messages.
    field: &'static str,
    expected: &'static str,
    /// Keywords, their numbers and values; `None` for the server's choice.
    choices: &'static [(&'static str, i64, Option<T>)],
}

const HISTORY: PolicyField<HistoryPolicy> = PolicyField {
    key: "history",
    field: "qos.history",
    expected: "keep_last (1), keep_all (2) or system_default (0)",
    choices: &[
        ("system_default", 0, None),
        ("keep_last", 1, Some(HistoryPolicy::KeepLast)),
        ("keep_all", 2, Some(HistoryPolicy::KeepAll)),
    ],
};

const RELIABILITY: PolicyField<ReliabilityPolicy> = PolicyField {
    key: "reliability",
    field: "qos.reliability",
    expected: "reliable (1), best_effort (2), best_available (4) or system_default (0)",
    choices: &[
        ("system_default", 0, None),
        ("reliable", 1, Some(ReliabilityPolicy::Reliable)),
        ("best_effort", 2, Some(ReliabilityPolicy::BestEffort)),
        ("best_available", 4, Some(ReliabilityPolicy::BestAvailable)),
    ],
};

const DURABILITY: PolicyField<DurabilityPolicy> = PolicyField {
    key: "durability",
    field: "qos.durability",
    expected: "transient_local (1), volatile (2), best_available (4) or system_default (0)",
    choices: &[
        ("system_default", 0, None),
        ("transient_local", 1, Some(DurabilityPolicy::TransientLocal)),
        ("volatile", 2, Some(DurabilityPolicy::Volatile)),
        ("best_available", 4, Some(DurabilityPolicy::BestAvailable)),
    ],
};

const LIVELINESS: PolicyField<LivelinessPolicy> = PolicyField {
    key: "liveliness",
    field: "qos.liveliness",
    expected: "automatic (1), manual_by_topic (3), best_available (5) or system_default (0)",
    choices: &[
        ("system_default", 0, None),
        ("automatic", 1, Some(LivelinessPolicy::Automatic)),
        ("manual_by_topic", 3, Some(LivelinessPolicy::ManualByTopic)),
        ("best_available", 5, Some(LivelinessPolicy::BestAvailable)),
    ],
};

/// Names allowed in a `qos` object.
const NAMES: [&str; 9] = [
    "history",
    "depth",
    "reliability",
    "durability",
    "deadline",
    "lifespan",
    "liveliness",
    "liveliness_lease_duration",
    "avoid_ros_namespace_conventions",
];

impl<T: Copy + PartialEq + 'static> PolicyField<T> {
    fn read(&self, fields: &Fields<'_>) -> Result<Option<T>, Problem> {
        let Some(value) = fields.get(self.key) else {
            return Ok(None);
        };
        let text = fields.as_text(value);
        let number = match text {
            Some(_) => None,
            None => fields.as_integer(value),
        };
        let meant = |(word, known, _): &&(&str, i64, Option<T>)| match &text {
            Some(text) => text.eq_ignore_ascii_case(word),
            None => number == Some(*known),
        };
        match self.choices.iter().find(meant) {
            Some((.., choice)) => Ok(*choice),
            None => Err(fields.mistyped_error(self.field, self.expected, value)),
        }
    }

    fn write(&self, choice: Option<T>, writer: &mut Writer<'_>) {
        let known = self.choices.iter().find(|(.., known)| *known == choice);
        if let (Some(_), Some((word, ..))) = (choice, known) {
            writer.text(self.key, word);
        }
    }
}

impl QosRequest {
    /// Reads the `qos` of an operation, if it has one.
    pub(crate) fn read(fields: &Fields<'_>, field: &'static str) -> Result<Option<Self>, Problem> {
        let Some(value) = fields.get(field) else {
            return Ok(None);
        };
        let Some(qos) = qos_fields(fields) else {
            return Err(fields.mistyped_error(field, QOS, value));
        };
        let depth = qos.get("depth").map(|value| match qos.as_integer(value) {
            // A depth too large for usize means all.
            Some(depth) if depth >= 0 => Ok(usize::try_from(depth).unwrap_or(usize::MAX)),
            _ => Err(qos.mistyped_error("qos.depth", "a number of messages, 0 or more,", value)),
        });
        let own_names = qos.get("avoid_ros_namespace_conventions");
        if let Some(value) = own_names.filter(|value| qos.as_boolean(value) != Some(false)) {
            let field = "qos.avoid_ros_namespace_conventions";
            return Err(qos.mistyped_error(field, "false (names are those of ROS)", value));
        }
        Ok(Some(Self {
            history: HISTORY.read(&qos)?,
            depth: depth.transpose()?.filter(|depth| *depth > 0),
            reliability: RELIABILITY.read(&qos)?,
            durability: DURABILITY.read(&qos)?,
            deadline: parse_period(&qos, "deadline", "qos.deadline", true)?,
            lifespan: parse_period(&qos, "lifespan", "qos.lifespan", false)?,
            liveliness: LIVELINESS.read(&qos)?,
            liveliness_lease_duration: parse_period(
                &qos,
                "liveliness_lease_duration",
                "qos.liveliness_lease_duration",
                true,
            )?,
        }))
    }

    /// Returns the unknown names in the `qos` of an operation, as `qos.name`.
    pub(crate) fn unknown_names(fields: &Fields<'_>) -> Vec<String> {
        let qos = qos_fields(fields);
        let names = qos.iter().flat_map(Fields::names);
        let unknown = names.filter(|name| !NAMES.contains(name));
        unknown.map(|name| format!("qos.{name}")).collect()
    }

    pub(crate) fn write(&self, writer: &mut Writer<'_>, field: &str) {
        writer.object(field, |writer| {
            HISTORY.write(self.history, writer);
            writer.optional_count("depth", self.depth.map(|depth| depth as u64));
            RELIABILITY.write(self.reliability, writer);
            DURABILITY.write(self.durability, writer);
            write_period("deadline", self.deadline, writer);
            write_period("lifespan", self.lifespan, writer);
            LIVELINESS.write(self.liveliness, writer);
            let lease = self.liveliness_lease_duration;
            write_period("liveliness_lease_duration", lease, writer);
        });
    }
}

/// Returns the fields of `qos`; `None` if it is not an object.
fn qos_fields<'a>(fields: &Fields<'a>) -> Option<Fields<'a>> {
    Fields::from_payload(fields.payload("qos")?).ok()
}

/// Reads a duration; `None` if it is zero. `best`: whether `best_available` is allowed.
fn parse_period(
    fields: &Fields<'_>,
    key: &'static str,
    field: &'static str,
    best: bool,
) -> Result<Option<Period>, Problem> {
    let Some(value) = fields.get(key) else {
        return Ok(None);
    };
    let read = match (fields.as_text(value), fields.as_number(value)) {
        (Some(text), _) if text.eq_ignore_ascii_case("infinite") => Some(Period::Infinite),
        (Some(text), _) if best && text.eq_ignore_ascii_case("best_available") => Some(Period::BestAvailable),
        (Some(_), _) => None,
        (None, Some(seconds)) if seconds >= 0.0 => {
            let long = Duration::try_from_secs_f64(seconds);
            Some(long.map_or(Period::Infinite, Period::Of))
        }
        (None, Some(_)) => None,
        (None, None) => fields.payload(key).and_then(parse_time_parts).map(Period::Of),
    };
    match read {
        None => {
            let expected = if best { SECONDS_OR_BEST } else { SECONDS };
            Err(fields.mistyped_error(field, expected, value))
        }
        Some(Period::Of(long)) if long.is_zero() => Ok(None),
        Some(Period::Of(long)) if long.as_secs() >= NO_END => Ok(Some(Period::Infinite)),
        read => Ok(read),
    }
}

/// Reads seconds and nanoseconds, by the names of either ROS version.
fn parse_time_parts(value: Payload<'_>) -> Option<Duration> {
    let fields = Fields::from_payload(value).ok()?;
    let part = |names: [&str; 3]| {
        let value = names.iter().find_map(|name| fields.get(name))?;
        u64::try_from(fields.as_integer(value)?).ok()
    };
    let seconds = part(["sec", "secs", "seconds"])?;
    let nanoseconds = part(["nanosec", "nsecs", "nsec"])?;
    Some(Duration::from_secs(seconds).saturating_add(Duration::from_nanos(nanoseconds)))
}

fn write_period(key: &str, period: Option<Period>, writer: &mut Writer<'_>) {
    match period {
        None => {}
        Some(Period::Infinite) => writer.text(key, "infinite"),
        Some(Period::BestAvailable) => writer.text(key, "best_available"),
        Some(Period::Of(long)) => writer.object(key, |writer| {
            writer.optional_count("sec", Some(long.as_secs()));
            writer.integer("nanosec", i64::from(long.subsec_nanos()));
        }),
    }
}

#[cfg(test)]
#[path = "qos_tests.rs"]
mod tests;
