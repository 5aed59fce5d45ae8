//! What a service is given beyond its container: only what its push asked for, and the operator allowed.

use std::net::TcpListener;
use std::path::PathBuf;

use anyhow::ensure;
use support::Told;
use support::burglar::tries;
use support::deployer::path_str;
use support::world::{BURGLAR, world};

/// A specification in one of the standard's directories, while it lives.
struct Specification(PathBuf);

impl Specification {
    fn write(kind: &str) -> anyhow::Result<Specification> {
        let directory = PathBuf::from("/var/run/cdi");
        std::fs::create_dir_all(&directory)?;
        let path = directory.join(format!("cloudroid-story-{}.yaml", std::process::id()));
        let text = format!(
            "cdiVersion: 0.6.0\nkind: {kind}\ndevices:\n- name: zero\n  containerEdits:\n    env: [STORY_DEVICE=zero]\n    \
             deviceNodes:\n    - path: /dev/story0\n      hostPath: /dev/zero\n"
        );
        std::fs::write(&path, text)?;
        Ok(Specification(path))
    }
}

impl Drop for Specification {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
        // Only if nobody else's is there.
        let _ = std::fs::remove_dir("/var/run/cdi");
    }
}

pub fn a_service_is_given_what_its_operator_allows() -> Told {
    let kind = "story.example.org/harmless";
    let _specification = Specification::write(kind)?;
    let place = tempfile::tempdir()?;
    let models = place.path().join("models");
    std::fs::create_dir(&models)?;
    std::fs::write(models.join("net.bin"), "weights")?;
    std::fs::write(place.path().join("secret"), "of the host")?;
    std::os::unix::fs::symlink(place.path().join("secret"), models.join("sly"))?;
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let port = listener.local_addr()?.port();
    let other = TcpListener::bind("127.0.0.1:0")?;
    let config = format!(
        "[allow]\ndevices = [\"{kind}=*\"]\nvolumes = [{models:?}]\negress = [\"127.0.0.1:{port}\"]\n"
    );
    let daemon = world().own("granted").config(&config).start()?;
    let volume = format!("{}:/models", path_str(&models));
    daemon
        .deployer()
        .pushes(
            "burglar_cpp",
            &[
                "--node",
                "burglar",
                "--volume",
                &volume,
                "--device",
                &format!("{kind}=zero"),
                "--egress",
                &format!("127.0.0.1:{port}"),
            ],
        )?
        .succeeded()?;
    let mut robot = daemon.robot("burglar_cpp?robot=r1")?;
    let mut can = |what: &str, argument: &str| -> anyhow::Result<bool> {
        Ok(tries(&mut robot, what, argument)?.succeeded)
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
    drop(robot);
    daemon.ends()?;
    Ok(())
}

pub fn nothing_is_given_unasked_or_unallowed() -> Told {
    let daemon = world().with(BURGLAR)?;
    for (flag, value, kind) in [
        ("--volume", "/etc:/models", "volume /etc"),
        ("--device", "nvidia.com/gpu=0", "device nvidia.com/gpu=0"),
        ("--egress", "example.org:443", "egress example.org:443"),
    ] {
        daemon
            .deployer()
            .pushes(
                "burglar_cpp",
                &["--name", "greedy", "--node", "burglar", flag, value],
            )?
            .failed_saying(&[kind, "not allowed", "[allow]"])?;
    }
    Ok(())
}
