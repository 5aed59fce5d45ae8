//! The state directory of one daemon, and the lock that makes it exclusive.
//!
//! ```text
//! lock  cloudroid.db  signing.pem  tls/  images/  layers/  run/daemon.sock
//! servants/<id>/  ended/<id>/  build/<push>/  logs/  recordings/  definitions/  bases/
//! ```
//!
//! No other user can enter it (docs/adr/033).

mod mounts;

use std::fs::{File, Permissions};
use std::io::{Read, Seek, Write};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use nix::fcntl::{Flock, FlockArg};
use servant::process::ProcessIdentity;
use tokio::net::UnixListener;

use store::private;

/// Number of attempts, and the pause between them, to get a lock whose daemon has ended.
const PAUSES: u32 = 100;
const PAUSE: Duration = Duration::from_millis(20);

/// Reason why a directory cannot be the home.
#[derive(Debug, thiserror::Error)]
pub enum HomeError {
    /// Another daemon uses it.
    #[error(
        "another cloudroidd{pid} already uses {home}; stop it first ({way}), or choose another directory with --home"
    )]
    Taken {
        /// The directory.
        home: PathBuf,
        /// ` (pid N)`, if that process certainly holds it.
        pid: String,
        /// Command to end the other daemon, or to find it.
        way: String,
    },
    /// No default directory can be determined.
    #[error("neither CLOUDROID_HOME nor XDG_DATA_HOME nor HOME is set; name a state directory with --home")]
    Nowhere,
    /// A file system operation failed.
    #[error("cannot {action} {path}: {source}")]
    Io {
        /// Verb of the operation.
        action: &'static str,
        /// Path of the file or directory.
        path: PathBuf,
        /// Underlying error.
        source: std::io::Error,
    },
}

/// Verb for removing the access rights of others.
const CLOSE: &str = "restrict access to";

/// A home that this process has locked. The lock ends with the process, however it ends.
#[derive(Debug)]
pub struct Home {
    path: PathBuf,
    _lock: Flock<File>,
}

/// Returns the default state directory: `$CLOUDROID_HOME`, otherwise `cloudroid` in the user's data directory.
pub fn default_path(variable: impl Fn(&str) -> Option<std::ffi::OsString>) -> Result<PathBuf, HomeError> {
    let set = |name| variable(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    set("CLOUDROID_HOME")
        .or_else(|| set("XDG_DATA_HOME").map(|data| data.join("cloudroid")))
        .or_else(|| set("HOME").map(|user| user.join(".local/share/cloudroid")))
        .ok_or(HomeError::Nowhere)
}

impl Home {
    /// Returns the cache directory, which daemons share: `$XDG_CACHE_HOME/cloudroid` or `~/.cache/cloudroid`; in the
    /// home if neither variable is set.
    pub fn cache(&self) -> PathBuf {
        let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
        variable("XDG_CACHE_HOME")
            .or_else(|| variable("HOME").map(|user| user.join(".cache")))
            .map_or_else(|| self.path().join("cache"), |cache| cache.join("cloudroid"))
    }

    /// Creates what is missing of the directory and locks it.
    pub fn open(path: &Path) -> Result<Home, HomeError> {
        let path = std::path::absolute(path).map_err(io_error("resolve", path))?;
        private::make_directory(&path).map_err(io_error("create the directory", &path))?;
        let lock = lock(&path, &mut || std::thread::sleep(PAUSE))?;
        let home = Home { path, _lock: lock };
        for name in ["images", "layers", "run", "servants", "ended", "build", "logs"] {
            let directory = home.path.join(name);
            private::make_directory(&directory).map_err(io_error("create the directory", &directory))?;
        }
        home.restrict_permissions()?;
        Ok(home)
    }

    /// Removes access rights of others that an earlier version, or an operator's umask, has left. Root file systems of
    /// servants are left alone: the files of a layer have the rights that their image gives, and are in a directory
    /// that no other user can enter.
    fn restrict_permissions(&self) -> Result<(), HomeError> {
        let closed = |name: &str, levels, leave: &dyn Fn(&Path) -> bool| {
            let path = self.path.join(name);
            private::restrict_tree(&path, levels, leave).map_err(io_error(CLOSE, &path))
        };
        let nothing = |_: &Path| false;
        closed("images", 3, &nothing)?;
        closed("definitions", 1, &nothing)?;
        closed("bases", 1, &nothing)?;
        closed("logs", 1, &nothing)?;
        closed("ended", 2, &nothing)?;
        closed("run", 1, &nothing)?;
        closed("tls", 1, &nothing)?;
        closed("layers", 0, &nothing)?;
        closed("build", 1, &nothing)?;
        // The only root file system below a servant's directory is its topmost layer.
        closed("servants", 2, &|path| path.is_dir() && path.ends_with("skeleton"))?;
        for name in ["cloudroid.db", "cloudroid.db-wal", "cloudroid.db-shm", "signing.pem"] {
            closed(name, 0, &nothing)?;
        }
        if !is_exclusive(&self.path).map_err(io_error(CLOSE, &self.path))? {
            tracing::warn!(
                "{} has other files, so its permissions are not changed; only the daemon's own files in it are \
                    restricted; use a dedicated directory with --home",
                self.path.display()
            );
            return Ok(());
        }
        private::restrict_tree(&self.path, 1, &|path| path.is_dir()).map_err(io_error(CLOSE, &self.path))
    }

    /// Returns the path of the directory.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the path of the OCI image layout.
    pub fn images(&self) -> PathBuf {
        self.path.join("images")
    }

    /// Returns the path of the extracted layers.
    pub fn layers(&self) -> PathBuf {
        self.path.join("layers")
    }

    /// Returns the path of the database.
    pub fn database(&self) -> PathBuf {
        self.path.join("cloudroid.db")
    }

    /// Returns the path of the key that signs stubs.
    pub fn signing_key(&self) -> PathBuf {
        self.path.join("signing.pem")
    }

    /// Listens on the socket of the command line, for root and this user only.
    pub fn listen(&self) -> Result<UnixListener, HomeError> {
        let path = self.socket();
        // No other process can be listening: the home is locked.
        let _ = std::fs::remove_file(&path);
        let directory = self.path.join("run");
        let opened = File::open(&directory).map_err(io_error("open", &directory))?;
        // Through a descriptor of its directory, because the path may be longer than a socket address allows.
        let address = format!("/proc/self/fd/{}/daemon.sock", opened.as_raw_fd());
        let listener = UnixListener::bind(address).map_err(io_error("listen on", &path))?;
        std::fs::set_permissions(&path, Permissions::from_mode(0o600)).map_err(io_error("protect", &path))?;
        Ok(listener)
    }

    /// Returns the path of the socket of the command line.
    pub fn socket(&self) -> PathBuf {
        self.path.join("run/daemon.sock")
    }

    /// Returns the unfinished builds of an earlier daemon. Must be called before any build begins.
    pub fn leftover_builds(&self) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(self.path.join("build"));
        let entries = entries.into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).collect()
    }
}

/// Removes unfinished builds, after their containers have ended. Detaches what is mounted there first, which may be a
/// directory of the host. Blocking. Failures are logged, and the next start tries again.
pub fn sweep_builds(half_made: &[PathBuf]) {
    for half_made in half_made {
        if let Err(error) = mounts::detach_below(half_made) {
            tracing::error!("cannot remove {}: {error}", half_made.display());
            continue;
        }
        match foreign::remove(half_made) {
            Ok(()) => tracing::info!("removed the unfinished build {}", half_made.display()),
            Err(error) => tracing::error!("cannot remove {}: {error}", half_made.display()),
        }
    }
}

/// Directories that a daemon, or a new file system, makes in a home.
const DIRECTORIES: [&str; 13] = [
    "images",
    "layers",
    "run",
    "servants",
    "ended",
    "build",
    "logs",
    "tls",
    "definitions",
    "bases",
    "recordings",
    "cache",
    "lost+found",
];

/// Returns whether a directory is used by a daemon only: it belongs to this user and contains no other directories.
fn is_exclusive(path: &Path) -> std::io::Result<bool> {
    let about = std::fs::metadata(path)?;
    let shared = about.mode() & libc::S_ISVTX != 0;
    if shared || about.uid() != nix::unistd::geteuid().as_raw() {
        return Ok(false);
    }
    for entry in std::fs::read_dir(path)? {
        let entry = entry?;
        let known = DIRECTORIES.iter().any(|name| entry.file_name() == *name);
        if entry.file_type()?.is_dir() && !known {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Locks a home. A daemon that was killed may have forked a process that has not executed its own program yet and still
/// holds the daemon's lock: waits for that.
fn lock(home: &Path, pause: &mut dyn FnMut()) -> Result<Flock<File>, HomeError> {
    let mut left = PAUSES;
    loop {
        match try_lock(home) {
            Err(HomeError::Taken { pid, .. }) if pid.is_empty() && left > 0 => {
                left -= 1;
                pause();
            }
            outcome => return outcome,
        }
    }
}

fn try_lock(home: &Path) -> Result<Flock<File>, HomeError> {
    let path = home.join("lock");
    let file = private::open(&path).map_err(io_error("open", &path))?;
    match Flock::lock(file, FlockArg::LockExclusiveNonblock) {
        Ok(mut locked) => {
            let holder = ProcessIdentity::from_pid(std::process::id() as i32).map_err(io_error("look at", &path))?;
            locked.set_len(0).map_err(io_error("write", &path))?;
            locked.rewind().map_err(io_error("write", &path))?;
            let record = serde_json::to_string(&holder).unwrap_or_default();
            writeln!(locked, "{record}").map_err(io_error("write", &path))?;
            Ok(locked)
        }
        Err((mut file, nix::errno::Errno::EWOULDBLOCK)) => {
            let mut record = String::new();
            let _ = file.read_to_string(&mut record);
            Err(taken_error(home, &record))
        }
        Err((_, errno)) => Err(HomeError::Io { action: "lock", path, source: errno.into() }),
    }
}

/// Returns the error that names the holder of the home. A process is named only if it is the one that wrote the record,
/// and not another that has the same pid now.
fn taken_error(home: &Path, record: &str) -> HomeError {
    let holder = serde_json::from_str::<ProcessIdentity>(record)
        .ok()
        .filter(|holder| holder.open_pidfd().is_ok_and(|held| held.is_some()));
    let (pid, way) = match holder {
        Some(ProcessIdentity { pid, .. }) => (format!(" (pid {pid})"), format!("kill {pid}")),
        None => {
            let way = format!("fuser -v {}/lock shows its process", home.display());
            (String::new(), way)
        }
    };
    HomeError::Taken { home: home.to_owned(), pid, way }
}

fn io_error(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> HomeError {
    let path = path.to_owned();
    move |source| HomeError::Io { action, path, source }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn variables(set: &'static [(&'static str, &'static str)]) -> impl Fn(&str) -> Option<std::ffi::OsString> {
        move |name| set.iter().find(|(known, _)| *known == name).map(|(_, value)| (*value).into())
    }

    #[test]
    fn the_default_is_below_the_users_data() {
        let all = variables(&[("CLOUDROID_HOME", "/c"), ("XDG_DATA_HOME", "/x"), ("HOME", "/h")]);
        assert_eq!(default_path(all).expect("set"), Path::new("/c"));
        let xdg = variables(&[("CLOUDROID_HOME", ""), ("XDG_DATA_HOME", "/x"), ("HOME", "/h")]);
        assert_eq!(default_path(xdg).expect("set"), Path::new("/x/cloudroid"));
        let home = variables(&[("HOME", "/h")]);
        assert_eq!(default_path(home).expect("set"), Path::new("/h/.local/share/cloudroid"));
        assert!(matches!(default_path(variables(&[])), Err(HomeError::Nowhere)));
    }

    #[test]
    fn a_second_daemon_is_told_the_firsts_pid() {
        let parent = tempfile::tempdir().expect("a directory");
        let first = Home::open(&parent.path().join("home")).expect("free");
        let refused = Home::open(first.path()).expect_err("taken").to_string();
        assert!(refused.contains(&format!("(pid {})", std::process::id())), "{refused}");
        assert!(refused.contains("--home"), "{refused}");
        let path = first.path().to_owned();
        drop(first);
        Home::open(&path).expect("free again");
    }

    #[test]
    fn what_a_killed_daemon_had_started_is_waited_for() {
        let parent = tempfile::tempdir().expect("a directory");
        let first = Home::open(&parent.path().join("home")).expect("free");
        let path = first.path().to_owned();
        // Simulates a lock that another process holds without a record.
        std::fs::write(path.join("lock"), "").expect("written");
        let (mut first, mut pauses) = (Some(first), 0);
        let locked = lock(&path, &mut || {
            pauses += 1;
            if pauses == 3 {
                first = None;
            }
        });
        assert!(locked.is_ok() && first.is_none(), "{pauses}");
        let refused = lock(&path, &mut || {}).expect_err("taken by whom we know");
        assert!(refused.to_string().contains("(pid"), "{refused}");
        std::fs::write(path.join("lock"), "").expect("written");
        let mut pauses = 0;
        let refused = lock(&path, &mut || pauses += 1).expect_err("not let go");
        assert!(refused.to_string().contains("fuser -v"), "{refused}");
        assert_eq!(pauses, PAUSES);
    }

    #[test]
    fn a_process_that_only_has_the_number_is_not_named() {
        let own = ProcessIdentity::from_pid(std::process::id() as i32).expect("this process");
        let later = ProcessIdentity { start: own.start + 1, ..own };
        let before = ProcessIdentity { boot: own.boot ^ 1, ..own };
        let home = Path::new("/home/of/a/daemon");
        let text = |holder: &ProcessIdentity| serde_json::to_string(holder).expect("JSON");
        for record in [text(&later), text(&before), "1\n".to_owned(), String::new()] {
            let refused = taken_error(home, &record).to_string();
            assert!(!refused.contains("kill"), "{record}: {refused}");
            assert!(!refused.contains("pid"), "{record}: {refused}");
            assert!(refused.contains("fuser -v /home/of/a/daemon/lock"), "{refused}");
        }
        let known = taken_error(home, &text(&own)).to_string();
        assert!(known.contains(&format!("kill {}", own.pid)), "{known}");
    }

    fn mode(path: &Path) -> u32 {
        path.symlink_metadata().expect("there").permissions().mode() & 0o7777
    }

    /// Creates the files of a home of an earlier version, with a servant at work.
    fn lay_out(home: &Path) {
        let files = [
            "cloudroid.db",
            "cloudroid.db-wal",
            "cloudroid.db-shm",
            "lock",
            "images/index.json",
            "images/blobs/sha256/0a",
            "definitions/a.toml",
            "logs/p1.log",
            "run/daemon.sock",
            "servants/s1/spec.json",
            "servants/s1/log.jsonl",
            "servants/s1/log.jsonl.1",
            "ended/s0/log.jsonl",
            "servants/s1/skeleton/etc/hosts",
            "layers/0b/usr/lib/thing",
            "build/p1/tree/source.cpp",
        ];
        for name in files {
            let path = home.join(name);
            std::fs::create_dir_all(path.parent().expect("below")).expect("made");
            std::fs::write(&path, "").expect("made");
            for path in path.ancestors().take_while(|path| path.starts_with(home)) {
                let rights = if path.is_dir() { 0o755 } else { 0o644 };
                let permissions = Permissions::from_mode(rights);
                std::fs::set_permissions(path, permissions).expect("set");
            }
        }
    }

    /// Visits all files below a path, except inside directories of these names.
    fn walk(path: &Path, inside: &[&str], each: &mut dyn FnMut(&Path)) {
        each(path);
        let skipped = inside.iter().any(|name| path.ends_with(name));
        if path.is_dir() && !skipped {
            for entry in std::fs::read_dir(path).expect("read") {
                walk(&entry.expect("read").path(), inside, each);
            }
        }
    }

    #[test]
    fn a_home_that_others_could_read_is_mended() {
        let parent = tempfile::tempdir().expect("a directory");
        let path = parent.path().join("home");
        lay_out(&path);
        drop(Home::open(&path).expect("free"));
        walk(&path, &["layers", "skeleton", "build/p1"], &mut |found| {
            let expected = found.ends_with("skeleton");
            assert_eq!(mode(found) & 0o077 != 0, expected, "{}", found.display());
        });
        for (name, rights) in [
            ("layers/0b", 0o755),
            ("layers/0b/usr/lib/thing", 0o644),
            ("servants/s1/skeleton", 0o755),
            ("servants/s1/skeleton/etc/hosts", 0o644),
        ] {
            assert_eq!(mode(&path.join(name)), rights, "{name} is a servant's");
        }
    }

    #[test]
    fn a_directory_with_other_things_in_it_keeps_its_rights() {
        let parent = tempfile::tempdir().expect("a directory");
        let theirs = parent.path().join("notes");
        std::fs::create_dir(&theirs).expect("made");
        let shared = Permissions::from_mode(0o755);
        std::fs::set_permissions(parent.path(), shared).expect("set");
        let rights = mode(&theirs);
        drop(Home::open(parent.path()).expect("free"));
        // Opens it a second time, when the daemon's own files exist.
        let home = Home::open(parent.path()).expect("free");
        assert_eq!((mode(parent.path()), mode(&theirs)), (0o755, rights));
        for name in ["lock", "images", "layers", "servants", "run", "build", "logs"] {
            assert_eq!(mode(&home.path().join(name)) & 0o077, 0, "{name}");
        }
    }

    #[test]
    fn half_made_builds_are_swept() {
        let parent = tempfile::tempdir().expect("a directory");
        let home = Home::open(parent.path()).expect("free");
        std::fs::create_dir_all(home.path().join("build/p1/deep")).expect("a build");
        drop(home);
        let home = Home::open(parent.path()).expect("free");
        sweep_builds(&home.leftover_builds());
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
