//! The table of what may be promised of an output instead of a response time: its rate, or its age.

use link::control::SlaTargets;
use serde_json::{Value, json};

use super::{Config, LocalMode};

/// A measure of an output.
pub struct OutputMeasure {
    /// Key of the acceptable value; also the measure's name in an SLA.
    pub key: &'static str,
    /// Key of the desired value.
    pub desired_key: &'static str,
    /// Keys of the desired and of the acceptable value in the query of a handshake.
    pub stated_keys: [&'static str; 2],
    /// Name of the acceptable value in an SLA.
    bound: &'static str,
    /// Unit behind a value.
    unit: &'static str,
    /// Reads the desired and the acceptable value.
    read: fn(&Config) -> [Option<f64>; 2],
}

/// The rate of an output in Hz, and its age in seconds.
pub static OUTPUT_MEASURES: [OutputMeasure; 2] = [
    OutputMeasure {
        key: "frames_per_second",
        desired_key: "desired_frames_per_second",
        stated_keys: ["fps", "min_fps"],
        bound: "min",
        unit: "",
        read: |config| [config.desired_frames_per_second, config.frames_per_second],
    },
    OutputMeasure {
        key: "age",
        desired_key: "desired_age",
        stated_keys: ["age", "max_age"],
        bound: "max",
        unit: " s",
        read: |config| [config.desired_age, config.age],
    },
];

impl OutputMeasure {
    /// Returns the desired and the acceptable value in a configuration.
    pub fn values(&self, config: &Config) -> [Option<f64>; 2] {
        (self.read)(config)
    }

    /// Returns the measure of an SLA with these values; `None` if it is not promised.
    pub fn promise(&self, config: &Config) -> Option<Value> {
        let [desire, bound] = self.values(config);
        let bound = bound?;
        let output = config.output.as_deref().unwrap_or_default();
        let desire = desire.unwrap_or(bound);
        let values = json!({"output": output, "desire": desire, (self.bound): bound});
        Some(json!({ (self.key): values }))
    }

    /// Returns what is wrong with a desired value that is worse than the acceptable one.
    pub(super) fn find_contradiction(&self, config: &Config) -> Option<String> {
        let [Some(desired), Some(bound)] = self.values(config) else {
            return None;
        };
        let (key, unit) = (self.key, self.unit);
        let is_least = self.bound == "min";
        if is_least && desired < bound {
            Some(format!("({desired}{unit}) is less than {key} ({bound}{unit}), the minimum; raise it, or lower {key}"))
        } else if !is_least && desired > bound {
            Some(format!("({desired}{unit}) is greater than {key} ({bound}{unit}); lower it, or raise {key}"))
        } else {
            None
        }
    }
}

impl Config {
    /// Returns what is promised, as it is told to the cloud.
    pub fn targets(&self) -> SlaTargets {
        SlaTargets {
            desire: self.desire,
            max: self.max,
            frames_per_second: self.frames_per_second,
            desired_frames_per_second: self.desired_frames_per_second,
            age: self.age,
            desired_age: self.desired_age,
            threshold: self.threshold,
            fallback_after: (!self.has_promise() && self.local != LocalMode::None).then_some(self.fallback_after),
        }
    }
}
