//! What a service is given beyond its container, seen from inside. Told on the host and in the virtual machine.

use std::io::ErrorKind;
use std::net::TcpListener;
use std::path::{Path, PathBuf};

use anyhow::ensure;

use crate::Verdict;
use crate::burglar::tries;
use crate::robot::Robot;

/// Harmless devices.
pub const KIND: &str = "story.example.org/harmless";
/// Where the nodes find the volume.
pub const INSIDE: &str = "/models";

/// A CDI specification in one of the standard's directories, while it lives.
pub struct Specification(PathBuf);

impl Specification {
    /// Of devices of this kind: one, `zero`, with a hook that must not be run.
    pub fn write(kind: &str) -> anyhow::Result<Specification> {
        let directory = PathBuf::from("/var/run/cdi");
        let path = directory.join(format!("cloudroid-story-{}.json", std::process::id()));
        let hook = serde_json::json!({"hookName": "createRuntime", "path": "/bin/false", "args": ["false", "story"]});
        let text = serde_json::json!({
            "cdiVersion": "0.6.0",
            "kind": kind,
            "devices": [{"name": "zero", "containerEdits": {
                "env": ["STORY_DEVICE=zero"],
                "deviceNodes": [{"path": "/dev/story0", "hostPath": "/dev/zero"}],
                "hooks": [hook],
            }}],
        });
        loop {
            std::fs::create_dir_all(&directory)?;
            // Whole or not at all: other daemons of this machine read it, too.
            let new = path.with_extension("new");
            let written = std::fs::write(&new, text.to_string());
            match written.and_then(|()| std::fs::rename(&new, &path)) {
                Ok(()) => return Ok(Specification(path)),
                // Somebody else's was the last in it, and has gone with the directory.
                Err(error) if error.kind() == ErrorKind::NotFound => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
}

impl Drop for Specification {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
        // Only if nobody else's is there.
        let _ = std::fs::remove_dir("/var/run/cdi");
    }
}

/// Makes the directory `models`, with a link in it that leads to something beside it that is nobody's business.
pub fn lay_out(models: &Path) -> Verdict {
    std::fs::create_dir_all(models)?;
    std::fs::write(models.join("net.bin"), "weights")?;
    let secret = models.with_file_name("secret");
    std::fs::write(&secret, "of the host")?;
    std::os::unix::fs::symlink(&secret, models.join("sly"))?;
    Ok(())
}

/// The volume, the device and the way out are there, and no more than they. The way out is to this listener.
pub fn are_there_and_no_more(robot: &mut Robot, listener: &TcpListener) -> Verdict {
    let port = listener.local_addr()?.port();
    let other = TcpListener::bind("127.0.0.1:0")?;
    let mut can = |what: &str, argument: &str| -> anyhow::Result<bool> {
        Ok(tries(robot, what, argument)?.succeeded)
    };
    ensure!(
        can("text-in-file", "/models/net.bin weights")?,
        "the volume is there"
    );
    ensure!(
        !can("write", "/models/net.bin other")?,
        "and cannot be written"
    );
    ensure!(!can("write", "/models/new other")?);
    ensure!(
        !can("read", "/models/sly")?,
        "a link in it leads nowhere outside"
    );
    ensure!(can("read", "/dev/story0")?, "the device works");
    ensure!(
        can("environment", "STORY_DEVICE")?,
        "and brings its environment"
    );
    ensure!(
        can("connect", &format!("127.0.1.1:{port}"))?,
        "the way out is open"
    );
    listener.accept()?;
    let closed = other.local_addr()?.port();
    for address in [
        format!("127.0.1.1:{closed}"),
        format!("127.0.0.1:{port}"),
        format!("127.0.0.1:{closed}"),
    ] {
        ensure!(!can("connect", &address)?, "{address} is open, too");
    }
    Ok(())
}
