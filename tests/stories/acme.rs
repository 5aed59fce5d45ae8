//! A certificate from an ACME server: Pebble.

use std::os::unix::fs::PermissionsExt;
use std::process::Command;

use anyhow::{Context, ensure};
use support::acme::{AcmeDirectory, PebbleServer};
use support::daemon::Daemon;
use support::deployer::{CommandOutcome, run};
use support::machine::free_port;
use support::patience::{patience, scale_seconds};
use support::world::world;
use support::{Verdict, wait_until};

const NAME: &str = "robots.lab.example";
const CERTIFICATE_SECONDS: u64 = 90 * 86_400;
const TOKENS: &str = "tokens = [\"open sesame\"]\n";

fn port(daemon: &Daemon) -> anyhow::Result<u16> {
    let port = daemon.address.rsplit(':').next().context("a port")?;
    Ok(port.parse()?)
}

/// Requests the daemon with curl by its DNS name, trusting only certificates signed by `authority`.
fn curl(daemon: &Daemon, authority: &std::path::Path) -> anyhow::Result<CommandOutcome> {
    let port = port(daemon)?;
    run(Command::new("curl")
        .args(["--silent", "--show-error", "--max-time"])
        .arg(patience().as_secs().to_string())
        .args(["--write-out", "\n%{http_code}"])
        .args(["--resolve", &format!("{NAME}:{port}:127.0.0.1")])
        .arg("--cacert")
        .arg(authority)
        .arg(format!("https://{NAME}:{port}/healthz")))
}

fn wait_for_event(daemon: &Daemon, kind: &str, words: &[&str]) -> anyhow::Result<String> {
    let event = daemon.wait_for_event(kind, |event| {
        let message = event["message"].as_str().unwrap_or_default();
        event["kind"] == kind && words.iter().all(|word| message.contains(word))
    })?;
    Ok(event["message"].as_str().context("words")?.to_owned())
}

pub fn a_certificate_is_asked_for_and_renewed() -> Verdict {
    let directory = AcmeDirectory::new()?;
    let elsewhere = free_port()?;
    let setup = world()
        .setup("named")
        .config(&format!("{TOKENS}{}challenge_listen = \"127.0.0.1:{elsewhere}\"\n", directory.section(NAME)));
    let daemon = setup.start()?;
    // No ACME server is running yet; meanwhile the daemon uses its self-signed certificate.
    wait_for_event(
        &daemon,
        "certificate-not-renewed",
        &[&directory.url(), NAME, "cannot be reached", "next attempt in"],
    )?;
    ensure!(
        curl(&daemon, &daemon.home.join("tls/own.pem"))?.output().contains("no alternative certificate subject name"),
        "its own is for other names"
    );
    // A server that does not find this machine under the name.
    let lost = directory.start(free_port()?, CERTIFICATE_SECONDS)?;
    wait_for_event(
        &daemon,
        "certificate-not-renewed",
        &["could not verify the names", NAME, &format!("port 443 to port {elsewhere}")],
    )?;
    drop(lost);
    // A server that does, at the port that it is given. The account with the previous server is not valid here.
    let brief = directory.start(elsewhere, scale_seconds(9))?;
    let first = wait_for_event(&daemon, "certificate-shown", &[NAME])?;
    let answer = curl(&daemon, &brief.root())?.expect_success()?;
    ensure!(answer.stdout.contains("200"), "{}", answer.output());
    // It is renewed before it expires.
    daemon.wait_for_event("another certificate", |event| {
        event["kind"] == "certificate-shown" && event["message"] != *first
    })?;
    drop(brief);
    // The server may also validate at the portal's own port.
    let lasting = directory.start(port(&daemon)?, CERTIFICATE_SECONDS)?;
    let root = lasting.root();
    wait_until("a certificate of the other authority", || {
        let answer = curl(&daemon, &root)?;
        Ok((answer.status == 0).then_some(()).ok_or(answer.output()))
    })?;
    drop(lasting);
    // Certificate and key are stored for a daemon that starts while no server is available.
    for file in ["acme.pem", "acme-account.json"] {
        let mode = std::fs::metadata(daemon.home.join("tls").join(file))?.permissions().mode();
        ensure!(mode & 0o777 == 0o600, "{file}: {mode:o}");
    }
    daemon.stop()?;
    let daemon = setup.start()?;
    curl(&daemon, &root)?.expect_success()?;
    Ok(())
}

pub fn who_comes_for_something_else_is_answered_no_challenge() -> Verdict {
    let directory = AcmeDirectory::new()?;
    let elsewhere = free_port()?;
    let daemon = world()
        .setup("unchallenged")
        .config(&format!("{}challenge_listen = \"127.0.0.1:{elsewhere}\"\n", directory.section(NAME)))
        .start()?;
    let asks = |port: u16, protocol: &str| {
        run(Command::new("openssl")
            .args(["s_client", "-connect", &format!("127.0.0.1:{port}")])
            .args(["-servername", NAME, "-alpn", protocol])
            .stdin(std::process::Stdio::null()))
    };
    for port in [port(&daemon)?, elsewhere] {
        let unasked = asks(port, "acme-tls/1")?;
        ensure!(
            unasked.status != 0 && !unasked.stdout.contains("BEGIN CERTIFICATE"),
            "no challenge is under way: {}",
            unasked.output()
        );
    }
    // The port for challenges serves nothing else.
    let said = run(Command::new("curl")
        .args(["--silent", "--show-error", "--insecure", "--max-time"])
        .arg(patience().as_secs().to_string())
        .arg(format!("https://127.0.0.1:{elsewhere}/healthz")))?;
    ensure!(said.status != 0, "{}", said.output());
    Ok(())
}

pub fn what_cannot_be_asked_for_is_said_at_the_start() -> Verdict {
    for (own, section, words) in [
        ("disagreeing", "names = [\"robots.lab.example\"]", "accept_terms = true"),
        ("wild", "names = [\"*.lab.example\"]\naccept_terms = true", "wildcards"),
        (
            "displaced",
            "names = [\"robots.lab.example\"]\naccept_terms = true\nchallenge_listen = \"192.0.2.1:443\"",
            "challenge_listen in [tls.acme]",
        ),
    ] {
        let refused = world().setup(own).config(&format!("[tls.acme]\n{section}\n")).expect_refusal()?;
        ensure!(refused.contains(words), "{words}: {refused}");
    }
    Ok(())
}

pub fn what_it_is_tested_with_ends_with_who_started_it() -> Verdict {
    let directory = AcmeDirectory::new()?;
    let mut started = std::thread::scope(|scope| {
        // As in a run that is killed, nobody ends them.
        let starter =
            scope.spawn(|| directory.start(free_port()?, CERTIFICATE_SECONDS).map(PebbleServer::into_processes));
        starter.join().map_err(|_| anyhow::anyhow!("it panicked"))?
    })?;
    ensure!(started.len() == 2, "{started:?}");
    wait_until("the end of Pebble", || {
        for process in &mut started {
            if process.try_wait()?.is_none() {
                return Ok(Err(format!("{process:?} runs")));
            }
        }
        Ok(Ok(()))
    })
}
