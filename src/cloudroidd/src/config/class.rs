//! Classes of robots: `[class.NAME]`.

use anyhow::{Context, bail};
use api::{Limits, Size, Sla};
use serde::Deserialize;

/// A class of robots.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ClassConfig {
    /// Priority: robots of a class with a greater one are served first (0 without a class).
    pub priority: i32,
    /// Largest number of cores that a robot may request.
    pub max_cpus: Option<f64>,
    /// Largest amount of memory that a robot may request.
    pub max_memory: Option<Size>,
    /// SLA of robots that state neither an SLA nor resources.
    pub sla: Sla,
    /// Limits if neither the robot nor the push sets any.
    pub limits: Limits,
}

impl ClassConfig {
    /// Largest priority, and with a minus sign the smallest.
    const PRIORITIES: i32 = 1000;

    /// Refuses a class with invalid or contradictory values.
    pub(super) fn check(&self, name: &str) -> anyhow::Result<()> {
        if let Err(reason) = api::sla::check_name(name) {
            bail!("class {reason}");
        }
        let most = Self::PRIORITIES;
        if !(-most..=most).contains(&self.priority) {
            bail!("priority = {} is not between -{most} and {most}", self.priority);
        }
        let caps = Limits { cpus: self.max_cpus, memory: self.max_memory, ..Limits::default() };
        if let Err(error) = caps.check() {
            bail!("max_{error}");
        }
        self.sla.check().context("sla")?;
        self.limits.check().context("limits")?;
        let limits = &self.limits;
        if let (Some(has), Some(most)) = (limits.cpus, self.max_cpus)
            && has > most
        {
            bail!("limits: cpus = {has} is more than max_cpus = {most}; lower it, or raise max_cpus");
        }
        if let (Some(has), Some(most)) = (limits.memory, self.max_memory)
            && has > most
        {
            bail!("limits: memory = {has} is more than max_memory = {most}; lower it, or raise max_memory");
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn classes_are_read_and_what_they_cannot_be_is_named() {
        let config = Config::parse(
            "[class.default]\nmax_cpus = 1\nmax_memory = \"1G\"\n\
             [class.urgent]\npriority = 10\nsla = { rrt = \"100ms\", max_rrt = 0.3 }\nlimits = { cpus = 0.5 }",
        )
        .expect("valid");
        config.check().expect("they work together");
        let classes = config.choreographer_options().classes;
        assert_eq!(classes["default"].caps.memory, Some(Size(1 << 30)));
        let urgent = &classes["urgent"];
        assert_eq!((urgent.priority, urgent.limits.cpus), (10, Some(0.5)));
        assert_eq!(urgent.sla.max_rrt, api::Span::from_millis(300));
        for (text, words) in [
            ("[class.\"a b\"]", &["[class.a b]", "is not a name"][..]),
            ("[class.a]\npriority = 2000", &["[class.a]", "between -1000 and 1000"]),
            ("[class.a]\nmax_cpus = 0", &["max_cpus = 0 is not between"]),
            ("[class.a]\nmax_memory = \"1K\"", &["max_memory = 1K is too little"]),
            ("[class.a]\nsla = { rrt = 2, max_rrt = 1 }", &["sla", "rrt (2s) is greater than max_rrt (1s)"]),
            ("[class.a]\nlimits = { pids = 1 }", &["limits", "pids = 1"]),
            (
                "[class.a]\nmax_cpus = 1\nlimits = { cpus = 2 }",
                &["cpus = 2 is more than max_cpus = 1", "raise max_cpus"],
            ),
            (
                "[class.a]\nmax_memory = \"1G\"\nlimits = { memory = \"2G\" }",
                &["memory = 2G is more than max_memory = 1G"],
            ),
        ] {
            let config = Config::parse(text).expect("well-formed");
            let refused = format!("{:#}", config.check().expect_err(text));
            for words in words {
                assert!(refused.contains(words), "{text}: {refused}");
            }
        }
        for (text, words) in [
            ("[class.a]\nprio = 1", "prio"),
            ("[class.a]\nsla = { rtt = 1 }", "rtt"),
            ("[class.a]\nsla = { rrt = \"soon\" }", "\"soon\" is not a time"),
        ] {
            let refused = format!("{:#}", Config::parse(text).expect_err(text));
            assert!(refused.contains(words), "{refused}");
        }
    }
}
