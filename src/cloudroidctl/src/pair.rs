//! `pair`, `unpair`: robots that have a key of their own.

use std::time::Duration;

use anyhow::{Context, bail};
use api::machines::{NewPairing, Pairing, PairingMade, PairingState};
use qrcode::render::unicode::Dense1x2;
use qrcode::{EcLevel, QrCode};

use crate::client::{Client, escaped};
use crate::output::{self, Format, Table};
use crate::token::{lifetime, patterns};

/// Pair a robot: make a line that is good once, with which the robot makes its own key and gets a certificate.
///
/// Type the line on the robot: cloudroid-stub pair 'LINE', or install.sh --pair 'LINE'. The robot's certificate renews itself.
#[derive(Debug, clap::Args)]
pub struct Pair {
    /// The robot's name.
    #[arg(required_unless_present = "list", conflicts_with = "list")]
    robot: Option<String>,
    /// Services that it is for, or patterns such as 'lab_*'; all by default.
    #[arg(long, value_name = "A,B", value_delimiter = ',')]
    services: Vec<String>,
    /// Class of the configuration that it may name; may be given several times.
    #[arg(long = "class", value_name = "NAME")]
    classes: Vec<String>,
    /// How long the line is good, such as 15m; 7d at most.
    #[arg(long, value_name = "TIME", value_parser = lifetime, default_value = "15m")]
    ttl: Duration,
    /// Host and port by which the robot reaches the daemon, where the robot knows it by another name than you do.
    #[arg(long, value_name = "HOST:PORT")]
    address: Option<String>,
    /// The robot has a certificate of the lab's own authority (client_authorities): pair it at once, without a line.
    #[arg(long)]
    own_certificate: bool,
    /// Print no QR code.
    #[arg(long)]
    no_qr: bool,
    /// List robots that are paired, and those for which a line waits.
    #[arg(long)]
    list: bool,
    /// Take back the line that was made for the robot.
    #[arg(long, conflicts_with_all = ["list", "own_certificate", "services", "address"])]
    cancel: bool,
}

/// End a robot's pairing: its connections end at once, and its certificate is refused.
#[derive(Debug, clap::Args)]
pub struct Unpair {
    /// The robot's name.
    robot: String,
}

impl Pair {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let Some(robot) = self.robot else {
            let pairings: Vec<Pairing> = client.get("/api/v1/pairings").await?;
            return list(&pairings, format);
        };
        if self.cancel {
            let path = format!("/api/v1/pairings/{}/code", escaped(&robot));
            let left: Vec<Pairing> = client.delete(&path).await?;
            return match format {
                Format::Json => output::json(&left),
                Format::Table => output::line(&format!("the line for {robot} is good no more")),
            };
        }
        let services = match self.services.is_empty() {
            true => vec!["*".to_owned()],
            false => self.services,
        };
        let new = NewPairing {
            services: patterns(&services)?,
            classes: patterns(&self.classes)?,
            lifetime: Some(self.ttl.as_secs()),
            address: self.address,
            own_certificate: self.own_certificate,
            robot,
        };
        let made: PairingMade = client.post("/api/v1/pairings", &new).await?;
        told(&made, format, !self.no_qr)
    }
}

impl Unpair {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let path = format!("/api/v1/pairings/{}", escaped(&self.robot));
        let left: Vec<Pairing> = client.delete(&path).await?;
        match format {
            Format::Json => output::json(&left),
            Format::Table => output::line(&format!(
                "{} is unpaired: its connections are closed, and its certificate is refused",
                self.robot
            )),
        }
    }
}

/// The line alone on standard output, so that it can be taken from there; the rest beside it.
fn told(made: &PairingMade, format: Format, qr: bool) -> anyhow::Result<()> {
    if let Format::Json = format {
        return output::json(made);
    }
    let robot = &made.robot;
    let (Some(line), Some(end)) = (&made.line, made.expires) else {
        return output::line(&format!(
            "{robot} is paired: it comes with its own certificate, whose name is robot:{robot}"
        ));
    };
    if qr {
        output::complain(&picture(line)?);
    }
    output::complain(&format!(
        "this line pairs {robot}, once, within {}; on the robot: cloudroid-stub pair 'LINE', or install.sh --pair 'LINE'",
        output::until(end)
    ));
    output::line(line)
}

/// A QR code (ISO/IEC 18004), two modules in a character: light ones are drawn, as terminals are dark.
fn picture(line: &str) -> anyhow::Result<String> {
    let code = QrCode::with_error_correction_level(line, EcLevel::L)
        .context("the line is too long for a QR code; leave it out with --no-qr")?;
    let picture = code
        .render::<Dense1x2>()
        .dark_color(Dense1x2::Dark)
        .light_color(Dense1x2::Light)
        .build();
    if picture.is_empty() {
        bail!("the QR code is empty; leave it out with --no-qr");
    }
    Ok(picture)
}

fn list(pairings: &[Pairing], format: Format) -> anyhow::Result<()> {
    if let Format::Json = format {
        return output::json(&pairings);
    }
    let mut table = Table::new(&["ROBOT", "SERVICES", "CLASSES", "AGE", "CAME", "STATE"]);
    for pairing in pairings {
        let texts = |patterns: &[access::Glob]| match patterns {
            [] => "-".to_owned(),
            patterns => patterns
                .iter()
                .map(ToString::to_string)
                .collect::<Vec<_>>()
                .join(","),
        };
        table.row([
            pairing.robot.clone(),
            texts(&pairing.services),
            texts(&pairing.classes),
            output::age(pairing.created),
            pairing
                .last_used
                .map_or_else(|| "never".into(), |at| format!("{} ago", output::age(at))),
            state(pairing),
        ]);
    }
    match table.is_empty() {
        true => output::line("no robot is paired; pair one with: cloudroidctl pair ROBOT"),
        false => table.print(),
    }
}

fn state(pairing: &Pairing) -> String {
    match (pairing.state, pairing.expires) {
        (PairingState::Waiting, Some(end)) => format!("a line waits, for {}", output::until(end)),
        (PairingState::Waiting, None) => "a line waits".into(),
        (PairingState::Paired, _) if pairing.own_certificate => "paired, own certificate".into(),
        (PairingState::Paired, Some(end)) if output::is_past(end) => {
            format!("certificate expired {} ago", output::age(end))
        }
        (PairingState::Paired, Some(end)) => {
            format!("paired, certificate for {}", output::until(end))
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
            "cloudroid://a-long-name-of-a-server.lab.example:9090/?robot=rover-number-1&fingerprint=SHA256:{}&key={}&code={}",
            "5d".repeat(32),
            "A".repeat(68),
            "c".repeat(26)
        );
        let drawn = picture(&line).expect("drawn");
        let widest = drawn.lines().map(|line| line.chars().count()).max();
        assert!(
            widest.is_some_and(|width| (40..80).contains(&width)),
            "{widest:?}"
        );
        picture(&"x".repeat(4000)).expect_err("too long");
    }
}
