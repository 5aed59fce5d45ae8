//! What stories share: a place for homes, and one daemon with services that are pushed when the first story
//! needs them. A robot's servant is its own, so stories that only use services do not meet.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use anyhow::Context;
use nix::mount::{MntFlags, umount2};

use crate::daemon::{Daemon, Setup};
use crate::{claim, leftovers, story};

/// True once a service is there; the lock is held while it is pushed.
type Pushed = Arc<Mutex<bool>>;

static WORLD: OnceLock<World> = OnceLock::new();

/// The names of runs' places begin with this, in the directory for temporary files.
pub const PREFIX: &str = "cloudroid-stories-";

/// The stories' place on this machine.
pub struct World {
    place: PathBuf,
    shared: Mutex<Option<Arc<Daemon>>>,
    services: Mutex<HashMap<&'static str, Pushed>>,
    /// Homes that were given.
    homes: Mutex<HashSet<PathBuf>>,
}

/// A directory of a story. It is there until the story has ended, and kept where that failed.
#[derive(Debug)]
pub struct Directory {
    path: PathBuf,
    of_story: bool,
}

impl Directory {
    fn new_in(parent: &Path, name: &str) -> anyhow::Result<Directory> {
        let prefix = format!("{name}-");
        let path = tempfile::Builder::new()
            .prefix(&prefix)
            .tempdir_in(parent)?
            .keep();
        let of_story = story::add_directory(&path);
        Ok(Directory { path, of_story })
    }

    /// A new, empty directory: in this run's place, or, in programs that tell no stories, among temporary files.
    pub fn new(name: &str) -> anyhow::Result<Directory> {
        match WORLD.get() {
            Some(world) => world.directory(name),
            None => Directory::new_in(&std::env::temp_dir(), &format!("cloudroid-{name}")),
        }
    }

    /// Where it is.
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
pub struct Service {
    /// Its name.
    pub name: &'static str,
    /// What is pushed: a package below `tests/packages`, or none for `--apt`.
    pub package: Option<&'static str>,
    /// More arguments of the push.
    pub arguments: &'static [&'static str],
}

impl Service {
    /// Pushes it.
    ///
    /// # Errors
    /// With what the push said.
    pub fn push_to(self, daemon: &Daemon) -> anyhow::Result<()> {
        let deployer = daemon.deployer();
        let outcome = match self.package {
            Some(package) => deployer.pushes(package, self.arguments),
            None => deployer.types(&[&["push"], self.arguments].concat()),
        };
        outcome?.succeeded().map(drop)
    }
}

/// Debian's `people_detect`.
pub const PEOPLE: Service = Service {
    name: "opencv_apps",
    package: None,
    arguments: &[
        "--apt",
        "opencv_apps",
        "--node",
        "people_detect",
        "--param",
        "debug_view=false",
    ],
};

/// What does the same in ROS 2.
pub const SEER: Service = Service {
    name: "seer_ros2",
    package: Some("seer_ros2"),
    arguments: &["--node", "people_detect"],
};

/// Our package of ROS 2 with what people look at.
pub const SIGHTS_TWO: Service = Service {
    name: "sights_ros2",
    package: Some("sights_ros2"),
    arguments: &["--node", "sights"],
};

/// Our C++ package, compiled at push.
pub const GREETER: Service = Service {
    name: "greeter_cpp",
    package: Some("greeter_cpp"),
    arguments: &["--node", "greeter", "--param", "word=hi"],
};

/// Our Python package.
pub const ADDER: Service = Service {
    name: "adder_py",
    package: Some("adder_py"),
    arguments: &["--node", "adder.py"],
};

/// Our package that tells how its node was started.
pub const TELLER: Service = Service {
    name: "teller_py",
    package: Some("teller_py"),
    arguments: &["--node", "teller.py"],
};

/// What has to cross between a robot and its servant.
pub const CROSSING: Service = Service {
    name: "crossing_py",
    package: Some("crossing_py"),
    arguments: &["--node", "crossing.py"],
};

/// The same for ROS 2, with the message of transforms, which the base has not.
pub const CROSSING_TWO: Service = Service {
    name: "crossing_ros2",
    package: Some("crossing_ros2"),
    arguments: &[
        "--name",
        "crossing_ros2",
        "--node",
        "crossing_ros2/crossing",
    ],
};

/// Our Python package that needs a map.
pub const LOCALISER: Service = Service {
    name: "localiser_py",
    package: Some("localiser_py"),
    arguments: &["--node", "localiser.py"],
};

/// The same for ROS 2.
pub const LOCALISER_TWO: Service = Service {
    name: "localiser_ros2",
    package: Some("localiser_ros2"),
    arguments: &["--node", "localiser"],
};

/// A workspace of ROS 2 with interfaces of its own, and a node that uses them.
pub const HERALD: Service = Service {
    name: "herald",
    package: Some("herald_ros2"),
    arguments: &["--name", "herald", "--node", "herald/herald"],
};

/// Our package of ROS 2 that carries letters, and calls its robot while it is called.
pub const COURIER: Service = Service {
    name: "courier_ros2",
    package: Some("courier_ros2"),
    arguments: &["--node", "courier"],
};

/// Our C++ package that calls services of others.
pub const CALLER: Service = Service {
    name: "caller_cpp",
    package: Some("caller_cpp"),
    arguments: &["--node", "caller"],
};

/// Our hostile package.
pub const BURGLAR: Service = Service {
    name: "burglar_cpp",
    package: Some("burglar_cpp"),
    arguments: &["--node", "burglar"],
};

/// What the suites of rosbridge's clients expect.
pub const FIXTURE: Service = Service {
    name: "rosbridge_fixture",
    package: Some("rosbridge_fixture"),
    arguments: &[
        "--name",
        "rosbridge_fixture",
        "--node",
        "rosbridge_fixture/fixture",
    ],
};

/// The world of this run.
pub fn world() -> &'static World {
    WORLD.get_or_init(|| {
        World::new().unwrap_or_else(|error| panic!("the stories have no place: {error:#}"))
    })
}

impl World {
    fn new() -> anyhow::Result<World> {
        let place = tempfile::Builder::new().prefix(PREFIX).tempdir()?.keep();
        claim::claim(&place).with_context(|| place.display().to_string())?;
        Ok(World {
            place,
            shared: Mutex::new(None),
            services: Mutex::default(),
            homes: Mutex::default(),
        })
    }

    /// The directory that everything of this run is in.
    pub fn place(&self) -> &Path {
        &self.place
    }

    /// A new, empty home. A story that is told again has another one.
    pub fn home(&self, name: &str) -> PathBuf {
        let again = if story::is_told_again() { "-again" } else { "" };
        let home = self.place.join(format!("{name}{again}"));
        story::add_home(&home);
        home
    }

    /// A new, empty directory, gone with its story.
    pub fn directory(&self, name: &str) -> anyhow::Result<Directory> {
        Directory::new_in(&self.place, name)
    }

    /// A daemon of one's own, in a home that no other story has.
    pub fn own(&self, name: &str) -> Setup {
        let home = self.home(name);
        let mut homes = self.homes.lock().unwrap_or_else(PoisonError::into_inner);
        assert!(homes.insert(home.clone()), "two stories have {name}");
        Setup::new(&home)
    }

    /// The daemon that most stories use, if there is one yet.
    pub fn shared_daemon(&self) -> Option<Arc<Daemon>> {
        let shared = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
        shared.clone()
    }

    /// The daemon that most stories use.
    pub fn shared(&self) -> anyhow::Result<Arc<Daemon>> {
        let mut shared = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(daemon) = &*shared {
            return Ok(daemon.clone());
        }
        // Of the run, not of the story that happens to be first.
        let daemon = Arc::new(Setup::new(&self.place.join("shared")).start()?);
        *shared = Some(daemon.clone());
        Ok(daemon)
    }

    /// The shared daemon, once it has this service: pushed by the first story that asks. Where that fails, the next one tries again.
    pub fn with(&self, service: Service) -> anyhow::Result<Arc<Daemon>> {
        let daemon = self.shared()?;
        let pushed = self
            .services
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .entry(service.name)
            .or_default()
            .clone();
        let mut is_pushed = pushed.lock().unwrap_or_else(PoisonError::into_inner);
        if !*is_pushed {
            service
                .push_to(&daemon)
                .with_context(|| format!("{} could not be pushed", service.name))?;
            *is_pushed = true;
        }
        drop(is_pushed);
        Ok(daemon)
    }
}

/// Ends what is shared and tells what stayed behind.
pub fn end() -> Vec<String> {
    let Some(world) = WORLD.get() else {
        return Vec::new();
    };
    let daemon = world
        .shared
        .lock()
        .unwrap_or_else(PoisonError::into_inner)
        .take();
    let mut left = Vec::new();
    let mut servants = Vec::new();
    if let Some(daemon) = daemon {
        if let Ok(serde_json::Value::Array(list)) = daemon.deployer().asks(&["servants"]) {
            servants.extend(
                list.iter()
                    .filter_map(|servant| Some(servant["id"].as_str()?.to_owned())),
            );
        }
        match Arc::try_unwrap(daemon).map(Daemon::ends) {
            Ok(Ok(_)) => {}
            Ok(Err(error)) => left.push(format!("the shared daemon did not end: {error:#}")),
            Err(_) => left.push("the shared daemon is still in use".to_owned()),
        }
    }
    left.extend(leftovers::of(&world.place));
    left.extend(
        leftovers::cgroups(&servants)
            .into_iter()
            .map(|path| format!("cgroup {}", path.display())),
    );
    if left.is_empty() {
        // The run's disk, where it has one: what is on it goes with it.
        let _ = umount2(&world.place, MntFlags::MNT_DETACH);
        let _ = std::fs::remove_dir_all(&world.place);
    }
    left
}
