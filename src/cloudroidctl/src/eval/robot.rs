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
