//! Description of the machine on which a benchmark ran.

use serde::{Deserialize, Serialize};
use std::fs;

/// A machine, described from `/proc`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct MachineDescription {
    /// Processor model.
    pub processor: String,
    /// Number of processors that the benchmark may use.
    pub processors: usize,
    /// Memory, in GiB.
    pub memory_gib: f64,
    /// Kernel release.
    pub kernel: String,
    /// Distribution.
    pub system: String,
    /// Load average at the start: other work makes times longer and ratios noisier.
    pub load: f64,
}

impl MachineDescription {
    /// Describes this machine; values that cannot be read are left empty.
    pub fn describe() -> Self {
        let read = |path: &str| fs::read_to_string(path).unwrap_or_default();
        let field = |text: &str, key: &str, separator: char| -> String {
            let line = text.lines().find(|line| line.starts_with(key));
            let value = line.and_then(|line| line.split_once(separator)).map(|(_, value)| value);
            value.unwrap_or_default().trim().trim_matches('"').to_owned()
        };
        let memory = field(&read("/proc/meminfo"), "MemTotal", ':');
        let kilobytes: f64 = memory.trim_end_matches("kB").trim().parse().unwrap_or(0.0);
        Self {
            processor: field(&read("/proc/cpuinfo"), "model name", ':'),
            processors: std::thread::available_parallelism().map_or(1, usize::from),
            memory_gib: (kilobytes / 1024.0 / 102.4).round() / 10.0,
            kernel: read("/proc/sys/kernel/osrelease").trim().to_owned(),
            system: field(&read("/etc/os-release"), "PRETTY_NAME", '='),
            load: read("/proc/loadavg").split(' ').next().and_then(|load| load.parse().ok()).unwrap_or(0.0),
        }
    }
}
