//! A certificate of an authority that is asked by ACME: Pebble.

use std::os::unix::fs::PermissionsExt;
use std::process::Command;

use anyhow::{Context, ensure};
use support::acme::Directory;
use support::daemon::Daemon;
use support::deployer::{Outcome, run};
use support::machine::free_port;
use support::patience::{patience, scale_seconds};
use support::world::world;
use support::{Verdict, until};

const NAME: &str = "robots.lab.example";
const LONG: u64 = 90 * 86_400;
const TOKENS: &str = "tokens = [\"open sesame\"]\n";

fn port(daemon: &Daemon) -> anyhow::Result<u16> {
    let port = daemon.address.rsplit(':').next().context("a port")?;
    Ok(port.parse()?)
}

/// curl at the daemon under its name in the DNS, whose certificate `authority` is to have signed.
fn curl(daemon: &Daemon, authority: &std::path::Path) -> anyhow::Result<Outcome> {
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

fn awaits_event(daemon: &Daemon, kind: &str, words: &[&str]) -> anyhow::Result<String> {
    let event = daemon.awaits_event(kind, |event| {
        let message = event["message"].as_str().unwrap_or_default();
        event["kind"] == kind && words.iter().all(|word| message.contains(word))
    })?;
    Ok(event["message"].as_str().context("words")?.to_owned())
}

pub fn a_certificate_is_asked_for_and_renewed() -> Verdict {
    let directory = Directory::new()?;
    let elsewhere = free_port()?;
    let setup = world().own("named").config(&format!(
        "{TOKENS}{}challenge_listen = \"127.0.0.1:{elsewhere}\"\n",
        directory.section(NAME)
    ));
    let daemon = setup.start()?;
    // Nobody answers there. What the daemon has made itself is shown until then.
    awaits_event(
        &daemon,
        "certificate-not-renewed",
        &[
            &directory.url(),
            NAME,
            "cannot be reached",
            "asked again in",
        ],
    )?;
    ensure!(
        curl(&daemon, &daemon.home.join("tls/own.pem"))?
            .said()
            .contains("no alternative certificate subject name"),
        "its own is for other names"
    );
    // One that does not find this machine behind the name.
    let lost = directory.opens(free_port()?, LONG)?;
    awaits_event(
        &daemon,
        "certificate-not-renewed",
        &[
            "could not see that the names lead here",
            NAME,
            &format!("port 443 has to be led to port {elsewhere}"),
        ],
    )?;
    drop(lost);
    // One that does, where it is told to look. The account with the one before is no account with this one.
    let brief = directory.opens(elsewhere, scale_seconds(9))?;
    let first = awaits_event(&daemon, "certificate-shown", &[NAME])?;
    let answer = curl(&daemon, &brief.root())?.succeeded()?;
    ensure!(answer.stdout.contains("200"), "{}", answer.said());
    // It is renewed while it is good.
    daemon.awaits_event("another certificate", |event| {
        event["kind"] == "certificate-shown" && event["message"] != *first
    })?;
    drop(brief);
    // The portal's own port is another where it may look.
    let lasting = directory.opens(port(&daemon)?, LONG)?;
    let root = lasting.root();
    until("a certificate of the other authority", || {
        let answer = curl(&daemon, &root)?;
        Ok((answer.status == 0).then_some(()).ok_or(answer.said()))
    })?;
    drop(lasting);
    // It is kept, with its key, for a daemon that starts when nobody can be asked.
    for file in ["acme.pem", "acme-account.json"] {
        let mode = std::fs::metadata(daemon.home.join("tls").join(file))?
            .permissions()
            .mode();
        ensure!(mode & 0o777 == 0o600, "{file}: {mode:o}");
    }
    daemon.ends()?;
    let daemon = setup.start()?;
    curl(&daemon, &root)?.succeeded()?;
    Ok(())
}

pub fn who_comes_for_something_else_is_answered_no_challenge() -> Verdict {
    let directory = Directory::new()?;
    let elsewhere = free_port()?;
    let daemon = world()
        .own("unchallenged")
        .config(&format!(
            "{}challenge_listen = \"127.0.0.1:{elsewhere}\"\n",
            directory.section(NAME)
        ))
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
            unasked.said()
        );
    }
    // Where challenges alone are answered, nothing is.
    let said = run(Command::new("curl")
        .args(["--silent", "--show-error", "--insecure", "--max-time"])
        .arg(patience().as_secs().to_string())
        .arg(format!("https://127.0.0.1:{elsewhere}/healthz")))?;
    ensure!(said.status != 0, "{}", said.said());
    Ok(())
}

pub fn what_cannot_be_asked_for_is_said_at_the_start() -> Verdict {
    for (own, section, words) in [
        (
            "disagreeing",
            "names = [\"robots.lab.example\"]",
            "accept_terms = true",
        ),
        (
            "wild",
            "names = [\"*.lab.example\"]\naccept_terms = true",
            "wildcards",
        ),
        (
            "displaced",
            "names = [\"robots.lab.example\"]\naccept_terms = true\nchallenge_listen = \"192.0.2.1:443\"",
            "challenge_listen in [tls.acme]",
        ),
    ] {
        let refused = world()
            .own(own)
            .config(&format!("[tls.acme]\n{section}\n"))
            .refuses_to_start()?;
        ensure!(refused.contains(words), "{words}: {refused}");
    }
    Ok(())
}
