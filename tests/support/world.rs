//! Resources shared by stories: a directory for homes, and one daemon whose services are pushed when the first story
//! needs them. Each robot has a servant of its own, so stories that only use services do not affect each other.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use anyhow::Context;
use nix::mount::{MntFlags, umount2};

use crate::daemon::{Daemon, DaemonSetup};
use crate::{claim, leftovers, story};

/// True once a service has been pushed; the lock is held during the push.
type Pushed = Arc<Mutex<bool>>;

static WORLD: OnceLock<World> = OnceLock::new();

/// Prefix of the directories of runs, in the directory for temporary files.
pub const PREFIX: &str = "cloudroid-stories-";

/// Shared resources of the stories in this process.
pub struct World {
    place: PathBuf,
    shared: Mutex<Option<Arc<Daemon>>>,
    services: Mutex<HashMap<&'static str, Pushed>>,
    /// Homes that are in use.
    homes: Mutex<HashSet<PathBuf>>,
}

/// A directory of a story. It exists until the story has ended, and is kept if that failed.
#[derive(Debug)]
pub struct Directory {
    path: PathBuf,
    of_story: bool,
}

impl Directory {
    fn new_in(parent: &Path, name: &str) -> anyhow::Result<Directory> {
        let prefix = format!("{name}-");
        let path = tempfile::Builder::new().prefix(&prefix).tempdir_in(parent)?.keep();
        let of_story = story::add_directory(&path);
        Ok(Directory { path, of_story })
    }

    /// Creates an empty directory: in the directory of this run, or among temporary files in programs that run no
    /// stories.
    pub fn new(name: &str) -> anyhow::Result<Directory> {
        match WORLD.get() {
            Some(world) => world.directory(name),
            None => Directory::new_in(&std::env::temp_dir(), &format!("cloudroid-{name}")),
        }
    }

    /// Returns its path.
    pub fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        if !self.of_story {
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// A service of the shared daemon.
#[derive(Debug, Clone, Copy)]
pub struct StoryService {
    /// Name of the service.
    pub name: &'static str,
    /// Package below `tests/packages` to push; `None` for `--apt`.
    pub package: Option<&'static str>,
    /// Further arguments of the push.
    pub arguments: &'static [&'static str],
}

impl StoryService {
    /// Pushes it.
    ///
    /// # Errors
    /// With the output of a failed push.
    pub fn push_to(self, daemon: &Daemon) -> anyhow::Result<()> {
        let deployer = daemon.deployer();
        let outcome = match self.package {
            Some(package) => deployer.push(package, self.arguments),
            None => deployer.run(&[&["push"], self.arguments].concat()),
        };
        outcome?.expect_success().map(drop)
    }
}

/// Debian's `people_detect`.
pub const PEOPLE: StoryService = StoryService {
    name: "opencv_apps",
    package: None,
    arguments: &["--apt", "opencv_apps", "--node", "people_detect", "--param", "debug_view=false"],
};

/// A package for ROS 2 with the same function.
pub const SEER: StoryService =
    StoryService { name: "seer_ros2", package: Some("seer_ros2"), arguments: &["--node", "people_detect"] };

/// Our package for ROS 2 with topics for viewers.
pub const SIGHTS_TWO: StoryService =
    StoryService { name: "sights_ros2", package: Some("sights_ros2"), arguments: &["--node", "sights"] };

/// Our C++ package, compiled when it is pushed.
pub const GREETER: StoryService = StoryService {
    name: "greeter_cpp",
    package: Some("greeter_cpp"),
    arguments: &["--node", "greeter", "--param", "word=hi"],
};

/// Our Python package.
pub const ADDER: StoryService =
    StoryService { name: "adder_py", package: Some("adder_py"), arguments: &["--node", "adder.py"] };

/// Our package that reports how its node was started.
pub const TELLER: StoryService =
    StoryService { name: "teller_py", package: Some("teller_py"), arguments: &["--node", "teller.py"] };

/// A package with everything that crosses the link between a robot and its servant.
pub const CROSSING: StoryService =
    StoryService { name: "crossing_py", package: Some("crossing_py"), arguments: &["--node", "crossing.py"] };

/// Version of the crossing package for ROS 2, with the message type of transforms, which the base lacks.
pub const CROSSING_TWO: StoryService = StoryService {
    name: "crossing_ros2",
    package: Some("crossing_ros2"),
    arguments: &["--name", "crossing_ros2", "--node", "crossing_ros2/crossing"],
};

/// Our Python package that needs a map.
pub const LOCALISER: StoryService =
    StoryService { name: "localiser_py", package: Some("localiser_py"), arguments: &["--node", "localiser.py"] };

/// Version of the localiser package for ROS 2.
pub const LOCALISER_TWO: StoryService =
    StoryService { name: "localiser_ros2", package: Some("localiser_ros2"), arguments: &["--node", "localiser"] };

/// A workspace for ROS 2 with interfaces of its own, and a node that uses them.
pub const HERALD: StoryService = StoryService {
    name: "herald",
    package: Some("herald_ros2"),
    arguments: &["--name", "herald", "--node", "herald/herald"],
};

/// Our package for ROS 2 that carries letters, and calls its robot while it is being called.
pub const COURIER: StoryService =
    StoryService { name: "courier_ros2", package: Some("courier_ros2"), arguments: &["--node", "courier"] };

/// Our C++ package that calls services of other nodes.
pub const CALLER: StoryService =
    StoryService { name: "caller_cpp", package: Some("caller_cpp"), arguments: &["--node", "caller"] };

/// Our hostile package.
pub const BURGLAR: StoryService =
    StoryService { name: "burglar_cpp", package: Some("burglar_cpp"), arguments: &["--node", "burglar"] };

/// A package with everything that the test suites of rosbridge clients expect.
pub const FIXTURE: StoryService = StoryService {
    name: "rosbridge_fixture",
    package: Some("rosbridge_fixture"),
    arguments: &["--name", "rosbridge_fixture", "--node", "rosbridge_fixture/fixture"],
};

/// Returns the shared resources of this run.
pub fn world() -> &'static World {
    WORLD.get_or_init(|| World::new().unwrap_or_else(|error| panic!("the stories have no place: {error:#}")))
}

impl World {
    fn new() -> anyhow::Result<World> {
        let place = tempfile::Builder::new().prefix(PREFIX).tempdir()?.keep();
        claim::claim(&place).with_context(|| place.display().to_string())?;
        Ok(World { place, shared: Mutex::new(None), services: Mutex::default(), homes: Mutex::default() })
    }

    /// Returns the directory of this run.
    pub fn place(&self) -> &Path {
        &self.place
    }

    /// Returns the path of a new home. A repeated story gets another one.
    pub fn home(&self, name: &str) -> PathBuf {
        let again = if story::is_repeated() { "-again" } else { "" };
        let home = self.place.join(format!("{name}{again}"));
        story::add_home(&home);
        home
    }

    /// Creates an empty directory, which is removed with its story.
    pub fn directory(&self, name: &str) -> anyhow::Result<Directory> {
        Directory::new_in(&self.place, name)
    }

    /// Returns the setup of a daemon with a home that no other story uses.
    pub fn setup(&self, name: &str) -> DaemonSetup {
        let home = self.home(name);
        let mut homes = self.homes.lock().unwrap_or_else(PoisonError::into_inner);
        assert!(homes.insert(home.clone()), "two stories have {name}");
        DaemonSetup::new(&home)
    }

    /// Returns the shared daemon, if it has been started.
    pub fn shared_daemon(&self) -> Option<Arc<Daemon>> {
        let shared = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
        shared.clone()
    }

    /// Returns the shared daemon, which is started on first use.
    pub fn ensure_shared(&self) -> anyhow::Result<Arc<Daemon>> {
        let mut shared = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(daemon) = &*shared {
            return Ok(daemon.clone());
        }
        // It belongs to the run, not to the story that happens to be first.
        let daemon = Arc::new(DaemonSetup::new(&self.place.join("shared")).start()?);
        *shared = Some(daemon.clone());
        Ok(daemon)
    }

    /// Returns the shared daemon with this service: the first story that needs it pushes it. After a failure the next
    /// one tries again.
    pub fn daemon_with(&self, service: StoryService) -> anyhow::Result<Arc<Daemon>> {
        let daemon = self.ensure_shared()?;
        let pushed =
            self.services.lock().unwrap_or_else(PoisonError::into_inner).entry(service.name).or_default().clone();
        let mut is_pushed = pushed.lock().unwrap_or_else(PoisonError::into_inner);
        if !*is_pushed {
            service.push_to(&daemon).with_context(|| format!("{} could not be pushed", service.name))?;
            *is_pushed = true;
        }
        drop(is_pushed);
        Ok(daemon)
    }
}

/// Ends the shared resources; returns leftovers.
pub fn end() -> Vec<String> {
    let Some(world) = WORLD.get() else {
        return Vec::new();
    };
    let daemon = world.shared.lock().unwrap_or_else(PoisonError::into_inner).take();
    let mut left = Vec::new();
    let mut servants = Vec::new();
    if let Some(daemon) = daemon {
        if let Ok(serde_json::Value::Array(list)) = daemon.deployer().run_json(&["servants"]) {
            servants.extend(list.iter().filter_map(|servant| Some(servant["id"].as_str()?.to_owned())));
        }
        match Arc::try_unwrap(daemon).map(Daemon::stop) {
            Ok(Ok(_)) => {}
            Ok(Err(error)) => left.push(format!("the shared daemon did not end: {error:#}")),
            Err(_) => left.push("the shared daemon is still in use".to_owned()),
        }
    }
    left.extend(leftovers::find_leftovers(&world.place));
    left.extend(leftovers::cgroups(&servants).into_iter().map(|path| format!("cgroup {}", path.display())));
    if left.is_empty() {
        // The run's disk, if there is one, disappears with its content.
        let _ = umount2(&world.place, MntFlags::MNT_DETACH);
        let _ = std::fs::remove_dir_all(&world.place);
    }
    left
}
