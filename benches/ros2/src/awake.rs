//! Keeps the processors awake while times of microseconds are measured. A core that has nothing to do is halted; on a virtual machine, to wake one
//! takes longer than all else that is measured, and whether a process meets a core that is awake is chance: medians of the same way differ
//! by three times. A loop that gives way to everybody (`SCHED_IDLE`) on each core takes that out.

use std::io;
use std::process::Command;

use anyhow::Result;

use crate::world::Program;

/// Until this is dropped.
pub(crate) struct Awake {
    _loops: Vec<Program>,
}

impl Awake {
    /// One loop for each core.
    pub(crate) fn all() -> Result<Self> {
        let cores = std::thread::available_parallelism()?.get();
        let one = |core: usize| {
            let mut command = Command::new("chrt");
            command
                .args(["--idle", "0"])
                .arg(std::env::current_exe()?)
                .args(["inside", "awake"]);
            Program::start_quietly(command, &format!("what keeps core {core} awake"))
        };
        let loops = (0..cores).map(one).collect::<Result<_>>()?;
        Ok(Self { _loops: loops })
    }
}

/// Plays the role: until its standard input ends, so that it does not outlive who started it.
pub(crate) fn play() -> Result<()> {
    std::thread::spawn(|| {
        loop {
            std::hint::spin_loop();
        }
    });
    io::copy(&mut io::stdin(), &mut io::sink())?;
    Ok(())
}
