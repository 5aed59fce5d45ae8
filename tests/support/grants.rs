//! Resources granted to a service beyond its container, seen from inside. Runs on the host and in the virtual machine.

use std::io::ErrorKind;
use std::net::TcpListener;
use std::path::{Path, PathBuf};

use anyhow::ensure;

use crate::Verdict;
use crate::burglar::try_attempt;
use crate::robot::Robot;

/// Kind of the devices, which are harmless.
pub const KIND: &str = "story.example.org/harmless";
/// Mount point of the volume for the nodes.
pub const INSIDE: &str = "/models";

/// A CDI specification in one of the standard directories, until drop.
pub struct CdiSpecification(PathBuf);

impl CdiSpecification {
    /// Writes a specification of one device of this kind, `zero`, with a hook that must not be run.
    pub fn write(kind: &str) -> anyhow::Result<CdiSpecification> {
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
            // Atomically, because other daemons of this machine read it as well.
            let new = path.with_extension("new");
            let written = std::fs::write(&new, text.to_string());
            match written.and_then(|()| std::fs::rename(&new, &path)) {
                Ok(()) => return Ok(CdiSpecification(path)),
                // Another process removed the last other file and the directory.
                Err(error) if error.kind() == ErrorKind::NotFound => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
}

impl Drop for CdiSpecification {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
        // Only if it is empty.
        let _ = std::fs::remove_dir("/var/run/cdi");
    }
}

/// Creates the directory `models`, with a symbolic link to a file outside of it that must stay unreachable.
pub fn create_models(models: &Path) -> Verdict {
    std::fs::create_dir_all(models)?;
    std::fs::write(models.join("net.bin"), "weights")?;
    let secret = models.with_file_name("secret");
    std::fs::write(&secret, "of the host")?;
    std::os::unix::fs::symlink(&secret, models.join("sly"))?;
    Ok(())
}

/// Checks that the volume, the device and the egress address can be used, and nothing beyond them. The egress address
/// is that of `listener`.
pub fn check_grants(robot: &mut Robot, listener: &TcpListener) -> Verdict {
    let port = listener.local_addr()?.port();
    let other = TcpListener::bind("127.0.0.1:0")?;
    let mut can =
        |what: &str, argument: &str| -> anyhow::Result<bool> { Ok(try_attempt(robot, what, argument)?.succeeded) };
    ensure!(can("text-in-file", "/models/net.bin weights")?, "the volume is there");
    ensure!(!can("write", "/models/net.bin other")?, "and cannot be written");
    ensure!(!can("write", "/models/new other")?);
    ensure!(!can("read", "/models/sly")?, "a link in it leads nowhere outside");
    ensure!(can("read", "/dev/story0")?, "the device works");
    ensure!(can("environment", "STORY_DEVICE")?, "and brings its environment");
    ensure!(can("connect", &format!("127.0.1.1:{port}"))?, "the way out is open");
    listener.accept()?;
    let closed = other.local_addr()?.port();
    for address in [format!("127.0.1.1:{closed}"), format!("127.0.0.1:{port}"), format!("127.0.0.1:{closed}")] {
        ensure!(!can("connect", &address)?, "{address} is open, too");
    }
    Ok(())
}
