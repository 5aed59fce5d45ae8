//! `pair`, `unpair`: pairing of robots, which have keys of their own.

use std::time::Duration;

use anyhow::{Context, bail};
use api::machines::{NewPairing, Pairing, PairingMade, PairingState};
use qrcode::render::unicode::Dense1x2;
use qrcode::{EcLevel, QrCode};

use crate::client::{DaemonClient, percent_encode};
use crate::output::{self, OutputFormat, Table};
use crate::token::{lifetime, parse_patterns};

/// Pair a robot: create a one-time line with which the robot makes its own key and obtains a certificate.
///
/// On the robot, run: cloudroid-stub pair 'LINE', or install.sh --pair 'LINE'. The certificate is renewed
/// automatically.
#[derive(Debug, clap::Args)]
pub struct PairArgs {
    /// Id of the robot.
    #[arg(required_unless_present = "list", conflicts_with = "list")]
    robot: Option<String>,
    /// Services that the robot may use, or patterns such as 'lab_*' (default: all).
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    services: Vec<String>,
    /// Class that the robot may name; may be given several times.
    #[arg(long = "class", value_name = "NAME")]
    classes: Vec<String>,
    /// Time for which the line is valid, such as 15m; at most 7d.
    #[arg(long, value_name = "TIME", value_parser = lifetime, default_value = "15m")]
    ttl: Duration,
    /// Address of the daemon for the robot, if it differs from the one used here.
    #[arg(long, value_name = "HOST:PORT")]
    address: Option<String>,
    /// Pair a robot that has a certificate of the lab's own authority (client_authorities) at once, without a line.
    #[arg(long)]
    own_certificate: bool,
    /// Do not print a QR code.
    #[arg(long)]
    no_qr: bool,
    /// List the paired robots and the pending lines.
    #[arg(long)]
    list: bool,
    /// Cancel the pending line of the robot.
    #[arg(long, conflicts_with_all = ["list", "own_certificate", "services", "address"])]
    cancel: bool,
}

/// Unpair a robot: its connections are closed and its certificate is refused.
#[derive(Debug, clap::Args)]
pub struct UnpairArgs {
    /// Id of the robot.
    robot: String,
}

impl PairArgs {
    /// Sends the request and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let Some(robot) = self.robot else {
            let pairings: Vec<Pairing> = client.get("/api/v1/pairings").await?;
            return list(&pairings, format);
        };
        if self.cancel {
            let path = format!("/api/v1/pairings/{}/code", percent_encode(&robot));
            let left: Vec<Pairing> = client.delete(&path).await?;
            return match format {
                OutputFormat::Json => output::json(&left),
                OutputFormat::Table => output::line(&format!("the pairing line for {robot} is no longer valid")),
            };
        }
        let services = if self.services.is_empty() { vec!["*".to_owned()] } else { self.services };
        let new = NewPairing {
            services: parse_patterns(&services)?,
            classes: parse_patterns(&self.classes)?,
            lifetime: Some(self.ttl.as_secs()),
            address: self.address,
            own_certificate: self.own_certificate,
            robot,
        };
        let made: PairingMade = client.post("/api/v1/pairings", &new).await?;
        print_pairing(&made, format, !self.no_qr)
    }
}

impl UnpairArgs {
    /// Sends the request and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let path = format!("/api/v1/pairings/{}", percent_encode(&self.robot));
        let left: Vec<Pairing> = client.delete(&path).await?;
        match format {
            OutputFormat::Json => output::json(&left),
            OutputFormat::Table => output::line(&format!(
                "{} is unpaired: its connections are closed, and its certificate is refused",
                self.robot
            )),
        }
    }
}

/// Prints only the line to standard output, so that it can be piped, and everything else to standard error.
fn print_pairing(made: &PairingMade, format: OutputFormat, qr: bool) -> anyhow::Result<()> {
    if let OutputFormat::Json = format {
        return output::json(made);
    }
    let robot = &made.robot;
    let (Some(line), Some(end)) = (&made.line, made.expires) else {
        return output::line(&format!(
            "{robot} is paired: it authenticates with its own certificate, named robot:{robot}"
        ));
    };
    if qr {
        output::eprint_line(&render_qr(line)?);
    }
    output::eprint_line(&format!(
        "this line pairs {robot} once, within {}; redeem it on the robot: cloudroid-stub pair 'LINE', or install.sh \
            --pair 'LINE'",
        output::time_until(end)
    ));
    output::line(line)
}

/// Renders a QR code (ISO/IEC 18004) with two modules per character. Light modules are drawn, because terminals are
/// dark.
fn render_qr(line: &str) -> anyhow::Result<String> {
    let code = QrCode::with_error_correction_level(line, EcLevel::L)
        .context("the line is too long for a QR code; leave it out with --no-qr")?;
    let picture = code.render::<Dense1x2>().dark_color(Dense1x2::Dark).light_color(Dense1x2::Light).build();
    if picture.is_empty() {
        bail!("the QR code is empty; leave it out with --no-qr");
    }
    Ok(picture)
}

fn list(pairings: &[Pairing], format: OutputFormat) -> anyhow::Result<()> {
    if let OutputFormat::Json = format {
        return output::json(&pairings);
    }
    let mut table = Table::new(&["ROBOT", "SERVICES", "CLASSES", "AGE", "CAME", "STATE"]);
    for pairing in pairings {
        table.row([
            pairing.robot.clone(),
            output::patterns(&pairing.services),
            output::patterns(&pairing.classes),
            output::age(pairing.created),
            output::last_use(pairing.last_used),
            state(pairing),
        ]);
    }
    if table.is_empty() {
        output::line("no robots are paired; pair one with: cloudroidctl pair ROBOT")
    } else {
        table.print()
    }
}

fn state(pairing: &Pairing) -> String {
    match (pairing.state, pairing.expires) {
        (PairingState::Waiting, Some(end)) => {
            format!("line not redeemed yet, expires in {}", output::time_until(end))
        }
        (PairingState::Waiting, None) => "line not redeemed yet".into(),
        (PairingState::Paired, _) if pairing.own_certificate => "paired, own certificate".into(),
        (PairingState::Paired, Some(end)) if output::is_past(end) => {
            format!("certificate expired {} ago", output::age(end))
        }
        (PairingState::Paired, Some(end)) => {
            format!("paired, certificate expires in {}", output::time_until(end))
        }
        (PairingState::Paired, None) => "paired".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_drawn_within_a_terminals_width() {
        let line = format!(
            "cloudroid://a-long-name-of-a-server.lab.example:9090/?robot=rover-number-1&fingerprint=SHA256:{}&key={}&\
             code={}",
            "5d".repeat(32),
            "A".repeat(68),
            "c".repeat(26)
        );
        let drawn = render_qr(&line).expect("drawn");
        let widest = drawn.lines().map(|line| line.chars().count()).max();
        assert!(widest.is_some_and(|width| (40..80).contains(&width)), "{widest:?}");
        render_qr(&"x".repeat(4000)).expect_err("too long");
    }
}
