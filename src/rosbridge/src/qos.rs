//! `qos` in `advertise`, `publish` and `subscribe`: the quality of service that a client asks for, in the words of ROS 2, as
//! rosbridge_suite 4 reads it. Policies are words or the numbers of `rmw/types.h`; what a client leaves out, or calls
//! `system_default`, it does not ask for.

use std::time::Duration;

use crate::fields::Fields;
use crate::{Payload, Problem, Writer};

const QOS: &str = "an object such as {\"reliability\": \"best_effort\", \"depth\": 5}";
const SECONDS: &str = "a number of seconds, {\"sec\": 0, \"nanosec\": 0} or infinite,";
const SECONDS_OR_BEST: &str =
    "a number of seconds, {\"sec\": 0, \"nanosec\": 0}, infinite or best_available";
/// What rmw takes for no end, in seconds: the most that an int64 holds of nanoseconds.
const NO_END: u64 = i64::MAX as u64 / 1_000_000_000;

/// How many messages are kept for who is slow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum History {
    /// The last ones, as many as `depth` says.
    KeepLast,
    /// All, as far as there is room.
    KeepAll,
}

/// Whether messages may be lost on the way.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Reliability {
    /// Sent again until they have come.
    Reliable,
    /// Sent once.
    BestEffort,
    /// The better one that the ends there are allow.
    BestAvailable,
}

/// What newcomers among the subscribers are given.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Durability {
    /// Also what was published before.
    TransientLocal,
    /// What is published from then on.
    Volatile,
    /// The better one that the ends there are allow.
    BestAvailable,
}

/// Who says that a publisher is alive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Liveliness {
    /// ROS, for as long as its node is there.
    Automatic,
    /// Its program.
    ManualByTopic,
    /// The better one that the ends there are allow.
    BestAvailable,
}

/// A length of time that a policy speaks of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Period {
    /// So long; never zero, by which rmw says nothing.
    Of(Duration),
    /// Without end.
    Infinite,
    /// The shortest one that the ends there are allow.
    BestAvailable,
}

/// What a client asks for; none of what it leaves to the server.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub struct Qos {
    /// How many messages are kept.
    pub history: Option<History>,
    /// How many with [`History::KeepLast`]; never 0.
    pub depth: Option<usize>,
    /// Whether messages may be lost.
    pub reliability: Option<Reliability>,
    /// What newcomers are given.
    pub durability: Option<Durability>,
    /// The longest time between two messages.
    pub deadline: Option<Period>,
    /// After which time a message is of no use; never [`Period::BestAvailable`].
    pub lifespan: Option<Period>,
    /// Who says that a publisher is alive.
    pub liveliness: Option<Liveliness>,
    /// Within which time.
    pub liveliness_lease_duration: Option<Period>,
}

/// One policy that is chosen by a word.
struct Policy<T: 'static> {
    key: &'static str,
    /// As problems call it.
    field: &'static str,
    expected: &'static str,
    /// Words, their numbers, and what they mean; nothing, where that is the server's choice.
    choices: &'static [(&'static str, i64, Option<T>)],
}

const HISTORY: Policy<History> = Policy {
    key: "history",
    field: "qos.history",
    expected: "keep_last (1), keep_all (2) or system_default (0)",
    choices: &[
        ("system_default", 0, None),
        ("keep_last", 1, Some(History::KeepLast)),
        ("keep_all", 2, Some(History::KeepAll)),
    ],
};

const RELIABILITY: Policy<Reliability> = Policy {
    key: "reliability",
    field: "qos.reliability",
    expected: "reliable (1), best_effort (2), best_available (4) or system_default (0)",
    choices: &[
        ("system_default", 0, None),
        ("reliable", 1, Some(Reliability::Reliable)),
        ("best_effort", 2, Some(Reliability::BestEffort)),
        ("best_available", 4, Some(Reliability::BestAvailable)),
    ],
};

const DURABILITY: Policy<Durability> = Policy {
    key: "durability",
    field: "qos.durability",
    expected: "transient_local (1), volatile (2), best_available (4) or system_default (0)",
    choices: &[
        ("system_default", 0, None),
        ("transient_local", 1, Some(Durability::TransientLocal)),
        ("volatile", 2, Some(Durability::Volatile)),
        ("best_available", 4, Some(Durability::BestAvailable)),
    ],
};

const LIVELINESS: Policy<Liveliness> = Policy {
    key: "liveliness",
    field: "qos.liveliness",
    expected: "automatic (1), manual_by_topic (3), best_available (5) or system_default (0)",
    choices: &[
        ("system_default", 0, None),
        ("automatic", 1, Some(Liveliness::Automatic)),
        ("manual_by_topic", 3, Some(Liveliness::ManualByTopic)),
        ("best_available", 5, Some(Liveliness::BestAvailable)),
    ],
};

/// Every name in a `qos` object.
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

impl<T: Copy + PartialEq + 'static> Policy<T> {
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
            None => Err(fields.mistyped(self.field, self.expected, value)),
        }
    }

    fn write(&self, choice: Option<T>, writer: &mut Writer<'_>) {
        let known = self.choices.iter().find(|(.., known)| *known == choice);
        if let (Some(_), Some((word, ..))) = (choice, known) {
            writer.text(self.key, word);
        }
    }
}

impl Qos {
    /// The `qos` of an operation, where it has one.
    pub(crate) fn read(fields: &Fields<'_>) -> Result<Option<Self>, Problem> {
        let Some(value) = fields.get("qos") else {
            return Ok(None);
        };
        let Some(qos) = inner(fields) else {
            return Err(fields.mistyped("qos", QOS, value));
        };
        let depth = qos.get("depth").map(|value| match qos.as_integer(value) {
            // More than can be counted is as good as all.
            Some(depth) if depth >= 0 => Ok(usize::try_from(depth).unwrap_or(usize::MAX)),
            _ => Err(qos.mistyped("qos.depth", "a number of messages, 0 or more,", value)),
        });
        let own_names = qos.get("avoid_ros_namespace_conventions");
        if let Some(value) = own_names.filter(|value| qos.as_boolean(value) != Some(false)) {
            let field = "qos.avoid_ros_namespace_conventions";
            return Err(qos.mistyped(field, "false (names are those of ROS)", value));
        }
        Ok(Some(Self {
            history: HISTORY.read(&qos)?,
            depth: depth.transpose()?.filter(|depth| *depth > 0),
            reliability: RELIABILITY.read(&qos)?,
            durability: DURABILITY.read(&qos)?,
            deadline: period(&qos, "deadline", "qos.deadline", true)?,
            lifespan: period(&qos, "lifespan", "qos.lifespan", false)?,
            liveliness: LIVELINESS.read(&qos)?,
            liveliness_lease_duration: period(
                &qos,
                "liveliness_lease_duration",
                "qos.liveliness_lease_duration",
                true,
            )?,
        }))
    }

    /// Names in the `qos` of an operation that mean nothing, as `qos.name`.
    pub(crate) fn unknown(fields: &Fields<'_>) -> Vec<String> {
        let qos = inner(fields);
        let names = qos.iter().flat_map(Fields::names);
        let unknown = names.filter(|name| !NAMES.contains(name));
        unknown.map(|name| format!("qos.{name}")).collect()
    }

    pub(crate) fn write(qos: Option<Self>, writer: &mut Writer<'_>) {
        let Some(qos) = qos else { return };
        writer.object("qos", |writer| {
            HISTORY.write(qos.history, writer);
            writer.optional_count("depth", qos.depth.map(|depth| depth as u64));
            RELIABILITY.write(qos.reliability, writer);
            DURABILITY.write(qos.durability, writer);
            write_period("deadline", qos.deadline, writer);
            write_period("lifespan", qos.lifespan, writer);
            LIVELINESS.write(qos.liveliness, writer);
            let lease = qos.liveliness_lease_duration;
            write_period("liveliness_lease_duration", lease, writer);
        });
    }
}

/// The fields of `qos`; none where it is no object.
fn inner<'a>(fields: &Fields<'a>) -> Option<Fields<'a>> {
    Fields::of(fields.payload("qos")?).ok()
}

/// A length of time, nothing where it is zero. `best`: whether it may be the best there is.
fn period(
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
        (Some(text), _) if best && text.eq_ignore_ascii_case("best_available") => {
            Some(Period::BestAvailable)
        }
        (Some(_), _) => None,
        (None, Some(seconds)) if seconds >= 0.0 => {
            let long = Duration::try_from_secs_f64(seconds);
            Some(long.map_or(Period::Infinite, Period::Of))
        }
        (None, Some(_)) => None,
        (None, None) => fields.payload(key).and_then(parts).map(Period::Of),
    };
    match read {
        None => {
            let expected = if best { SECONDS_OR_BEST } else { SECONDS };
            Err(fields.mistyped(field, expected, value))
        }
        Some(Period::Of(long)) if long.is_zero() => Ok(None),
        Some(Period::Of(long)) if long.as_secs() >= NO_END => Ok(Some(Period::Infinite)),
        read => Ok(read),
    }
}

/// Seconds and nanoseconds, by either ROS's names.
fn parts(value: Payload<'_>) -> Option<Duration> {
    let fields = Fields::of(value).ok()?;
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
