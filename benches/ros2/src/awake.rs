//! Keeps the processors awake while durations of microseconds are measured. An idle core is halted; on a virtual
//! machine, waking it takes longer than everything that is measured, and whether a process meets a core that is awake
//! is a matter of chance: medians of the same path differ by a factor of three. A loop of the lowest priority
//! (`SCHED_IDLE`) on each core removes this effect.

use std::io;
use std::process::Command;

use anyhow::Result;

use crate::world::BenchProgram;

/// Keeps all cores awake until drop.
pub(crate) struct AwakeCores {
    _loops: Vec<BenchProgram>,
}

impl AwakeCores {
    /// Starts one loop per core.
    pub(crate) fn start() -> Result<Self> {
        let cores = std::thread::available_parallelism()?.get();
        let one = |core: usize| {
            let mut command = Command::new("chrt");
            command.args(["--idle", "0"]).arg(std::env::current_exe()?).args(["inside", "awake"]);
            BenchProgram::start_quietly(command, &format!("what keeps core {core} awake"))
        };
        let loops = (0..cores).map(one).collect::<Result<_>>()?;
        Ok(Self { _loops: loops })
    }
}

/// Runs the role until its standard input ends, so that it does not outlive its parent.
pub(crate) fn run() -> Result<()> {
    std::thread::spawn(|| {
        loop {
            std::hint::spin_loop();
        }
    });
    io::copy(&mut io::stdin(), &mut io::sink())?;
    Ok(())
}
