//! The admin socket, at which members of a group are admins. The daemon's own socket is in a directory that only its
//! user can enter.

use std::fs::Permissions;
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use nix::unistd::{Gid, Group, chown};
use portal::{App, Router};
use tokio::net::UnixListener;

use crate::config::Config;

/// Default admin group.
const GROUP: &str = "cloudroid";

/// Path of the admin socket and the group whose members are admins there.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AdminSocket {
    path: PathBuf,
    group: Gid,
}

/// A bound admin socket; its file is removed with it.
pub struct AdminListener {
    /// Accepts the connections of admins.
    pub listener: UnixListener,
    /// Group id of the admins.
    pub group: u32,
    /// File of the socket, removed on drop.
    pub file: SocketFile,
}

/// Removes a socket's file on drop.
pub struct SocketFile(PathBuf);

impl Drop for SocketFile {
    fn drop(&mut self) {
        let path = std::mem::take(&mut self.0);
        let _ = privilege::run_sync(move || std::fs::remove_file(path));
    }
}

/// Looks up a group by its name or number.
fn find_group(written: &str) -> anyhow::Result<Option<Gid>> {
    if let Ok(number) = written.parse() {
        return Ok(Some(Gid::from_raw(number)));
    }
    let group = Group::from_name(written).with_context(|| format!("cannot look up the group {written:?}"))?;
    Ok(group.map(|group| group.gid))
}

impl AdminSocket {
    /// Returns the admin socket of the configuration, if any. `runtime` is the directory that systemd made for the
    /// service.
    pub fn from_config(config: &Config, runtime: Option<PathBuf>) -> anyhow::Result<Option<AdminSocket>> {
        let path = match (&config.admin_socket, &config.admin_group, runtime) {
            (Some(path), ..) => path.clone(),
            (None, _, Some(directory)) => directory.join("daemon.sock"),
            (None, Some(_), None) => bail!(
                "admin_group in the configuration needs a socket: write admin_socket = \"/run/cloudroid/daemon.sock\""
            ),
            (None, None, None) => return Ok(None),
        };
        let written = config.admin_group.as_deref().unwrap_or(GROUP);
        match find_group(written)? {
            Some(group) => Ok(Some(AdminSocket { path, group })),
            // Without a configured group or socket, a missing default group is no error.
            None if config.admin_group.is_none() && config.admin_socket.is_none() => Ok(None),
            None => bail!(
                "no group {written:?} for admin access; create it (groupadd --system {written}), or set admin_group in \
                    the configuration to another group"
            ),
        }
    }

    /// Binds the socket and gives it to the group (mode 0660).
    pub fn listen(&self) -> anyhow::Result<AdminListener> {
        let path = &self.path;
        if let Some(directory) = path.parent() {
            std::fs::create_dir_all(directory)
                .with_context(|| format!("cannot create the directory {}", directory.display()))?;
        }
        remove_stale_socket(path)?;
        let listen = || {
            let listener = UnixListener::bind(path)?;
            chown(path, None, Some(self.group))?;
            std::fs::set_permissions(path, Permissions::from_mode(0o660))?;
            Ok::<_, std::io::Error>(listener)
        };
        Ok(AdminListener {
            listener: listen().with_context(|| format!("cannot listen on {}", path.display()))?,
            group: self.group.as_raw(),
            file: SocketFile(path.clone()),
        })
    }
}

/// Serves the admin socket until the daemon ends.
pub async fn serve(app: Arc<App>, router: Router, admins: Option<AdminListener>) {
    let Some(AdminListener { listener, group, file }) = admins else {
        return;
    };
    portal::serve_unix(app, router, listener, Some(group)).await;
    drop(file);
}

/// Removes the socket of a daemon that was killed; any other file, or a socket in use, is an error.
fn remove_stale_socket(path: &Path) -> anyhow::Result<()> {
    let Ok(about) = path.symlink_metadata() else {
        return Ok(());
    };
    if !about.file_type().is_socket() {
        bail!("{} exists and is not a socket; choose another admin_socket", path.display());
    }
    if UnixStream::connect(path).is_ok() {
        bail!("another program listens on {}; choose another admin_socket", path.display());
    }
    std::fs::remove_file(path).with_context(|| format!("cannot remove {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(text: &str) -> Config {
        toml::from_str(text).expect("a configuration")
    }

    #[test]
    fn the_group_is_the_one_that_was_named_and_nobody_is_admin_unasked() {
        let runtime = || Some(PathBuf::from("/run/cloudroid"));
        let of = |text: &str, runtime| AdminSocket::from_config(&config(text), runtime);
        let admins = |path: &str, number| Some(AdminSocket { path: path.into(), group: Gid::from_raw(number) });
        assert_eq!(of("", None).expect("good"), None);
        assert_eq!(of("admin_group = \"4711\"", runtime()).expect("good"), admins("/run/cloudroid/daemon.sock", 4711));
        assert_eq!(of("admin_group = \"root\"\nadmin_socket = \"/x/y\"", None).expect("good"), admins("/x/y", 0));
        for (text, words) in [
            ("admin_group = \"root\"", "needs a socket"),
            ("admin_group = \"no such group\"\nadmin_socket = \"/x/y\"", "no group"),
        ] {
            let refused = of(text, None).expect_err(text).to_string();
            assert!(refused.contains(words), "{refused}");
        }
        let refused = of("admin_group = \"no such group\"", runtime()).expect_err("named").to_string();
        assert!(refused.contains("groupadd"), "{refused}");
    }

    #[tokio::test]
    async fn only_what_a_killed_daemon_left_is_replaced() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("below/daemon.sock");
        let admins = AdminSocket { path: path.clone(), group: Gid::current() };
        let first = admins.listen().expect("listens");
        let mode = path.metadata().expect("there").permissions().mode() & 0o777;
        assert_eq!(mode, 0o660);
        let refused = admins.listen().err().expect("taken").to_string();
        assert!(refused.contains("another program"), "{refused}");
        // Simulates a killed daemon: the listener is gone, its file is not.
        let AdminListener { listener, file, .. } = first;
        std::mem::forget(file);
        drop(listener);
        let second = admins.listen().expect("listens again");
        drop(second);
        assert!(!path.exists());
        std::fs::write(&path, "precious").expect("written");
        let refused = admins.listen().err().expect("no socket").to_string();
        assert!(refused.contains("is not a socket"), "{refused}");
        assert_eq!(std::fs::read_to_string(&path).expect("left alone"), "precious");
    }
}
