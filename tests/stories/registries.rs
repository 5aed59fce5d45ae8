//! Clients of container registries pull images from the portal, as a cluster does.

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};

use anyhow::ensure;
use serde_json::Value;
use support::Verdict;
use support::daemon::Daemon;
use support::deployer::{CommandOutcome, run};
use support::tls::TlsProxy;
use support::world::{Directory, world};

use crate::access::create_token;

/// A containerd that only stores what is pulled.
struct Containerd {
    place: Directory,
    process: Child,
}

impl Containerd {
    fn start() -> anyhow::Result<Self> {
        let place = world().directory("containerd")?;
        let at = |name: &str| place.path().join(name);
        let config = format!(
            "version = 2\nroot = {:?}\nstate = {:?}\ndisabled_plugins = [\"io.containerd.grpc.v1.cri\", \
             \"io.containerd.internal.v1.opt\"]\n[grpc]\naddress = {:?}\n",
            at("root"),
            at("state"),
            at("containerd.sock"),
        );
        std::fs::write(at("config.toml"), config)?;
        let process = Command::new("containerd")
            .arg("--config")
            .arg(at("config.toml"))
            .stdin(Stdio::null())
            .stderr(Stdio::from(std::fs::File::create(at("log"))?))
            .spawn()?;
        let mut started = Self { place, process };
        support::wait_until("a containerd that answers", || {
            let ended = started.process.try_wait()?;
            ensure!(ended.is_none(), "containerd ended: {ended:?}");
            let version = started.run_ctr(&["version"])?;
            Ok(if version.status == 0 { Ok(()) } else { Err(version.output().to_owned()) })
        })?;
        Ok(started)
    }

    fn run_ctr(&self, words: &[&str]) -> anyhow::Result<CommandOutcome> {
        run(Command::new("ctr").arg("--address").arg(self.place.path().join("containerd.sock")).args(words))
    }

    /// Fetches an image's manifest, configuration and layers, and forgets it again.
    fn pull(&self, image: &str, words: &[&str]) -> anyhow::Result<CommandOutcome> {
        let pulled = self.run_ctr(&[&["content", "fetch"], words, &[image]].concat())?;
        self.run_ctr(&["images", "rm", "--sync", image])?;
        Ok(pulled)
    }
}

impl Drop for Containerd {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Checks that a pull is refused with this status in the words of the client's own library.
fn expect_refusal(refused: &CommandOutcome, expected: &[&str]) -> Verdict {
    let output = refused.output().to_lowercase();
    ensure!(refused.status != 0, "pulled: {output}");
    ensure!(expected.iter().any(|words| output.contains(words)), "{output}");
    Ok(())
}

/// Asks with a token; returns status and the first error's code and message.
fn read_error(daemon: &Daemon, token: &str, path: &str) -> anyhow::Result<(u16, String, String)> {
    let authorization = format!("Bearer {token}");
    let (status, body) = daemon.request("GET", path, &[("authorization", &authorization)])?;
    let body: Value = serde_json::from_str(&body)?;
    let text = |key: &str| body["errors"][0][key].as_str().unwrap_or_default().to_owned();
    Ok((status, text("code"), text("message")))
}

pub fn skopeo_and_containerd_pull_with_a_token() -> Verdict {
    let daemon = world().setup("registry").start()?;
    let deployer = daemon.deployer();
    for name in ["open_adder", "vault"] {
        let words = ["--name", name, "--node", "adder.py"];
        deployer.push("adder_py", &words)?.expect_success()?;
    }
    create_token(&daemon, &["chief", "--role", "admin"])?;
    let eve = create_token(&daemon, &["eve", "--role", "viewer", "--service", "open_*"])?;
    let containerd = Containerd::start()?;
    let proxy = TlsProxy::start(&daemon.address)?;
    let place = world().directory("pulled")?;
    let trusted: PathBuf = place.path().join("trusted");
    std::fs::create_dir(&trusted)?;
    std::fs::copy(proxy.authority(), trusted.join("authority.crt"))?;
    let secure = format!("localhost:{}", proxy.port);
    let token = format!("cluster:{eve}");

    let skopeo = |image: &str, words: &[&str]| {
        let to = place.path().join("image");
        let pulled = run(Command::new("skopeo")
            .args(["--insecure-policy", "copy"])
            .args(words)
            .args([&format!("docker://{image}"), &format!("dir:{}", to.display())]))?;
        let _ = std::fs::remove_dir_all(to);
        anyhow::Ok(pulled)
    };
    let directory = trusted.display().to_string();
    for (host, of_skopeo, of_containerd) in [
        (daemon.address.as_str(), vec!["--src-tls-verify=false"], Some(["--plain-http"])),
        // The command line of containerd 1.6 uses plain HTTP for this machine, whatever it is told.
        (secure.as_str(), vec!["--src-cert-dir", &directory], None),
    ] {
        let image = format!("{host}/open_adder:latest");
        let hidden = format!("{host}/vault:latest");
        let skopeo_as =
            |credentials: &str, image: &str| skopeo(image, &[&of_skopeo[..], &["--src-creds", credentials]].concat());
        let guessed = "cluster:guessed";
        skopeo_as(&token, &image)?.expect_success()?;
        // A service that the token does not see is refused in words that the client shows.
        expect_refusal(&skopeo_as(&token, &hidden)?, &["may not see service vault"])?;
        expect_refusal(&skopeo_as(guessed, &image)?, &["unauthorized", "authentication"])?;
        let Some(words) = of_containerd else { continue };
        let containerd_as =
            |credentials: &str, image: &str| containerd.pull(image, &[&words[..], &["--user", credentials]].concat());
        containerd_as(&token, &image)?.expect_success()?;
        expect_refusal(&containerd_as(&token, &hidden)?, &["denied", "forbidden", "403"])?;
        expect_refusal(&containerd_as(guessed, &image)?, &["unauthorized", "authorization", "401"])?;
    }

    // Whoever refuses, authentication, permissions or a handler: the format is the one of registries.
    let (status, code, message) = read_error(&daemon, &eve, "/v2/vault/tags/list")?;
    ensure!((status, code.as_str()) == (403, "DENIED"), "{status} {code} {message}");
    let (status, code, message) = read_error(&daemon, &eve, "/v2/open_adder/manifests/99")?;
    ensure!((status, code.as_str()) == (404, "MANIFEST_UNKNOWN"), "{status} {code} {message}");
    let (status, code, message) = read_error(&daemon, "guessed", "/v2/_catalog")?;
    ensure!((status, code.as_str()) == (401, "UNAUTHORIZED"), "{status} {code} {message}");
    daemon.stop()?;
    Ok(())
}
