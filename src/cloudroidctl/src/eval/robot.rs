//! What a robot has: cores and memory.

use std::fmt;

use api::Size;
use serde::Serialize;

/// Kinds of robots, as in the published evaluation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Class {
    /// A quarter of a core and 1 GiB, as a Raspberry Pi.
    Pi,
    /// Half a core and 4 GiB.
    Ultrabook,
}

/// Reads cores, as the daemon measures with them.
pub fn cores(text: &str) -> Result<f64, String> {
    let cores: f64 = text
        .parse()
        .map_err(|_| "it is no number of cores".to_owned())?;
    match (0.01..=4096.0).contains(&cores) {
        true => Ok(cores),
        false => Err("cores are between 0.01 and 4096".to_owned()),
    }
}

/// Reads memory that something can be measured with.
pub fn memory(text: &str) -> Result<Size, String> {
    let memory: Size = text.parse().map_err(|wrong| format!("{wrong}"))?;
    match memory >= Size(16 << 20) {
        true => Ok(memory),
        false => Err("it is 16M or more, such as 512M".to_owned()),
    }
}

/// Reads a number of requests that says something.
pub fn requests(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(requests @ 10..=10_000) => Ok(requests),
        _ => Err("requests are between 10 and 10000".to_owned()),
    }
}

/// What one has.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Robot {
    /// Its class; none where both numbers were given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class: Option<Class>,
    /// Cores, each as fast as one of the server's.
    pub cpus: f64,
    /// Memory.
    pub memory: Size,
}

impl Robot {
    /// Of a class, with those numbers that are given.
    pub fn new(class: Class, cpus: Option<f64>, memory: Option<Size>) -> Robot {
        let (its_cpus, its_memory) = match class {
            Class::Pi => (0.25, Size(1 << 30)),
            Class::Ultrabook => (0.5, Size(4 << 30)),
        };
        Robot {
            class: (cpus.is_none() || memory.is_none()).then_some(class),
            cpus: cpus.unwrap_or(its_cpus),
            memory: memory.unwrap_or(its_memory),
        }
    }
}

impl fmt::Display for Robot {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            out,
            "a robot with {} cores and {} of memory",
            self.cpus, self.memory
        )
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
        assert_eq!(cores("0.25"), Ok(0.25));
        assert!(memory("1").expect_err("too little").contains("16M"));
        memory("much").expect_err("no size");
        assert_eq!(memory("512M"), Ok(Size(512 << 20)));
        assert!(
            requests("9")
                .expect_err("too few")
                .contains("between 10 and")
        );
        assert_eq!(requests("10"), Ok(10));
    }

    #[test]
    fn numbers_that_are_given_take_the_place_of_the_classs() {
        let pi = Robot::new(Class::Pi, None, None);
        assert_eq!((pi.cpus, pi.memory), (0.25, Size(1 << 30)));
        assert_eq!(pi.to_string(), "a robot with 0.25 cores and 1G of memory");
        let ultrabook = Robot::new(Class::Ultrabook, None, None);
        assert_eq!((ultrabook.cpus, ultrabook.memory), (0.5, Size(4 << 30)));
        let own = Robot::new(Class::Ultrabook, Some(2.0), None);
        assert_eq!((own.cpus, own.memory), (2.0, Size(4 << 30)));
        assert_eq!(own.class, Some(Class::Ultrabook));
        let own = Robot::new(Class::Pi, Some(2.0), Some(Size(64 << 20)));
        assert_eq!((own.class, own.memory), (None, Size(64 << 20)));
    }
}
