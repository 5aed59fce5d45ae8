//! Cores and memory, in exact numbers.

/// Cores (in thousandths, so that sums are exact) and memory.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Amount {
    /// Thousandths of a core.
    pub millicpus: u64,
    /// Bytes.
    pub memory: u64,
}

impl Amount {
    /// No memory and no cores.
    pub const NONE: Amount = Amount {
        millicpus: 0,
        memory: 0,
    };

    /// From cores and bytes.
    pub fn new(cpus: f64, memory: u64) -> Amount {
        Amount {
            millicpus: (cpus * 1000.0).round() as u64,
            memory,
        }
    }

    /// Cores.
    pub fn cpus(self) -> f64 {
        self.millicpus as f64 / 1000.0
    }

    /// Both together.
    pub fn plus(self, other: Amount) -> Amount {
        Amount {
            millicpus: self.millicpus.saturating_add(other.millicpus),
            memory: self.memory.saturating_add(other.memory),
        }
    }

    /// So many of them.
    pub fn times(self, count: u64) -> Amount {
        Amount {
            millicpus: self.millicpus.saturating_mul(count),
            memory: self.memory.saturating_mul(count),
        }
    }

    /// What is left of it, down to nothing.
    pub fn minus(self, other: Amount) -> Amount {
        Amount {
            millicpus: self.millicpus.saturating_sub(other.millicpus),
            memory: self.memory.saturating_sub(other.memory),
        }
    }

    /// The more of both, of cores and of memory.
    pub fn max(self, other: Amount) -> Amount {
        Amount {
            millicpus: self.millicpus.max(other.millicpus),
            memory: self.memory.max(other.memory),
        }
    }

    /// Whether it is no more than `free`, of cores and of memory.
    pub fn fits(self, free: Amount) -> bool {
        self.millicpus <= free.millicpus && self.memory <= free.memory
    }
}
