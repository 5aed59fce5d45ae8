//! What stories share: a place for homes, and one daemon with services that are pushed when the first story
//! needs them. A robot's servant is its own, so stories that only use services do not meet.

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock};

use tempfile::TempDir;

use crate::daemon::{Daemon, Setup};
use crate::leftovers;

/// Set once a push has come to its end.
type Pushed = Arc<OnceLock<Result<(), String>>>;

static WORLD: OnceLock<World> = OnceLock::new();

/// The stories' place on this machine.
pub struct World {
    place: TempDir,
    shared: Mutex<Option<Arc<Daemon>>>,
    services: Mutex<HashMap<&'static str, Pushed>>,
    /// Names of homes that were given.
    homes: Mutex<HashSet<String>>,
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
        assert!(
            nix::unistd::geteuid().is_root(),
            "the stories start servants, which needs root: sudo make test"
        );
        World {
            place: tempfile::Builder::new()
                .prefix("cloudroid-stories-")
                .tempdir()
                .expect("a temporary directory"),
            shared: Mutex::new(None),
            services: Mutex::default(),
            homes: Mutex::default(),
        }
    })
}

impl World {
    /// A new, empty home.
    pub fn home(&self, name: &str) -> PathBuf {
        self.place.path().join(name)
    }

    /// A new, empty directory, gone with its story.
    pub fn directory(&self, name: &str) -> anyhow::Result<TempDir> {
        Ok(tempfile::Builder::new()
            .prefix(&format!("{name}-"))
            .tempdir_in(self.place.path())?)
    }

    /// A daemon of one's own, in a home that no other story has.
    pub fn own(&self, name: &str) -> Setup {
        let mut homes = self
            .homes
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        assert!(homes.insert(name.to_owned()), "two stories have {name}");
        Setup::new(&self.home(name))
    }

    /// The daemon that most stories use.
    pub fn shared(&self) -> anyhow::Result<Arc<Daemon>> {
        let mut shared = self
            .shared
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(daemon) = &*shared {
            return Ok(daemon.clone());
        }
        let daemon = Arc::new(self.own("shared").start()?);
        *shared = Some(daemon.clone());
        Ok(daemon)
    }

    /// The shared daemon, once it has this service: pushed by the first story that asks.
    pub fn with(&self, service: Service) -> anyhow::Result<Arc<Daemon>> {
        let daemon = self.shared()?;
        let once = self
            .services
            .lock()
            .unwrap_or_else(std::sync::PoisonError::into_inner)
            .entry(service.name)
            .or_default()
            .clone();
        once.get_or_init(|| {
            let deployer = daemon.deployer();
            let pushed = match service.package {
                Some(package) => deployer.pushes(package, service.arguments),
                None => deployer.types(&[&["push"], service.arguments].concat()),
            };
            pushed
                .and_then(|outcome| outcome.succeeded())
                .map(|_| ())
                .map_err(|error| format!("{error:#}"))
        })
        .clone()
        .map_err(|error| anyhow::anyhow!("{} could not be pushed: {error}", service.name))?;
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
        .unwrap_or_else(std::sync::PoisonError::into_inner)
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
    left.extend(leftovers::of(world.place.path()));
    left.extend(
        leftovers::cgroups(&servants)
            .into_iter()
            .map(|path| format!("cgroup {}", path.display())),
    );
    if left.is_empty() {
        let _ = std::fs::remove_dir_all(world.place.path());
    }
    left
}
