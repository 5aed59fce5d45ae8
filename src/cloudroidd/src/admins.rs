//! The socket at which members of a group are admins: the daemon's own is in a directory that only its user enters.

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

/// The group when none is configured.
const GROUP: &str = "cloudroid";

/// Where members of which group are admins.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Admins {
    path: PathBuf,
    group: Gid,
}

/// A socket that listens for them; its file goes with it.
pub struct Listening {
    /// Accepts their connections.
    pub listener: UnixListener,
    /// Their group.
    pub group: u32,
    /// The file.
    pub file: SocketFile,
}

/// Removes a socket's file at the end.
pub struct SocketFile(PathBuf);

impl Drop for SocketFile {
    fn drop(&mut self) {
        let path = std::mem::take(&mut self.0);
        let _ = privilege::now(move || std::fs::remove_file(path));
    }
}

/// The number of a group that is written as its name or its number.
fn find(written: &str) -> anyhow::Result<Option<Gid>> {
    if let Ok(number) = written.parse() {
        return Ok(Some(Gid::from_raw(number)));
    }
    let group = Group::from_name(written)
        .with_context(|| format!("cannot look up the group {written:?}"))?;
    Ok(group.map(|group| group.gid))
}

impl Admins {
    /// Those of the configuration, or none. `runtime`: the directory that systemd made for the service.
    pub fn of(config: &Config, runtime: Option<PathBuf>) -> anyhow::Result<Option<Admins>> {
        let path = match (&config.admin_socket, &config.admin_group, runtime) {
            (Some(path), ..) => path.clone(),
            (None, _, Some(directory)) => directory.join("daemon.sock"),
            (None, Some(_), None) => bail!(
                "admin_group in the configuration needs a socket: write admin_socket = \"/run/cloudroid/daemon.sock\""
            ),
            (None, None, None) => return Ok(None),
        };
        let written = config.admin_group.as_deref().unwrap_or(GROUP);
        match find(written)? {
            Some(group) => Ok(Some(Admins { path, group })),
            // Nobody asked for it.
            None if config.admin_group.is_none() && config.admin_socket.is_none() => Ok(None),
            None => bail!(
                "there is no group {written:?} whose members could be admins; make it (groupadd --system {written}), or name another \
                 with admin_group in the configuration"
            ),
        }
    }

    /// Listens for them.
    pub fn listen(&self) -> anyhow::Result<Listening> {
        let path = &self.path;
        if let Some(directory) = path.parent() {
            std::fs::create_dir_all(directory)
                .with_context(|| format!("cannot create the directory {}", directory.display()))?;
        }
        clear(path)?;
        let listen = || {
            let listener = UnixListener::bind(path)?;
            chown(path, None, Some(self.group))?;
            std::fs::set_permissions(path, Permissions::from_mode(0o660))?;
            Ok::<_, std::io::Error>(listener)
        };
        Ok(Listening {
            listener: listen().with_context(|| format!("cannot listen on {}", path.display()))?,
            group: self.group.as_raw(),
            file: SocketFile(path.clone()),
        })
    }
}

/// Answers them until the daemon ends.
pub async fn serve(app: Arc<App>, router: Router, admins: Option<Listening>) {
    let Some(Listening {
        listener,
        group,
        file,
    }) = admins
    else {
        return;
    };
    portal::serve_unix(app, router, listener, Some(group)).await;
    drop(file);
}

/// Removes the socket of a daemon that was killed, and nothing else.
fn clear(path: &Path) -> anyhow::Result<()> {
    let Ok(about) = path.symlink_metadata() else {
        return Ok(());
    };
    if !about.file_type().is_socket() {
        bail!(
            "{} is there and is no socket; choose another admin_socket",
            path.display()
        );
    }
    if UnixStream::connect(path).is_ok() {
        bail!(
            "another program listens on {}; choose another admin_socket",
            path.display()
        );
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
        let of = |text: &str, runtime| Admins::of(&config(text), runtime);
        let admins = |path: &str, number| {
            Some(Admins {
                path: path.into(),
                group: Gid::from_raw(number),
            })
        };
        assert_eq!(of("", None).expect("good"), None);
        assert_eq!(
            of("admin_group = \"4711\"", runtime()).expect("good"),
            admins("/run/cloudroid/daemon.sock", 4711)
        );
        assert_eq!(
            of("admin_group = \"root\"\nadmin_socket = \"/x/y\"", None).expect("good"),
            admins("/x/y", 0)
        );
        for (text, words) in [
            ("admin_group = \"root\"", "needs a socket"),
            (
                "admin_group = \"no such group\"\nadmin_socket = \"/x/y\"",
                "there is no group",
            ),
        ] {
            let refused = of(text, None).expect_err(text).to_string();
            assert!(refused.contains(words), "{refused}");
        }
        let refused = of("admin_group = \"no such group\"", runtime())
            .expect_err("named")
            .to_string();
        assert!(refused.contains("groupadd"), "{refused}");
    }

    #[tokio::test]
    async fn only_what_a_killed_daemon_left_is_replaced() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("below/daemon.sock");
        let admins = Admins {
            path: path.clone(),
            group: Gid::current(),
        };
        let first = admins.listen().expect("listens");
        let mode = path.metadata().expect("there").permissions().mode() & 0o777;
        assert_eq!(mode, 0o660);
        let refused = admins.listen().err().expect("taken").to_string();
        assert!(refused.contains("another program"), "{refused}");
        // Killed: the listener is gone, its file is not.
        let Listening { listener, file, .. } = first;
        std::mem::forget(file);
        drop(listener);
        let second = admins.listen().expect("listens again");
        drop(second);
        assert!(!path.exists());
        std::fs::write(&path, "precious").expect("written");
        let refused = admins.listen().err().expect("no socket").to_string();
        assert!(refused.contains("is no socket"), "{refused}");
        assert_eq!(
            std::fs::read_to_string(&path).expect("left alone"),
            "precious"
        );
    }
}
