//! Limits, usage and reliable termination of a servant, by control groups of the version that the host offers.
//!
//! ```text
//!  v2   PARENT/                  delegated to us, contains no process itself
//!         ID/                    one servant: its init and its nodes
//!         ID.shim/               its shim
//!  v1   OWN/cloudroid/ID/        in each hierarchy used, below our own cgroup there
//!       OWN/cloudroid/ID.shim/   in those of processor time and memory
//! ```
//! A servant can make its shim work (it calls the ROS Master there, and prints), so the shim has limits, too. They are
//! separate from the servant's: the shim must be able to report that a servant ran out of memory.
//!
//! On a hybrid host the controllers are on v1, and the empty v2 hierarchy beside them is still useful: it has
//! `cgroup.kill`, and counts processor time.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::Error;
use crate::container::ContainerSpec;
use crate::engine::{EnforcedLimits, Usage};
use crate::spec::Limits;

mod disk;
mod files;
mod hosts;
mod v1;
mod v2;

use files::{read_number, read_pids};
pub use hosts::CgroupParent;
pub use v1::counts_sockets;

/// The cgroup directories of one servant or shim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cgroup {
    /// Cgroup version, 1 or 2; 0 if there is none.
    pub version: u8,
    /// One directory for each hierarchy in use.
    leaves: Vec<CgroupDirectory>,
    /// `MAJOR:MINOR` of the disk whose I/O is limited.
    #[serde(default)]
    disk: Option<String>,
}

/// A directory in one hierarchy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct CgroupDirectory {
    /// Controllers available here.
    controllers: Vec<String>,
    directory: PathBuf,
    /// True for a v2 hierarchy.
    unified: bool,
}

impl Cgroup {
    /// Returns the cgroup of a servant, which need not exist yet.
    pub fn for_servant(parent: &CgroupParent, spec: &ContainerSpec) -> Self {
        let asked = |hierarchy: &&hosts::ParentDirectory| {
            let limits = &spec.limits;
            let asked = |controller: &str| match controller {
                "blkio" => limits.io_read.or(limits.io_write).is_some(),
                "cpuset" => limits.cpuset.is_some(),
                _ => true,
            };
            hierarchy.unified || hierarchy.controllers.iter().any(|name| asked(name))
        };
        let leaves = parent.hierarchies.iter().filter(asked).map(|hierarchy| CgroupDirectory {
            controllers: hierarchy.controllers.clone(),
            directory: hierarchy.directory.join(&spec.id),
            unified: hierarchy.unified,
        });
        Self {
            version: parent.version,
            leaves: leaves.collect(),
            disk: spec.layers.first().and_then(|layer| disk::whole_disk(layer)),
        }
    }

    /// Returns the cgroup of a servant's shim, which need not exist yet.
    pub fn for_shim(parent: &CgroupParent, id: &str) -> Self {
        let limits = |hierarchy: &&hosts::ParentDirectory| {
            let limits = |name: &String| matches!(name.as_str(), "cpu" | "memory");
            parent.version == 2 || hierarchy.controllers.iter().any(limits)
        };
        // Ids contain no dots.
        let leaves = parent.hierarchies.iter().filter(limits).map(|hierarchy| {
            let wanted = ["cpu", "memory"].map(str::to_owned);
            CgroupDirectory {
                controllers: wanted.into_iter().filter(|name| hierarchy.controllers.contains(name)).collect(),
                directory: hierarchy.directory.join(format!("{id}.shim")),
                unified: hierarchy.unified,
            }
        });
        Self { version: parent.version, leaves: leaves.collect(), disk: None }
    }

    /// Creates the directories.
    pub fn create(&self) -> Result<(), Error> {
        for leaf in &self.leaves {
            make_directory(&leaf.directory).map_err(Error::file("make the cgroup", &leaf.directory))?;
            if !leaf.unified && leaf.has_controller("cpuset") {
                v1::inherit_cpuset(&leaf.directory)
                    .map_err(Error::file("hand cores and memory to", &leaf.directory))?;
            }
        }
        Ok(())
    }

    /// Moves a process into the cgroup.
    pub fn add_process(&self, pid: u32) -> Result<(), Error> {
        for leaf in &self.leaves {
            let file = leaf.directory.join("cgroup.procs");
            fs::write(&file, pid.to_string()).map_err(Error::file("move a process into", &file))?;
        }
        Ok(())
    }

    /// Moves this process, which must have one thread, into the cgroup.
    pub fn add_self(&self) -> Result<(), Error> {
        for leaf in &self.leaves {
            // A thread that moves itself need not wait for an RCU grace period of the kernel; v2 moves processes only.
            let name = if leaf.unified { "cgroup.procs" } else { "tasks" };
            let file = leaf.directory.join(name);
            fs::write(&file, "0").map_err(Error::file("move the shim into", &file))?;
        }
        Ok(())
    }

    /// Sets the limits that are given. A limit that cannot be set is no error here: the limits in force are read back.
    pub fn set_limits(&self, limits: &Limits) -> EnforcedLimits {
        if self.version == 2 {
            v2::set(self, limits)
        } else {
            v1::set(self, limits)
        }
        self.enforced_limits()
    }

    /// Reads the limits in force from the kernel.
    pub fn enforced_limits(&self) -> EnforcedLimits {
        let limits = if self.version == 2 { v2::limits(self) } else { v1::limits(self) };
        EnforcedLimits { cgroup_version: self.version, limits, shim: Limits::default() }
    }

    /// Reads the current usage.
    pub fn usage(&self) -> Usage {
        let counted = if self.version == 2 { v2::usage(self) } else { v1::usage(self) };
        let pids = self.control_file("pids", "pids.current").and_then(|file| read_number(&file)).unwrap_or(0);
        Usage { pids, oom_kills: self.oom_kills(), ..counted }
    }

    /// Returns the number of its processes killed by the kernel because of their memory.
    pub fn oom_kills(&self) -> u64 {
        let name = if self.version == 2 { "memory.events" } else { "memory.oom_control" };
        self.control_file("memory", name).and_then(|file| files::read_field(&file, "oom_kill")).unwrap_or(0)
    }

    /// Returns the host pids of all its processes, init included.
    pub fn processes(&self) -> Vec<i32> {
        self.leaves.first().map(|leaf| read_pids(&leaf.directory)).unwrap_or_default()
    }

    /// Kills all its processes, waits until they are gone, and removes it. Blocks for at most `patience`.
    pub fn destroy(&self, patience: Duration) -> Result<(), Error> {
        self.check_not_own()?;
        let deadline = Instant::now() + patience;
        let mut pause = Duration::from_micros(200);
        while self.leaves.iter().any(|leaf| leaf.directory.exists()) {
            self.kill();
            let refused = self.leaves.iter().filter_map(|leaf| remove(&leaf.directory).err()).next();
            let Some(error) = refused else { break };
            if Instant::now() > deadline {
                let left = self.leaves.iter().find(|leaf| leaf.directory.exists());
                let path = left.map(|leaf| leaf.directory.clone()).unwrap_or_default();
                return Err(Error::File { action: "remove the cgroup", path, source: error });
            }
            std::thread::sleep(pause);
            pause = (pause * 2).min(Duration::from_millis(20));
        }
        // On v2 the parent distributes the controllers; it is removed with the engine.
        if self.version == 1 {
            self.leaves.iter().for_each(|leaf| hosts::remove_if_unused(&leaf.directory));
        }
        Ok(())
    }

    /// Refuses a record that names one of our own cgroups: destroying that would kill the host's processes.
    fn check_not_own(&self) -> Result<(), Error> {
        let own = std::process::id() as i32;
        let wrong = self.leaves.iter().find(|leaf| {
            let processes = read_pids(&leaf.directory);
            processes.contains(&own) || processes.contains(&1)
        });
        wrong.map_or(Ok(()), |leaf| {
            let reason = "it holds this very process, or the host's first".into();
            Err(Error::Malformed { path: leaf.directory.clone(), reason })
        })
    }

    /// Iterates over its directories, one in each hierarchy in use.
    pub(crate) fn directories(&self) -> impl Iterator<Item = &Path> {
        self.leaves.iter().map(|leaf| leaf.directory.as_path())
    }

    /// Returns whether any of its directories exists.
    pub fn exists(&self) -> bool {
        self.leaves.iter().any(|leaf| leaf.directory.exists())
    }

    /// Kills all its current processes: at once if the kernel can, otherwise one after the other in a frozen group.
    fn kill(&self) {
        let at_once = self.leaves.iter().filter(|leaf| leaf.unified).any(|leaf| {
            let file = leaf.directory.join("cgroup.kill");
            file.exists() && fs::write(file, "1").is_ok()
        });
        if at_once {
            return;
        }
        let freezer = self.control_file("freezer", "freezer.state");
        // A group that cannot be frozen may fork faster than we kill; the caller repeats until it is empty.
        let switch = |state: &str| freezer.as_ref().map(|file| fs::write(file, state));
        switch("FROZEN");
        for leaf in &self.leaves {
            for pid in read_pids(&leaf.directory) {
                let _ = nix::sys::signal::kill(nix::unistd::Pid::from_raw(pid), nix::sys::signal::Signal::SIGKILL);
            }
        }
        switch("THAWED");
    }

    /// Returns the path of a control file if its controller is in use.
    fn control_file(&self, controller: &str, name: &str) -> Option<PathBuf> {
        self.leaves.iter().find(|leaf| leaf.has_controller(controller)).map(|leaf| leaf.directory.join(name))
    }
}

impl CgroupDirectory {
    fn has_controller(&self, controller: &str) -> bool {
        self.controllers.iter().any(|known| known == controller)
    }
}

/// Creates a directory and its parent, which the end of another servant may be removing at the same moment.
fn make_directory(directory: &Path) -> io::Result<()> {
    let mut attempts = 0;
    loop {
        match fs::create_dir_all(directory) {
            Err(error) if error.kind() == io::ErrorKind::NotFound && attempts < 50 => attempts += 1,
            result => return result,
        }
    }
}

fn remove(directory: &Path) -> io::Result<()> {
    match fs::remove_dir(directory) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        result => result,
    }
}
