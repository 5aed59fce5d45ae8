//! Resources of a robot: cores and memory.

use std::fmt;

use anyhow::{bail, ensure};
use api::Size;
use serde::Serialize;

/// Classes of robots, as in the published evaluation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum RobotClass {
    /// A quarter of a core and 1 GiB, like a Raspberry Pi.
    Pi,
    /// Half a core and 4 GiB.
    Ultrabook,
}

/// Parses a number of cores in the range in which the daemon measures.
pub fn cores(text: &str) -> anyhow::Result<f64> {
    let Ok(cores) = text.parse::<f64>() else {
        bail!("not a number of cores");
    };
    ensure!((0.01..=4096.0).contains(&cores), "expected 0.01 to 4096 cores");
    Ok(cores)
}

/// Parses an amount of memory that is large enough for a measurement.
pub fn memory(text: &str) -> anyhow::Result<Size> {
    let memory: Size = text.parse()?;
    ensure!(memory >= Size(16 << 20), "expected at least 16M, such as 512M");
    Ok(memory)
}

/// Parses a number of requests that is large enough to be significant.
pub fn requests(text: &str) -> anyhow::Result<usize> {
    match text.parse() {
        Ok(requests @ 10..=10_000) => Ok(requests),
        _ => bail!("expected 10 to 10000 requests"),
    }
}

/// Resources of a robot.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RobotResources {
    /// Class of the robot; `None` if both numbers were given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class: Option<RobotClass>,
    /// Number of cores, each as fast as one of the server's.
    pub cpus: f64,
    /// Memory in bytes.
    pub memory: Size,
}

impl RobotResources {
    /// Returns the resources of a class, replaced by the given numbers.
    pub fn new(class: RobotClass, cpus: Option<f64>, memory: Option<Size>) -> RobotResources {
        let (its_cpus, its_memory) = match class {
            RobotClass::Pi => (0.25, Size(1 << 30)),
            RobotClass::Ultrabook => (0.5, Size(4 << 30)),
        };
        RobotResources {
            class: (cpus.is_none() || memory.is_none()).then_some(class),
            cpus: cpus.unwrap_or(its_cpus),
            memory: memory.unwrap_or(its_memory),
        }
    }
}

impl fmt::Display for RobotResources {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "a robot with {} cores and {} of memory", self.cpus, self.memory)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_measured_is_refused_with_its_range() {
        for wrong in ["0", "nan", "-1", "inf", "many", ""] {
            cores(wrong).expect_err(wrong);
            requests(wrong).expect_err(wrong);
        }
        assert_eq!(cores("0.25").expect("a number"), 0.25);
        let refused = memory("1").expect_err("too little").to_string();
        assert!(refused.contains("16M"), "{refused}");
        memory("much").expect_err("no size");
        assert_eq!(memory("512M").expect("a size"), Size(512 << 20));
        let refused = requests("9").expect_err("too few").to_string();
        assert!(refused.contains("expected 10 to"), "{refused}");
        assert_eq!(requests("10").expect("enough"), 10);
    }

    #[test]
    fn numbers_that_are_given_take_the_place_of_the_classs() {
        let pi = RobotResources::new(RobotClass::Pi, None, None);
        assert_eq!((pi.cpus, pi.memory), (0.25, Size(1 << 30)));
        assert_eq!(pi.to_string(), "a robot with 0.25 cores and 1G of memory");
        let ultrabook = RobotResources::new(RobotClass::Ultrabook, None, None);
        assert_eq!((ultrabook.cpus, ultrabook.memory), (0.5, Size(4 << 30)));
        let own = RobotResources::new(RobotClass::Ultrabook, Some(2.0), None);
        assert_eq!((own.cpus, own.memory), (2.0, Size(4 << 30)));
        assert_eq!(own.class, Some(RobotClass::Ultrabook));
        let own = RobotResources::new(RobotClass::Pi, Some(2.0), Some(Size(64 << 20)));
        assert_eq!((own.class, own.memory), (None, Size(64 << 20)));
    }
}
