//! What TLS and the policy cost: a second daemon that speaks TLS, with a robot's token and the rules that are there from the
//! beginning, in turns with the first one, which has neither. The client encrypts and decrypts, too, on the same machine.

use std::net::TcpStream;
use std::process::Command;
use std::sync::Arc;

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use bench_servant::{Daemon, full};
use tokio_rustls::rustls::crypto::ring;
use tokio_rustls::rustls::pki_types::CertificateDer;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::{ClientConfig, ClientConnection, RootCertStore, StreamOwned};

use crate::contestants::{Course, Encoding, Way, message};
use crate::node::{Node, PATIENCE};
use crate::relay::Hops;
use crate::{CONFIG, rates, trips};

/// A client's end of TLS.
pub(crate) type Secure = StreamOwned<ClientConnection, TcpStream>;

/// What p50 may become.
const TIMES: f64 = 1.1;
const STRING: &str = "String there and back, TLS and policy";
const PICTURES: &str = "640x480 RGB out, cbor-raw, TLS and policy";

/// The token of the robot, where the daemon asks for one.
pub(crate) fn token(daemon: &Daemon) -> Result<Option<String>> {
    match std::fs::read_to_string(daemon.place().join("token")) {
        Ok(token) => Ok(Some(token.trim().to_owned())),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// TLS to a daemon, which shows the certificate in its home.
pub(crate) fn connect(daemon: &Daemon) -> Result<Secure> {
    let stream = TcpStream::connect(&daemon.address)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    let mut roots = RootCertStore::empty();
    let own = daemon.home().join("tls/own.pem");
    roots.add(CertificateDer::from_pem_file(own)?)?;
    let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
    let config = builder
        .with_safe_default_protocol_versions()?
        .with_root_certificates(roots)
        .with_no_client_auth();
    let connection = ClientConnection::new(Arc::new(config), "localhost".try_into()?)?;
    Ok(StreamOwned::new(connection, stream))
}

fn start() -> Result<(Daemon, Node)> {
    let place = tempfile::Builder::new()
        .prefix("cloudroid-bench-")
        .tempdir()?;
    let config = format!("{CONFIG}[tls]\nserve = \"tls\"\n");
    let daemon = Daemon::start(place, &config, &[])?;
    crate::push(&daemon)?;
    let made = daemon
        .ctl()?
        .args(["--format", "json", "token", "create", "bench"])
        .args(["--role", "robot", "--robot", "bench", "--service", "meter"])
        .output()?;
    let answer: serde_json::Value = serde_json::from_slice(&made.stdout)
        .with_context(|| String::from_utf8_lossy(&made.stderr).into_owned())?;
    let token = answer["secret"].as_str().context("a secret")?;
    std::fs::write(daemon.place().join("token"), token)?;
    let node = Node::find(&daemon)?;
    Ok((daemon, node))
}

/// Both figures.
pub(crate) fn measure(report: &mut Report, plain: &Daemon, node: &Node, only: &str) -> Result<()> {
    let (strings, pictures) = (STRING.contains(only), PICTURES.contains(only));
    if !strings && !pictures {
        return Ok(());
    }
    let (secure, behind) = start()?;
    let suite = suite(&secure)?;
    if strings {
        trip(report, [(plain, node), (&secure, &behind)], &suite)?;
    }
    if pictures {
        rate(report, [(plain, node), (&secure, &behind)], &suite)?;
    }
    Ok(())
}

/// The cipher suite that is agreed on.
fn suite(daemon: &Daemon) -> Result<String> {
    let mut stream = connect(daemon)?;
    stream.conn.complete_io(&mut stream.sock)?;
    let suite = stream.conn.negotiated_cipher_suite().context("a suite")?;
    Ok(format!("{:?}", suite.suite()))
}

type Ends<'a> = [(&'a Daemon, &'a Node); 2];

fn trip(report: &mut Report, ends: Ends<'_>, suite: &str) -> Result<()> {
    let hops = Hops {
        inward: Some("/meter/ping"),
        outward: Some("/meter/pong"),
        ..Hops::default()
    };
    let mut best = [[f64::MAX; 2]; 2];
    let rounds = if full() { 30 } else { 10 };
    for round in 1..=rounds {
        eprintln!("{STRING}: round {round} of {rounds}");
        for ((daemon, node), best) in ends.iter().zip(&mut best) {
            let course = Course { daemon, node, hops };
            let found = trips::turn(&course, Way::Daemon(Encoding::Json))?;
            for (best, found) in best.iter_mut().zip(found) {
                *best = best.min(found.as_secs_f64() * 1e6);
            }
        }
    }
    for (at, name) in ["p50", "p99"].iter().enumerate() {
        let figure = report.figure(format!("{STRING}, {name}"), "µs", best[1][at]);
        figure.beside("without both", best[0][at]);
        figure.note(format!("{suite}, at both ends"));
        if at == 0 {
            figure.reach(Target::RatioAtMost(TIMES));
        }
    }
    Ok(())
}

fn rate(report: &mut Report, ends: Ends<'_>, suite: &str) -> Result<()> {
    let topic = "/meter/image_out";
    let hops = Hops {
        images: true,
        outward: Some(topic),
        ..Hops::default()
    };
    let credits = [ends[0].1.credit(topic)?, ends[1].1.credit(topic)?];
    let mut best = [0.0_f64; 2];
    let rounds = if full() { 20 } else { 6 };
    let mut limit = 0.0_f64;
    for round in 1..=rounds {
        eprintln!("{PICTURES}: round {round} of {rounds}");
        limit = limit.max(openssl(suite)?);
        for (((daemon, node), credit), best) in ends.iter().zip(&credits).zip(&mut best) {
            let course = Course { daemon, node, hops };
            let (rate, _) = rates::outward(&course, Way::Daemon(Encoding::Raw), credit)?;
            *best = best.max(rate);
        }
    }
    let figure = report.figure(PICTURES, "/s", best[1]);
    figure.beside("without both", best[0]);
    // Bytes are encrypted at one end and decrypted at the other.
    let ciphers = 2e6 * message(true).len() as f64 / limit;
    let added = 1e6 / best[1] - 1e6 / best[0];
    let figure = report.figure(format!("{PICTURES}, added to each"), "µs", added);
    figure.beside(format!("openssl speed, {}, twice", cipher(suite)), ciphers);
    figure.note(format!("both ends are on this machine; {suite}"));
    figure.reach(Target::RatioAtMost(1.0));
    Ok(())
}

/// openssl's name of what a suite encrypts with.
fn cipher(suite: &str) -> &'static str {
    match suite {
        suite if suite.contains("AES_128") => "aes-128-gcm",
        suite if suite.contains("AES_256") => "aes-256-gcm",
        _ => "chacha20-poly1305",
    }
}

/// Bytes that openssl encrypts in a second on one core, in records of TLS's greatest size.
fn openssl(suite: &str) -> Result<f64> {
    let said = Command::new("openssl")
        .args(["speed", "-elapsed", "-seconds", "1", "-bytes", "16384"])
        .args(["-evp", cipher(suite)])
        .output()
        .context("openssl speed")?;
    ensure!(
        said.status.success(),
        "{}",
        String::from_utf8_lossy(&said.stderr)
    );
    let text = String::from_utf8_lossy(&said.stdout);
    let thousands = text
        .split_whitespace()
        .last()
        .and_then(|word| word.strip_suffix('k'))
        .with_context(|| format!("its last word is a rate: {text}"))?;
    Ok(thousands.parse::<f64>()? * 1000.0)
}
