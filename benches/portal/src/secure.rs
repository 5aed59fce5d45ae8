//! Cost of TLS and the policy: a second daemon with TLS, a robot's token and the default rules, in turns with the
//! first.

use std::process::Command;

use anyhow::{Context, Result, ensure};
use bench_report::{BenchDaemon, BenchReport, Target, is_full_run};

use crate::contestants::{ClientPath, Encoding, PathTarget, serialize_message};
use crate::node::MeterNode;
use crate::relay::RelayHops;
use crate::setup::{CONFIG, fixture_path, push_meter};
use crate::tls::connect;
use crate::turns::take_turns;
use crate::{rates, trips};

/// Limit for p50, as a multiple of the plain daemon's.
const TIMES: f64 = 1.1;
const STRING: &str = "String there and back, TLS and policy";
const PICTURES: &str = "640x480 RGB out, cbor-raw, TLS and policy";

fn start_tls_daemon() -> Result<(BenchDaemon, MeterNode)> {
    let daemon = BenchDaemon::start(&format!("{CONFIG}[tls]\nserve = \"tls\"\n"))?;
    push_meter(&daemon, &fixture_path(), &[])?;
    let create = ["token", "create", "bench", "--role", "robot"];
    let rights = ["--robot", "bench", "--service", "meter"];
    let answer = daemon.deployer().run_json(&[&create[..], &rights].concat())?;
    let token = answer["secret"].as_str().context("a secret")?;
    std::fs::write(daemon.directory().join("token"), token)?;
    let node = MeterNode::find(&daemon)?;
    Ok((daemon, node))
}

/// Measures both figures.
pub(crate) fn measure(report: &mut BenchReport, plain: &BenchDaemon, node: &MeterNode, only: &str) -> Result<()> {
    let (strings, pictures) = (STRING.contains(only), PICTURES.contains(only));
    if !strings && !pictures {
        return Ok(());
    }
    let (secure, behind) = start_tls_daemon()?;
    let suite = negotiated_suite(&secure)?;
    if strings {
        measure_trips(report, [(plain, node), (&secure, &behind)], &suite)?;
    }
    if pictures {
        measure_rate(report, [(plain, node), (&secure, &behind)], &suite)?;
    }
    Ok(())
}

/// Returns the negotiated cipher suite.
fn negotiated_suite(daemon: &BenchDaemon) -> Result<String> {
    let mut stream = connect(daemon)?;
    stream.conn.complete_io(&mut stream.sock)?;
    let suite = stream.conn.negotiated_cipher_suite().context("a suite")?;
    Ok(format!("{:?}", suite.suite()))
}

type DaemonPair<'a> = [(&'a BenchDaemon, &'a MeterNode); 2];

fn measure_trips(report: &mut BenchReport, ends: DaemonPair<'_>, suite: &str) -> Result<()> {
    let hops = RelayHops { inward: Some("/meter/ping"), outward: Some("/meter/pong"), ..RelayHops::default() };
    let mut best = ends.map(|(daemon, node)| (PathTarget { daemon, node, hops }, [f64::INFINITY; 2]));
    take_turns(STRING, if is_full_run() { 30 } else { 10 }, &mut best, |(course, best)| {
        *best = trips::lower_of(*best, trips::measure_turn(course, ClientPath::Daemon(Encoding::Json))?);
        Ok(())
    })?;
    for (at, name) in ["p50", "p99"].iter().enumerate() {
        let figure = report.figure(format!("{STRING}, {name}"), "µs", best[1].1[at]);
        figure.relative_to("without both", best[0].1[at]);
        figure.note(format!("{suite}, at both ends"));
        if at == 0 {
            figure.require(Target::RatioAtMost(TIMES));
        }
    }
    Ok(())
}

fn measure_rate(report: &mut BenchReport, ends: DaemonPair<'_>, suite: &str) -> Result<()> {
    let topic = "/meter/image_out";
    let hops = RelayHops { images: true, outward: Some(topic), ..RelayHops::default() };
    let mut turns = Vec::new();
    for (daemon, node) in ends {
        turns.push((PathTarget { daemon, node, hops }, node.credit(topic)?, 0.0_f64));
    }
    let mut limit = 0.0_f64;
    take_turns(PICTURES, if is_full_run() { 20 } else { 6 }, &mut turns, |(course, credit, best)| {
        limit = limit.max(openssl_speed(suite)?);
        let (rate, _) = rates::measure_outward(course, ClientPath::Daemon(Encoding::Raw), credit)?;
        *best = best.max(rate);
        Ok(())
    })?;
    let (plain, secure) = (turns[0].2, turns[1].2);
    report.figure(PICTURES, "/s", secure).relative_to("without both", plain);
    // Bytes are encrypted at one end and decrypted at the other.
    let ciphers = 2e6 * serialize_message(true).len() as f64 / limit;
    let figure = report.figure(format!("{PICTURES}, added to each"), "µs", 1e6 / secure - 1e6 / plain);
    figure.relative_to(format!("openssl speed, {}, twice", openssl_cipher(suite)), ciphers);
    figure.note(format!("both ends are on this machine; {suite}")).require(Target::RatioAtMost(1.0));
    Ok(())
}

/// Returns openssl's name of the cipher of a suite.
fn openssl_cipher(suite: &str) -> &'static str {
    match suite {
        suite if suite.contains("AES_128") => "aes-128-gcm",
        suite if suite.contains("AES_256") => "aes-256-gcm",
        _ => "chacha20-poly1305",
    }
}

/// Returns the bytes per second that openssl encrypts on one core, in TLS records of maximum size.
fn openssl_speed(suite: &str) -> Result<f64> {
    let said = Command::new("openssl")
        .args(["speed", "-elapsed", "-seconds", "1", "-bytes", "16384"])
        .args(["-evp", openssl_cipher(suite)])
        .output()
        .context("openssl speed")?;
    ensure!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    let text = String::from_utf8_lossy(&said.stdout);
    let thousands = text
        .split_whitespace()
        .last()
        .and_then(|word| word.strip_suffix('k'))
        .with_context(|| format!("its last word is a rate: {text}"))?;
    Ok(thousands.parse::<f64>()? * 1000.0)
}
