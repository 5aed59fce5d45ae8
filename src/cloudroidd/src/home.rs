//! The state directory: where everything of one daemon is, and the lock that makes it one.
//!
//! ```text
//! lock  cloudroid.db  images/  layers/  run/daemon.sock  servants/<id>/  build/<push>/
//! ```

use std::fs::{DirBuilder, File, OpenOptions, Permissions};
use std::io::{Read, Seek, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};

use nix::fcntl::{Flock, FlockArg};
use tokio::net::UnixListener;

/// Why a directory cannot be the home.
#[derive(Debug, thiserror::Error)]
pub enum HomeError {
    /// Another daemon has it.
    #[error(
        "another cloudroidd{pid} already uses {home}; end it first (kill{pid_bare}), or choose another directory with --home"
    )]
    Taken {
        /// The directory.
        home: PathBuf,
        /// ` (pid N)`, where known.
        pid: String,
        /// ` N`, where known.
        pid_bare: String,
    },
    /// No default directory can be named.
    #[error(
        "neither CLOUDROID_HOME nor XDG_DATA_HOME nor HOME is set; name a state directory with --home"
    )]
    Nowhere,
    /// The file system refused.
    #[error("cannot {action} {path}: {source}")]
    Io {
        /// What was being done.
        action: &'static str,
        /// Where.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
}

/// A home that this process has locked. The lock falls with the process, however it ends.
#[derive(Debug)]
pub struct Home {
    path: PathBuf,
    _lock: Flock<File>,
}

/// Where the state is by default: `$CLOUDROID_HOME`, else `cloudroid` below the user's data directory.
pub fn default_path(
    variable: impl Fn(&str) -> Option<std::ffi::OsString>,
) -> Result<PathBuf, HomeError> {
    let set = |name| {
        variable(name)
            .filter(|value| !value.is_empty())
            .map(PathBuf::from)
    };
    set("CLOUDROID_HOME")
        .or_else(|| set("XDG_DATA_HOME").map(|data| data.join("cloudroid")))
        .or_else(|| set("HOME").map(|user| user.join(".local/share/cloudroid")))
        .ok_or(HomeError::Nowhere)
}

impl Home {
    /// Makes what is missing of the directory and locks it.
    pub fn open(path: &Path) -> Result<Home, HomeError> {
        let path = std::path::absolute(path).map_err(io("resolve", path))?;
        // Servants run as unprivileged users: they pass through to their layers, and read nothing else.
        make_directory(&path, 0o711)?;
        let lock = lock(&path)?;
        let home = Home { path, _lock: lock };
        for (name, mode) in [
            ("images", 0o755),
            ("layers", 0o711),
            ("run", 0o711),
            ("servants", 0o711),
            ("build", 0o711),
        ] {
            make_directory(&home.path.join(name), mode)?;
        }
        Ok(home)
    }

    /// The directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The OCI layout.
    pub fn images(&self) -> PathBuf {
        self.path.join("images")
    }

    /// Extracted layers.
    pub fn layers(&self) -> PathBuf {
        self.path.join("layers")
    }

    /// The database.
    pub fn database(&self) -> PathBuf {
        self.path.join("cloudroid.db")
    }

    /// Listens on the command line's socket, for root and this user alone.
    pub fn listen(&self) -> Result<UnixListener, HomeError> {
        let path = self.socket();
        // Nobody else can be listening: the home is locked.
        let _ = std::fs::remove_file(&path);
        let directory = self.path.join("run");
        let opened = File::open(&directory).map_err(io("open", &directory))?;
        // Through a descriptor of its directory, because the path itself may be longer than an address can be.
        let address = format!("/proc/self/fd/{}/daemon.sock", opened.as_raw_fd());
        let listener = UnixListener::bind(address).map_err(io("listen on", &path))?;
        std::fs::set_permissions(&path, Permissions::from_mode(0o600))
            .map_err(io("protect", &path))?;
        Ok(listener)
    }

    /// The command line's socket.
    pub fn socket(&self) -> PathBuf {
        self.path.join("run/daemon.sock")
    }

    /// Removes what an earlier daemon's builds left half-made, once their containers have ended. What cannot be
    /// removed is told and is no reason not to start.
    pub fn sweep_builds(&self) {
        let entries = std::fs::read_dir(self.path.join("build"));
        for half_made in entries
            .into_iter()
            .flatten()
            .flatten()
            .map(|entry| entry.path())
        {
            match std::fs::remove_dir_all(&half_made) {
                Ok(()) => tracing::info!("swept the half-made build {}", half_made.display()),
                Err(error) => tracing::error!("cannot sweep {}: {error}", half_made.display()),
            }
        }
    }
}

fn make_directory(path: &Path, mode: u32) -> Result<(), HomeError> {
    DirBuilder::new()
        .recursive(true)
        .mode(mode)
        .create(path)
        .map_err(io("create the directory", path))
}

fn lock(home: &Path) -> Result<Flock<File>, HomeError> {
    let path = home.join("lock");
    let file = OpenOptions::new()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .open(&path)
        .map_err(io("open", &path))?;
    match Flock::lock(file, FlockArg::LockExclusiveNonblock) {
        Ok(mut locked) => {
            locked.set_len(0).map_err(io("write", &path))?;
            locked.rewind().map_err(io("write", &path))?;
            writeln!(locked, "{}", std::process::id()).map_err(io("write", &path))?;
            Ok(locked)
        }
        Err((mut file, nix::errno::Errno::EWOULDBLOCK)) => {
            let mut holder = String::new();
            let _ = file.read_to_string(&mut holder);
            let known = holder.trim().parse::<u32>().ok();
            Err(HomeError::Taken {
                home: home.to_owned(),
                pid: known.map(|pid| format!(" (pid {pid})")).unwrap_or_default(),
                pid_bare: known.map(|pid| format!(" {pid}")).unwrap_or_default(),
            })
        }
        Err((_, errno)) => Err(HomeError::Io {
            action: "lock",
            path,
            source: errno.into(),
        }),
    }
}

fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> HomeError {
    let path = path.to_owned();
    move |source| HomeError::Io {
        action,
        path,
        source,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variables(
        set: &'static [(&'static str, &'static str)],
    ) -> impl Fn(&str) -> Option<std::ffi::OsString> {
        move |name| {
            set.iter()
                .find(|(known, _)| *known == name)
                .map(|(_, value)| (*value).into())
        }
    }

    #[test]
    fn the_default_is_below_the_users_data() {
        let all = variables(&[
            ("CLOUDROID_HOME", "/c"),
            ("XDG_DATA_HOME", "/x"),
            ("HOME", "/h"),
        ]);
        assert_eq!(default_path(all).expect("set"), Path::new("/c"));
        let xdg = variables(&[
            ("CLOUDROID_HOME", ""),
            ("XDG_DATA_HOME", "/x"),
            ("HOME", "/h"),
        ]);
        assert_eq!(default_path(xdg).expect("set"), Path::new("/x/cloudroid"));
        let home = variables(&[("HOME", "/h")]);
        assert_eq!(
            default_path(home).expect("set"),
            Path::new("/h/.local/share/cloudroid")
        );
        assert!(matches!(
            default_path(variables(&[])),
            Err(HomeError::Nowhere)
        ));
    }

    #[test]
    fn a_second_daemon_is_told_the_firsts_pid() {
        let parent = tempfile::tempdir().expect("a directory");
        let first = Home::open(&parent.path().join("home")).expect("free");
        let refused = Home::open(first.path()).expect_err("taken").to_string();
        assert!(
            refused.contains(&format!("(pid {})", std::process::id())),
            "{refused}"
        );
        assert!(refused.contains("--home"), "{refused}");
        let path = first.path().to_owned();
        drop(first);
        Home::open(&path).expect("free again");
    }

    #[test]
    fn half_made_builds_are_swept() {
        let parent = tempfile::tempdir().expect("a directory");
        let home = Home::open(parent.path()).expect("free");
        std::fs::create_dir_all(home.path().join("build/p1/deep")).expect("a build");
        drop(home);
        let home = Home::open(parent.path()).expect("free");
        home.sweep_builds();
        assert!(!home.path().join("build/p1").exists());
    }

    #[tokio::test]
    async fn a_long_path_has_its_socket_all_the_same() {
        let parent = tempfile::tempdir().expect("a directory");
        let home = Home::open(&parent.path().join("x".repeat(200))).expect("free");
        let listener = home.listen().expect("longer than an address can be");
        assert!(home.socket().exists());
        drop(listener);
        home.listen().expect("the old one is taken away");
    }
}
