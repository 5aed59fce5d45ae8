//! Flags for limits, of `push` and `set`, and for caps.

use anyhow::bail;
use api::{Caps, CpuSet, Limits, Size};

/// Resource limits of a servant.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct LimitFlags {
    /// CPU limit in cores, which is also reserved.
    #[arg(long, value_name = "N", value_parser = cores)]
    cpus: Option<f64>,
    /// CPU weight when cores are scarce, 1 to 10000 (default: 100).
    #[arg(long, value_name = "N")]
    cpu_weight: Option<u64>,
    /// CPUs that the servant may run on, such as 0-3,6; on cgroup v1 it can be changed only for a servant that was
    /// started with it.
    #[arg(long, value_name = "CORES")]
    cpuset: Option<CpuSet>,
    /// Memory limit, which is also reserved, such as 512M.
    #[arg(long, value_name = "SIZE")]
    memory: Option<Size>,
    /// Memory above which the servant is slowed down and its memory reclaimed (cgroup v2).
    #[arg(long, value_name = "SIZE")]
    memory_high: Option<Size>,
    /// Largest number of processes and threads.
    #[arg(long, value_name = "N")]
    pids: Option<u64>,
    /// Disk read rate in bytes per second, such as 10M.
    #[arg(long, value_name = "SIZE")]
    io_read: Option<Size>,
    /// Disk write rate in bytes per second.
    #[arg(long, value_name = "SIZE")]
    io_write: Option<Size>,
}

/// Largest resources that robots may request.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct CapFlags {
    /// Largest number of cores that a robot may request.
    #[arg(long, value_name = "N", value_parser = cores)]
    max_cpus: Option<f64>,
    /// Largest amount of memory that a robot may request, such as 2G.
    #[arg(long, value_name = "SIZE")]
    max_memory: Option<Size>,
}

impl From<CapFlags> for Caps {
    fn from(flags: CapFlags) -> Caps {
        Caps { cpus: flags.max_cpus, memory: flags.max_memory }
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

fn cores(text: &str) -> anyhow::Result<f64> {
    match text.parse::<f64>() {
        Ok(cores) if cores.is_finite() && cores > 0.0 => Ok(cores),
        _ => bail!("write a number of cores such as 1.5"),
    }
}
