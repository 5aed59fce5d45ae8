//! Amounts of cores and memory, in exact numbers.

/// An amount of cores (in thousandths, so that sums are exact) and memory.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Amount {
    /// Thousandths of a core.
    pub millicpus: u64,
    /// Bytes.
    pub memory: u64,
}

impl Amount {
    /// No cores and no memory.
    pub const NONE: Amount = Amount { millicpus: 0, memory: 0 };

    /// Creates an amount from cores and bytes.
    pub fn new(cpus: f64, memory: u64) -> Amount {
        Amount { millicpus: (cpus * 1000.0).round() as u64, memory }
    }

    /// Returns the number of cores.
    pub fn cpus(self) -> f64 {
        self.millicpus as f64 / 1000.0
    }

    /// Returns the saturating sum.
    pub fn plus(self, other: Amount) -> Amount {
        Amount {
            millicpus: self.millicpus.saturating_add(other.millicpus),
            memory: self.memory.saturating_add(other.memory),
        }
    }

    /// Returns the saturating product with `count`.
    pub fn times(self, count: u64) -> Amount {
        Amount { millicpus: self.millicpus.saturating_mul(count), memory: self.memory.saturating_mul(count) }
    }

    /// Returns the difference, at least zero.
    pub fn minus(self, other: Amount) -> Amount {
        Amount {
            millicpus: self.millicpus.saturating_sub(other.millicpus),
            memory: self.memory.saturating_sub(other.memory),
        }
    }

    /// Returns the maximum of cores and of memory.
    pub fn max(self, other: Amount) -> Amount {
        Amount { millicpus: self.millicpus.max(other.millicpus), memory: self.memory.max(other.memory) }
    }

    /// Returns true if neither cores nor memory exceed `free`.
    pub fn fits(self, free: Amount) -> bool {
        self.millicpus <= free.millicpus && self.memory <= free.memory
    }
}
