//! `calibrate`: what response times cost, measured, as rows of the dictionary.

pub(crate) mod curve;

use std::fs;
use std::io::{BufRead, IsTerminal, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use api::calibration::{Point, Source};
use api::dictionary::{NewRows, Row};
use api::{Calibration, CalibrationEvent, CalibrationOptions, Size};
use futures_util::StreamExt;
use http_body_util::{BodyExt, Full};
use hyper::Method;

use crate::client::{self, Client, escaped};
use crate::output::{self, Format, Table};
use crate::stated::aux;
use crate::trial::renamed;

/// Measure how fast a service answers recorded requests at several limits, and propose rows of its dictionary.
///
/// A servant of its own is started, gives way to robots, and is ended afterwards. Rows are written when you say yes.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("material").required(true).args(["bag", "frames", "live"])))]
pub struct Calibrate {
    /// The service.
    service: String,
    /// A recording of its inputs: a rosbag file, not compressed. It is replayed at its own pace.
    #[arg(long, value_name = "FILE")]
    bag: Option<PathBuf>,
    /// A directory of pictures for its camera inputs: PNG files, in the order of their names.
    #[arg(long, value_name = "DIR")]
    frames: Option<PathBuf>,
    /// Take what this connected robot sends now; it is answered as before, and hears nothing of this.
    #[arg(long, value_name = "ROBOT")]
    live: Option<String>,
    /// Seconds for which a robot's requests are taken, at most; 20 by default.
    #[arg(long, value_name = "N", requires = "live")]
    seconds: Option<f64>,
    /// Bytes of a robot's requests, at most; 256M by default.
    #[arg(long, value_name = "BYTES", requires = "live")]
    bytes: Option<Size>,
    /// Limits to measure at, in cores, separated by commas; by default ever larger ones, until more makes nothing faster.
    #[arg(long, value_name = "N,…", value_delimiter = ',')]
    cpus: Vec<f64>,
    /// Requests at each limit, at most; 40 by default.
    #[arg(long, value_name = "N")]
    requests: Option<usize>,
    /// Requests a second, instead of the recording's own pace.
    #[arg(long, value_name = "HZ", conflicts_with = "fast")]
    rate: Option<f64>,
    /// Each request follows the last answer at once, as pictures do without --rate.
    #[arg(long)]
    fast: bool,
    /// The input whose messages are the requests; by default the recording's first topic that is an input.
    #[arg(long, value_name = "TOPIC")]
    input: Option<String>,
    /// Milliseconds that robots' networks add to each request; with --live it is measured.
    #[arg(long, value_name = "MS")]
    network: Option<f64>,
    /// Auxiliary parameter of the rows, such as width=640; may be given several times.
    #[arg(long, value_name = "KEY=VALUE", value_parser = aux)]
    aux: Vec<(String, String)>,
    /// Where to draw the curve; SERVICE-calibration.svg by default.
    #[arg(long, value_name = "FILE")]
    curve: Option<PathBuf>,
    /// Write the rows without asking.
    #[arg(long)]
    yes: bool,
}

impl Calibrate {
    /// Measures, shows, asks, writes.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let body = self.body()?;
        let curve = self
            .curve
            .clone()
            .unwrap_or_else(|| PathBuf::from(format!("{}-calibration.svg", self.service)));
        check_place(&curve, "curve")?;
        let calibration = tokio::select! {
            measured = self.measure(client, format, body) => measured?,
            _ = tokio::signal::ctrl_c() => bail!("cancelled; nothing was written"),
        };
        // What was measured is shown all the same.
        let drawn = fs::write(&curve, curve::draw(&calibration))
            .with_context(|| format!("cannot write the curve {}", curve.display()));
        match format {
            Format::Json => output::json_line(&calibration)?,
            Format::Table => print(&calibration, &curve)?,
        }
        if let Err(error) = drawn {
            eprintln!("warning: {error:#}");
        }
        if calibration.rows.is_empty() {
            return Ok(());
        }
        let say = |words: &str| match format {
            Format::Json => Ok(()),
            Format::Table => output::line(words),
        };
        if !self.yes && !agrees(&self.service)? {
            return say("nothing was written; --yes writes the rows without asking");
        }
        let rows = calibration.rows;
        let count = rows.len();
        write(client, &self.service, rows).await?;
        say(&format!(
            "{count} rows written; see them with: cloudroidctl sla list {}",
            self.service
        ))
    }

    /// What is sent: a recording, or pictures one behind the other.
    fn body(&self) -> anyhow::Result<Vec<u8>> {
        let read =
            |path: &Path| fs::read(path).with_context(|| format!("cannot read {}", path.display()));
        match (&self.bag, &self.frames) {
            (Some(path), _) => read(path),
            (None, Some(directory)) => {
                let mut body = Vec::new();
                for path in pictures(directory)? {
                    body.extend(read(&path)?);
                }
                Ok(body)
            }
            (None, None) => Ok(Vec::new()),
        }
    }

    fn options(&self) -> CalibrationOptions {
        CalibrationOptions {
            source: match (&self.bag, &self.frames) {
                (Some(_), _) => Source::Bag,
                (None, Some(_)) => Source::Frames,
                (None, None) => Source::Live,
            },
            robot: self.live.clone(),
            seconds: self.seconds,
            bytes: self.bytes,
            cpus: self.cpus.clone(),
            requests: self.requests,
            rate: self.rate,
            fast: self.fast,
            input: self.input.clone(),
            network: self.network,
            aux: self.aux.iter().cloned().collect(),
            ..CalibrationOptions::default()
        }
    }

    async fn measure(
        &self,
        client: &Client,
        format: Format,
        body: Vec<u8>,
    ) -> anyhow::Result<Calibration> {
        let path = format!(
            "/api/v1/services/{}/calibration?options={}",
            escaped(&self.service),
            escaped(&serde_json::to_string(&self.options())?)
        );
        let body = Full::new(body.into())
            .map_err(|never| match never {})
            .boxed_unsync();
        let answer = client.send(Method::POST, &path, body).await?;
        let mut events = client::lines(answer);
        while let Some(event) = events.next().await {
            match event? {
                CalibrationEvent::Done { calibration }
                | CalibrationEvent::Kept { calibration, .. } => return Ok(*calibration),
                CalibrationEvent::Error { problem } => return Err(problem.into()),
                event if format == Format::Json => output::json_line(&event)?,
                CalibrationEvent::Step { title } => output::line(&format!("== {title}"))?,
                CalibrationEvent::Measured { point, .. } => {
                    output::line(&format!("   {}", in_a_line(&point)))?;
                }
            }
        }
        bail!("the daemon broke off the calibration; nothing was written")
    }
}

/// PNG files of a directory, in the order of their names.
fn pictures(directory: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let reading = || format!("cannot read {}", directory.display());
    let mut found = Vec::new();
    for entry in fs::read_dir(directory).with_context(reading)? {
        let path = entry.with_context(reading)?.path();
        let is_png = path
            .extension()
            .is_some_and(|ending| ending.eq_ignore_ascii_case("png"));
        if is_png {
            found.push(path);
        }
    }
    if found.is_empty() {
        bail!(
            "{} holds no .png file; convert pictures to PNG, or give a recording with --bag",
            directory.display()
        );
    }
    found.sort();
    Ok(found)
}

pub(crate) fn in_a_line(point: &Point) -> String {
    match point.compute {
        Some(compute) => format!(
            "{} of {} answered: {:.1} ms (median), {:.1} ms (95 %)",
            point.answered, point.requests, compute.p50, compute.p95
        ),
        None => format!("none of {} answered", point.requests),
    }
}

fn print(calibration: &Calibration, curve: &Path) -> anyhow::Result<()> {
    let mut table = Table::new(&[
        "CPUS", "ANSWERED", "P50 MS", "P95 MS", "MAX MS", "RUNNING", "HELD UP", "PER S", "MEMORY",
    ]);
    for point in &calibration.points {
        let time = |of: fn(&api::calibration::TimeSpread) -> f64| {
            point
                .compute
                .as_ref()
                .map_or("-".to_owned(), |compute| format!("{:.1}", of(compute)))
        };
        table.row([
            point.cpus.to_string(),
            format!("{} of {}", point.answered, point.requests),
            time(|compute| compute.p50),
            time(|compute| compute.p95),
            time(|compute| compute.max),
            format!("{:.1}", point.running),
            format!("{:.1}", point.throttled),
            format!("{:.1}", point.rate),
            point.memory.to_string(),
        ]);
    }
    output::line("")?;
    table.print()?;
    output::line(&format!("ended: {}", calibration.ended))?;
    for words in renamed(&calibration.inputs) {
        output::line(&words)?;
    }
    if !calibration.unused.is_empty() {
        output::line(&format!("not used: {}", calibration.unused.join(", ")))?;
    }
    if let Some(pace) = calibration.pace {
        output::line(&format!(
            "asked for {pace:.1} requests a second; limits that do not keep it are not proposed"
        ))?;
    }
    if let Some(network) = calibration.network {
        output::line(&format!(
            "added for the network: {:.1} ms (median), {:.1} ms (95 %)",
            network.p50, network.p95
        ))?;
    }
    output::line(&format!(
        "largest request {}; memory at most {}, proposed with {} % more",
        calibration.largest, calibration.memory_peak, calibration.memory_margin
    ))?;
    output::line(&format!("curve: {}", curve.display()))?;
    if calibration.rows.is_empty() {
        return output::line(
            "no row is proposed: at no limit were enough requests answered at the asked pace",
        );
    }
    output::line("")?;
    rows(&calibration.rows)
}

/// Writes rows into the dictionary of a service; all rows that it has then.
pub(crate) async fn write(
    client: &Client,
    service: &str,
    rows: Vec<Row>,
) -> anyhow::Result<Vec<Row>> {
    let new = NewRows {
        rows,
        replace: false,
    };
    let path = format!("/api/v1/services/{}/sla", escaped(service));
    client.put(&path, &new).await
}

/// Refuses a place for the picture of this option that cannot be written to, before minutes of measuring.
pub(crate) fn check_place(curve: &Path, option: &str) -> anyhow::Result<()> {
    let new = !curve.exists();
    fs::OpenOptions::new()
        .append(true)
        .create(true)
        .open(curve)
        .with_context(|| {
            format!(
                "the {option} cannot be written to {}; name another place with --{option}",
                curve.display()
            )
        })?;
    if new {
        let _ = fs::remove_file(curve);
    }
    Ok(())
}

/// Whether whoever sits at the terminal says yes; nobody does where there is none.
pub(crate) fn agrees(service: &str) -> anyhow::Result<bool> {
    if !std::io::stdin().is_terminal() {
        return Ok(false);
    }
    let mut out = std::io::stderr().lock();
    write!(
        out,
        "write these rows to the dictionary of {service}? [y/N] "
    )?;
    out.flush()?;
    let mut answer = String::new();
    std::io::stdin().lock().read_line(&mut answer)?;
    Ok(is_yes(&answer))
}

fn is_yes(answer: &str) -> bool {
    matches!(answer.trim().to_ascii_lowercase().as_str(), "y" | "yes")
}

/// Proposed rows.
pub(crate) fn rows(rows: &[Row]) -> anyhow::Result<()> {
    let mut table = Table::new(&["ROW", "CPUS", "MEMORY", "P50 MS", "P95 MS", "REQUESTS"]);
    for row in rows {
        let shown = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
        let time = |time: f64| format!("{:.1}", time * 1000.0);
        table.row([
            row.to_string(),
            shown(row.limits.cpus.map(|cpus| cpus.to_string())),
            shown(row.limits.memory.map(|memory| memory.to_string())),
            shown(row.spread.map(|spread| time(spread.p50))),
            shown(row.spread.map(|spread| time(spread.p95))),
            shown(row.spread.map(|spread| spread.requests.to_string())),
        ]);
    }
    table.print()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_that_cannot_be_written_is_told_before_measuring() {
        let place = tempfile::tempdir().expect("a directory");
        let told =
            check_place(&place.path().join("gone/curve.svg"), "curve").expect_err("no directory");
        assert!(format!("{told:#}").contains("--curve"), "{told:#}");
        let fine = place.path().join("curve.svg");
        check_place(&fine, "curve").expect("it can be written");
        assert!(!fine.exists(), "nothing is left");
        fs::write(&fine, "an earlier one").expect("written");
        check_place(&fine, "curve").expect("it can be written");
        assert_eq!(fs::read_to_string(&fine).expect("read"), "an earlier one");
    }

    #[test]
    fn only_a_yes_is_a_yes() {
        for (answer, yes) in [
            ("y\n", true),
            ("Yes\n", true),
            ("\n", false),
            ("", false),
            ("yep", false),
        ] {
            assert_eq!(is_yes(answer), yes, "{answer:?}");
        }
    }

    #[test]
    fn pictures_come_in_the_order_of_their_names() {
        let directory = std::env::temp_dir().join(format!("calibrate-{}", std::process::id()));
        fs::create_dir_all(&directory).expect("a directory");
        let none = pictures(&directory).expect_err("none").to_string();
        assert!(none.contains("holds no .png file"), "{none}");
        for name in ["b.png", "a.PNG", "c.jpg"] {
            fs::write(directory.join(name), name).expect("a file");
        }
        let found = pictures(&directory);
        fs::remove_dir_all(&directory).expect("removed");
        let names: Vec<_> = found
            .expect("pictures")
            .iter()
            .filter_map(|path| path.file_name()?.to_str().map(str::to_owned))
            .collect();
        assert_eq!(names, ["a.PNG", "b.png"]);
    }
}
