//! Limits, usage and the certain end of a servant, by control groups of whichever version the host offers.
//!
//! ```text
//!  v2   PARENT/                  delegated to us, holds no process itself
//!         ID/                    one servant: its init and its nodes
//!         ID.shim/               its shim
//!  v1   OWN/cloudroid/ID/        in each hierarchy that we use, below the cgroup we are in ourselves there
//!       OWN/cloudroid/ID.shim/   in those of processor time and memory
//! ```
//! A servant drives its shim (it asks the ROS Master there, and prints), so the shim has limits, too. They are not the
//! servant's own: the shim must be able to say that a servant ran out of memory.
//!
//! On a hybrid host the controllers are on v1, and the empty v2 hierarchy beside them is still of use: it has
//! `cgroup.kill`, and counts processor time.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::Error;
use crate::container::ContainerSpec;
use crate::engine::{Enforced, Usage};
use crate::spec::Limits;

mod cores;
mod disk;
mod files;
mod hosts;
mod v1;
mod v2;

use files::{read_number, read_pids};
pub use hosts::Parent;
pub use v1::counts_sockets;

/// The directories of one servant.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cgroup {
    /// 1 or 2; 0 where there is none.
    pub version: u8,
    /// One for each hierarchy in use.
    leaves: Vec<Leaf>,
    /// `MAJOR:MINOR` of the disk that input and output are limited on.
    #[serde(default)]
    disk: Option<String>,
}

/// A directory in one hierarchy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Leaf {
    /// Controllers that can be used here.
    controllers: Vec<String>,
    directory: PathBuf,
    /// Whether this hierarchy is of the v2 kind.
    unified: bool,
}

impl Cgroup {
    /// Where the cgroup of a servant is, or would be.
    pub fn planned(parent: &Parent, spec: &ContainerSpec) -> Self {
        let asked = |hierarchy: &&hosts::Below| {
            let limits = &spec.limits;
            let asked = |controller: &str| match controller {
                "blkio" => limits.io_read.or(limits.io_write).is_some(),
                "cpuset" => limits.cpuset.is_some(),
                _ => true,
            };
            hierarchy.unified || hierarchy.controllers.iter().any(|name| asked(name))
        };
        let leaves = parent
            .hierarchies
            .iter()
            .filter(asked)
            .map(|hierarchy| Leaf {
                controllers: hierarchy.controllers.clone(),
                directory: hierarchy.directory.join(&spec.id),
                unified: hierarchy.unified,
            });
        Self {
            version: parent.version,
            leaves: leaves.collect(),
            disk: spec.layers.first().and_then(|layer| disk::of(layer)),
        }
    }

    /// Where the cgroup of a servant's shim is, or would be.
    pub fn of_shim(parent: &Parent, id: &str) -> Self {
        let limits = |hierarchy: &&hosts::Below| {
            let limits = |name: &String| matches!(name.as_str(), "cpu" | "memory");
            parent.version == 2 || hierarchy.controllers.iter().any(limits)
        };
        // No id has a dot in it.
        let leaves = parent.hierarchies.iter().filter(limits).map(|hierarchy| {
            let wanted = ["cpu", "memory"].map(str::to_owned);
            Leaf {
                controllers: wanted
                    .into_iter()
                    .filter(|name| hierarchy.controllers.contains(name))
                    .collect(),
                directory: hierarchy.directory.join(format!("{id}.shim")),
                unified: hierarchy.unified,
            }
        });
        Self {
            version: parent.version,
            leaves: leaves.collect(),
            disk: None,
        }
    }

    /// Makes its directories.
    pub fn create(&self) -> Result<(), Error> {
        for leaf in &self.leaves {
            make_directory(&leaf.directory)
                .map_err(Error::file("make the cgroup", &leaf.directory))?;
            if !leaf.unified && leaf.has("cpuset") {
                v1::hand_down_cores(&leaf.directory)
                    .map_err(Error::file("hand cores and memory to", &leaf.directory))?;
            }
        }
        Ok(())
    }

    /// Moves a process into it.
    pub fn enter(&self, pid: u32) -> Result<(), Error> {
        for leaf in &self.leaves {
            let file = leaf.directory.join("cgroup.procs");
            fs::write(&file, pid.to_string()).map_err(Error::file("move a process into", &file))?;
        }
        Ok(())
    }

    /// Moves this process into it, which must have one thread.
    pub fn enter_alone(&self) -> Result<(), Error> {
        for leaf in &self.leaves {
            // A thread that moves itself need not wait for a grace period of the kernel; v2 moves processes only.
            let name = if leaf.unified {
                "cgroup.procs"
            } else {
                "tasks"
            };
            let file = leaf.directory.join(name);
            fs::write(&file, "0").map_err(Error::file("move the shim into", &file))?;
        }
        Ok(())
    }

    /// Sets the limits that are given. A limit that cannot be set is not an error here: what is in force is read back.
    pub fn set(&self, limits: &Limits) -> Enforced {
        if self.version == 2 {
            v2::set(self, limits)
        } else {
            v1::set(self, limits)
        }
        self.enforced()
    }

    /// The limits in force, as the kernel has them.
    pub fn enforced(&self) -> Enforced {
        let limits = if self.version == 2 {
            v2::limits(self)
        } else {
            v1::limits(self)
        };
        Enforced {
            cgroup_version: self.version,
            limits,
            shim: Limits::default(),
        }
    }

    /// What is used now.
    pub fn usage(&self) -> Usage {
        let counted = if self.version == 2 {
            v2::usage(self)
        } else {
            v1::usage(self)
        };
        let pids = self
            .file("pids", "pids.current")
            .and_then(|file| read_number(&file))
            .unwrap_or(0);
        Usage {
            pids,
            oom_kills: self.oom_kills(),
            ..counted
        }
    }

    /// How many of its processes the kernel has killed for want of memory.
    pub fn oom_kills(&self) -> u64 {
        let name = if self.version == 2 {
            "memory.events"
        } else {
            "memory.oom_control"
        };
        self.file("memory", name)
            .and_then(|file| files::read_field(&file, "oom_kill"))
            .unwrap_or(0)
    }

    /// Host pids of all its processes, init included.
    pub fn processes(&self) -> Vec<i32> {
        self.leaves
            .first()
            .map(|leaf| read_pids(&leaf.directory))
            .unwrap_or_default()
    }

    /// Kills every process in it, waits until there is none, and removes it. Blocks, at most for `patience`.
    pub fn destroy(&self, patience: Duration) -> Result<(), Error> {
        self.refuse_to_end_ourselves()?;
        let deadline = Instant::now() + patience;
        let mut pause = Duration::from_micros(200);
        while self.leaves.iter().any(|leaf| leaf.directory.exists()) {
            self.kill();
            let refused = self
                .leaves
                .iter()
                .filter_map(|leaf| remove(&leaf.directory).err())
                .next();
            let Some(error) = refused else { break };
            if Instant::now() > deadline {
                let left = self.leaves.iter().find(|leaf| leaf.directory.exists());
                let path = left.map(|leaf| leaf.directory.clone()).unwrap_or_default();
                return Err(Error::File {
                    action: "remove the cgroup",
                    path,
                    source: error,
                });
            }
            std::thread::sleep(pause);
            pause = (pause * 2).min(Duration::from_millis(20));
        }
        // On v2 the parent hands controllers down; it goes with the engine.
        if self.version == 1 {
            self.leaves
                .iter()
                .for_each(|leaf| hosts::remove_if_unused(&leaf.directory));
        }
        Ok(())
    }

    /// A record that names a directory which we are in ourselves is wrong, and following it would end the host's processes.
    fn refuse_to_end_ourselves(&self) -> Result<(), Error> {
        let own = std::process::id() as i32;
        let wrong = self.leaves.iter().find(|leaf| {
            let processes = read_pids(&leaf.directory);
            processes.contains(&own) || processes.contains(&1)
        });
        wrong.map_or(Ok(()), |leaf| {
            let reason = "it holds this very process, or the host's first".into();
            Err(Error::Malformed {
                path: leaf.directory.clone(),
                reason,
            })
        })
    }

    /// Its directories, one in each hierarchy in use.
    pub(crate) fn directories(&self) -> impl Iterator<Item = &Path> {
        self.leaves.iter().map(|leaf| leaf.directory.as_path())
    }

    /// Whether any of its directories is there.
    pub fn exists(&self) -> bool {
        self.leaves.iter().any(|leaf| leaf.directory.exists())
    }

    /// Kills every process now in it: at once where the kernel can, one after the other in a frozen group elsewhere.
    fn kill(&self) {
        let at_once = self.leaves.iter().filter(|leaf| leaf.unified).any(|leaf| {
            let file = leaf.directory.join("cgroup.kill");
            file.exists() && fs::write(file, "1").is_ok()
        });
        if at_once {
            return;
        }
        let freezer = self.file("freezer", "freezer.state");
        // A group that cannot be frozen may fork faster than we kill; the caller repeats until it is empty.
        let switch = |state: &str| freezer.as_ref().map(|file| fs::write(file, state));
        switch("FROZEN");
        for leaf in &self.leaves {
            for pid in read_pids(&leaf.directory) {
                let _ = nix::sys::signal::kill(
                    nix::unistd::Pid::from_raw(pid),
                    nix::sys::signal::Signal::SIGKILL,
                );
            }
        }
        switch("THAWED");
    }

    /// A control file, when its controller is in use.
    fn file(&self, controller: &str, name: &str) -> Option<PathBuf> {
        self.leaves
            .iter()
            .find(|leaf| leaf.has(controller))
            .map(|leaf| leaf.directory.join(name))
    }
}

impl Leaf {
    fn has(&self, controller: &str) -> bool {
        self.controllers.iter().any(|known| known == controller)
    }
}

/// Makes a directory and its parent, which another servant's end may be removing at the same moment.
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
