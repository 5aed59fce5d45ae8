//! Limits as flags, of `push` and `set`, and caps.

use api::{Caps, CpuSet, Limits, Size};

/// What a servant may use.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct LimitFlags {
    /// Cores that a servant may use, and is promised.
    #[arg(long, value_name = "N", value_parser = cores)]
    cpus: Option<f64>,
    /// Its share when cores are scarce, 1 to 10000; 100 by default.
    #[arg(long, value_name = "N")]
    cpu_weight: Option<u64>,
    /// The cores it may run on, such as 0-3,6; on cgroup v1 only a servant that starts with some.
    #[arg(long, value_name = "CORES")]
    cpuset: Option<CpuSet>,
    /// Memory that a servant may use, and is promised, such as 512M.
    #[arg(long, value_name = "SIZE")]
    memory: Option<Size>,
    /// Memory above which it is slowed down and made to give back (cgroup v2).
    #[arg(long, value_name = "SIZE")]
    memory_high: Option<Size>,
    /// Processes and threads.
    #[arg(long, value_name = "N")]
    pids: Option<u64>,
    /// Bytes a second that it may read from disk, such as 10M.
    #[arg(long, value_name = "SIZE")]
    io_read: Option<Size>,
    /// Bytes a second that it may write to disk.
    #[arg(long, value_name = "SIZE")]
    io_write: Option<Size>,
}

/// The most that robots may ask for.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct CapFlags {
    /// Cores that a robot may ask for at most.
    #[arg(long, value_name = "N", value_parser = cores)]
    max_cpus: Option<f64>,
    /// Memory that a robot may ask for at most, such as 2G.
    #[arg(long, value_name = "SIZE")]
    max_memory: Option<Size>,
}

impl From<CapFlags> for Caps {
    fn from(flags: CapFlags) -> Caps {
        Caps {
            cpus: flags.max_cpus,
            memory: flags.max_memory,
        }
    }
}

impl From<LimitFlags> for Limits {
    fn from(flags: LimitFlags) -> Limits {
        Limits {
            cpus: flags.cpus,
            cpu_weight: flags.cpu_weight,
            memory: flags.memory,
            memory_high: flags.memory_high,
            pids: flags.pids,
            io_read: flags.io_read,
            io_write: flags.io_write,
            cpuset: flags.cpuset,
        }
    }
}

fn cores(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(cores) if cores.is_finite() && cores > 0.0 => Ok(cores),
        _ => Err("write a number of cores such as 1.5".to_owned()),
    }
}
