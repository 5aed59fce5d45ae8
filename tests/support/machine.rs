//! File system of a robot: Debian with ROS, created once for all stories by mmdebstrap. Each machine writes to an
//! overlay of its own, and runs commands in a mount namespace that ends with them.

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, ensure};
use nix::fcntl::{Flock, FlockArg};
use ros::bus::RosVersion;

use crate::binaries;
use crate::daemon::Daemon;
use crate::deployer::{CommandOutcome, path_str, run};
use crate::patience::patience;
use crate::world::{Directory, world};

/// Debian packages of a robot: tools that find and start nodes, three shells, a package with its original nodes, and
/// tools for networks with name resolution.
const PACKAGES: [&str; 18] = [
    "python3-roslaunch",
    "python3-rosmaster",
    "rosbash",
    "rospack-tools",
    "rosout",
    "catkin",
    "zsh",
    "python3-rostopic",
    "python3-rosnode",
    "python3-rosservice",
    "python3-rosparam",
    "ros-std-msgs",
    "libnodeletlib-tools",
    "ros-opencv-apps",
    "procps",
    "iproute2",
    "dnsmasq-base",
    "avahi-daemon",
];
/// Package with the launch files and package.xml; it is unpacked without its dependencies, which are of no use here.
const UNPACKED_PACKAGE: &str = "libopencv-apps-dev";
const SUITE: &str = "bookworm";

/// A robot's computer.
pub struct Machine {
    base: PathBuf,
    own: Directory,
}

impl Machine {
    /// Creates a machine with ROS below `/usr` and `opencv_apps` installed.
    pub fn new() -> anyhow::Result<Machine> {
        let own = world().directory("machine")?;
        for name in ["upper", "work", "root"] {
            std::fs::create_dir(own.path().join(name))?;
        }
        Ok(Machine { base: base()?, own })
    }

    /// Creates a machine with a stub of `service` unpacked in `/root`, fetched as a robot of ROS 1 would fetch it.
    pub fn with_stub(daemon: &Daemon, service: &str) -> anyhow::Result<Machine> {
        Self::with_stub_for(daemon, service, RosVersion::One)
    }

    /// Creates a machine with a stub of `service` for robots of this version, as [`Machine::with_stub`] does.
    pub fn with_stub_for(daemon: &Daemon, service: &str, ros: RosVersion) -> anyhow::Result<Machine> {
        let machine = Machine::new()?;
        let place = world().directory("stub")?;
        let (address, directory) = (format!("http://{}", daemon.address), path_str(place.path()));
        let number = ros.number().to_string();
        let words = ["--server", &address, "stub", service, "--ros", &number, "-o", directory];
        daemon.deployer().run(&words)?.expect_success()?;
        machine.unpack(&place.path().join(format!("{service}.tar.gz")))?;
        Ok(machine)
    }

    /// Returns the host path of a file that was written in it.
    pub fn host_path(&self, path: &str) -> PathBuf {
        self.own.path().join("upper").join(path.trim_start_matches('/'))
    }

    /// Copies a file of this host to an absolute path in the machine, with this mode.
    pub fn install_file(&self, file: &Path, to: &str, mode: u32) -> anyhow::Result<()> {
        let to = self.host_path(to);
        std::fs::create_dir_all(to.parent().context("a directory")?)?;
        std::fs::copy(file, &to)?;
        Ok(std::fs::set_permissions(to, std::fs::Permissions::from_mode(mode))?)
    }

    /// Writes a file in the machine.
    pub fn write_file(&self, to: &str, text: &str) -> anyhow::Result<()> {
        let to = self.host_path(to);
        std::fs::create_dir_all(to.parent().context("a directory")?)?;
        Ok(std::fs::write(to, text)?)
    }

    /// Installs the original of `teller_py` below `/usr`.
    pub fn install_teller(&self) -> anyhow::Result<()> {
        let package = binaries::package("teller_py");
        for (file, to, mode) in [
            ("scripts/teller.py", "/usr/lib/teller_py/teller.py", 0o755),
            ("package.xml", "/usr/share/teller_py/package.xml", 0o644),
        ] {
            self.install_file(&package.join(file), to, mode)?;
        }
        Ok(())
    }

    /// Unpacks the archive of a stub in `/root`.
    pub fn unpack(&self, archive: &Path) -> anyhow::Result<()> {
        let bytes = std::fs::read(archive)?;
        let home = self.own.path().join("upper/root");
        std::fs::create_dir_all(&home)?;
        tar::Archive::new(flate2::read::GzDecoder::new(&bytes[..])).unpack(home)?;
        Ok(())
    }

    /// Runs a script in a shell (`sh`, `bash` or `zsh`), as root in its home directory. `$PATIENCE` is the number of
    /// seconds to wait for anything.
    pub fn run_script(&self, shell: &str, script: &str) -> anyhow::Result<CommandOutcome> {
        let own = self.own.path();
        run(Command::new("unshare")
            .args(["--mount", "--propagation", "private", "sh", "-euc", INSIDE])
            .arg("inside")
            .args([shell, script])
            .env("BASE", &self.base)
            .env("OWN", own)
            .env("PATIENCE", patience().as_secs().to_string()))
    }
}

/// Returns a port that is currently unused, for a Master of a script.
pub fn free_port() -> anyhow::Result<u16> {
    let listener = std::net::TcpListener::bind(("127.0.0.1", 0))?;
    Ok(listener.local_addr()?.port())
}

/// Shell script that runs the command in a pid namespace, so that all its processes end with it.
const INSIDE: &str = r#"
mount -t overlay overlay -o "lowerdir=$BASE,upperdir=$OWN/upper,workdir=$OWN/work" "$OWN/root"
mount --bind /dev "$OWN/root/dev"
printf '127.0.0.1 localhost %s\n' "$(hostname)" > "$OWN/root/etc/hosts"
cd "$OWN/root"
exec unshare --pid --fork --kill-child sh -euc '
  mount -t proc proc proc
  exec chroot . /usr/bin/env -i PATH=/usr/bin:/bin HOME=/root TERM=dumb SHELL="/bin/$1" PATIENCE="$PATIENCE" \
    sh -c "cd; exec \"\$@\"" sh "$1" -c "$2"' inside "$@"
"#;

/// Returns the shared file system, named after a hash of its contents' description; it is created if missing.
pub fn base() -> anyhow::Result<PathBuf> {
    let cache = std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .or_else(|| Some(PathBuf::from(std::env::var_os("HOME")?).join(".cache")))
        .context("HOME says where caches are")?
        .join("cloudroid/robots");
    let mut hash = std::hash::DefaultHasher::new();
    std::hash::Hash::hash(&(PACKAGES, UNPACKED_PACKAGE, SUITE), &mut hash);
    let name = format!("{SUITE}-{:016x}", std::hash::Hasher::finish(&hash));
    let base = cache.join(&name);
    std::fs::create_dir_all(&cache)?;
    let lock = std::fs::File::create(cache.join(format!("{name}.lock")))?;
    let _lock = Flock::lock(lock, FlockArg::LockExclusive).map_err(|(_, error)| error)?;
    if base.exists() {
        return Ok(base);
    }
    let half = cache.join(format!("{name}.half"));
    if half.exists() {
        std::fs::remove_dir_all(&half)?;
    }
    let unpack = format!(
        "chroot \"$1\" sh -c 'cd /tmp && apt-get download -qq {UNPACKED_PACKAGE} && dpkg -x {UNPACKED_PACKAGE}_*.deb / \
         && rm {UNPACKED_PACKAGE}_*.deb'"
    );
    // Mounts of mmdebstrap are invisible to others, and disappear when it is killed.
    let made = run(Command::new("unshare")
        .args(["--mount", "--propagation", "private", "--pid", "--fork", "--kill-child", "--mount-proc", "mmdebstrap"])
        .args(["--quiet", "--mode=root", "--variant=minbase"])
        .arg(format!("--include={}", PACKAGES.join(",")))
        .arg("--aptopt=APT::Install-Recommends \"false\"")
        .arg("--aptopt=APT::Sandbox::User \"root\"")
        .arg(format!("--customize-hook={unpack}"))
        .arg(SUITE)
        .arg(&half))?;
    ensure!(made.status == 0, "{}", made.output());
    std::fs::rename(&half, &base)?;
    Ok(base)
}
