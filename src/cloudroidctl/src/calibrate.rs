//! `calibrate`: measures which response times a service reaches at which limits, as rows of its dictionary.

pub(crate) mod curve;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use api::calibration::{Point, Source};
use api::dictionary::{NewRows, Row};
use api::{Calibration, CalibrationEvent, CalibrationOptions, Size};
use futures_util::StreamExt;
use http_body_util::{BodyExt, Full};
use hyper::Method;

use crate::client::{self, DaemonClient, percent_encode};
use crate::confirm;
use crate::output::{self, OutputFormat, Table, count};
use crate::terms_flags::aux;
use crate::trial::describe_renamed_topics;

/// Measure how fast a service answers recorded requests at several CPU limits, and propose entries of its SLA table.
///
/// Starts a servant of its own, which gives way to robots and is ended afterwards. The entries are written after
/// confirmation.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("material").required(true).args(["bag", "frames", "live"])))]
pub struct CalibrateArgs {
    /// Service to calibrate.
    service: String,
    /// Recording of the service's inputs: an uncompressed rosbag file, replayed at its own rate.
    #[arg(long, value_name = "FILE")]
    bag: Option<PathBuf>,
    /// Directory of images for the service's camera inputs: PNG files, in the order of their names.
    #[arg(long, value_name = "DIR")]
    frames: Option<PathBuf>,
    /// Use the requests of this connected robot, which is served as before and does not notice.
    #[arg(long, value_name = "ROBOT")]
    live: Option<String>,
    /// Longest time to collect a robot's requests, in seconds (default: 20).
    #[arg(long, value_name = "N", requires = "live")]
    seconds: Option<f64>,
    /// Largest amount of a robot's requests to collect, in bytes (default: 256M).
    #[arg(long, value_name = "BYTES", requires = "live")]
    bytes: Option<Size>,
    /// CPU limits to measure at, in cores, separated by commas (default: increasing limits until a higher one makes
    /// nothing faster).
    #[arg(long, value_name = "N,…", value_delimiter = ',')]
    cpus: Vec<f64>,
    /// Largest number of requests at each limit (default: 40).
    #[arg(long, value_name = "N")]
    requests: Option<usize>,
    /// Request rate in Hz (default: the recording's own).
    #[arg(long, value_name = "HZ", conflicts_with = "fast")]
    rate: Option<f64>,
    /// Send each request as soon as the previous one is answered; the default for images without --rate.
    #[arg(long)]
    fast: bool,
    /// Input whose messages are the requests (default: the recording's first topic that is an input).
    #[arg(long, value_name = "TOPIC")]
    input: Option<String>,
    /// Latency that the robots' network adds to each request, in milliseconds; measured with --live.
    #[arg(long, value_name = "MS")]
    network: Option<f64>,
    /// Auxiliary parameter of the entries, such as width=640; may be given several times.
    #[arg(long, value_name = "KEY=VALUE", value_parser = aux)]
    aux: Vec<(String, String)>,
    /// Output file of the curve (default: SERVICE-calibration.svg).
    #[arg(long, value_name = "FILE")]
    curve: Option<PathBuf>,
    /// Write the entries without asking for confirmation.
    #[arg(long)]
    yes: bool,
}

impl CalibrateArgs {
    /// Measures, prints the result and writes the rows if that is confirmed.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let body = self.read_material()?;
        let curve = self.curve.clone().unwrap_or_else(|| PathBuf::from(format!("{}-calibration.svg", self.service)));
        check_writable(&curve, "curve")?;
        let calibration = tokio::select! {
            measured = self.measure(client, format, body) => measured?,
            _ = tokio::signal::ctrl_c() => bail!("cancelled; nothing was written"),
        };
        // The result is printed even if the curve cannot be written.
        let drawn = fs::write(&curve, curve::draw(&calibration))
            .with_context(|| format!("cannot write the curve {}", curve.display()));
        match format {
            OutputFormat::Json => output::json_line(&calibration)?,
            OutputFormat::Table => print(&calibration, &curve)?,
        }
        if let Err(error) = drawn {
            eprintln!("warning: {error:#}");
        }
        if calibration.rows.is_empty() {
            return Ok(());
        }
        let say = |words: &str| match format {
            OutputFormat::Json => Ok(()),
            OutputFormat::Table => output::line(words),
        };
        if !self.yes && !confirm::ask(format!("write these entries to the SLA table of {}?", self.service)).await? {
            return say("nothing was written; --yes writes the entries without asking");
        }
        let rows = calibration.rows;
        let written = count(rows.len(), "entry");
        write_rows(client, &self.service, rows).await?;
        say(&format!("{written} written; see them with: cloudroidctl sla list {}", self.service))
    }

    /// Returns the body of the request: a recording, or the concatenated images.
    fn read_material(&self) -> anyhow::Result<Vec<u8>> {
        let read = |path: &Path| fs::read(path).with_context(|| format!("cannot read {}", path.display()));
        match (&self.bag, &self.frames) {
            (Some(path), _) => read(path),
            (None, Some(directory)) => {
                let mut body = Vec::new();
                for path in find_pictures(directory)? {
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

    async fn measure(&self, client: &DaemonClient, format: OutputFormat, body: Vec<u8>) -> anyhow::Result<Calibration> {
        let path = format!(
            "/api/v1/services/{}/calibration?options={}",
            percent_encode(&self.service),
            percent_encode(&serde_json::to_string(&self.options())?)
        );
        let body = Full::new(body.into()).map_err(|never| match never {}).boxed_unsync();
        let answer = client.send(Method::POST, &path, body).await?;
        let mut events = client::json_lines(answer);
        while let Some(event) = events.next().await {
            match event? {
                CalibrationEvent::Done { calibration } | CalibrationEvent::Kept { calibration, .. } => {
                    return Ok(*calibration);
                }
                CalibrationEvent::Error { problem } => return Err(problem.into()),
                event if format == OutputFormat::Json => output::json_line(&event)?,
                CalibrationEvent::Step { title } => output::line(&format!("== {title}"))?,
                CalibrationEvent::Measured { point, .. } => {
                    output::line(&format!("   {}", format_point(&point)))?;
                }
            }
        }
        bail!("the daemon aborted the calibration; nothing was written")
    }
}

/// Returns the PNG files of a directory, in the order of their names.
fn find_pictures(directory: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let reading = || format!("cannot read {}", directory.display());
    let mut found = Vec::new();
    for entry in fs::read_dir(directory).with_context(reading)? {
        let path = entry.with_context(reading)?.path();
        let is_png = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("png"));
        if is_png {
            found.push(path);
        }
    }
    if found.is_empty() {
        bail!("{} holds no .png file; convert pictures to PNG, or give a recording with --bag", directory.display());
    }
    found.sort();
    Ok(found)
}

pub(crate) fn format_point(point: &Point) -> String {
    match point.compute {
        Some(compute) => format!(
            "{} of {} answered: p50 {:.1} ms, p95 {:.1} ms",
            point.answered, point.requests, compute.p50, compute.p95
        ),
        None => format!("none of {} answered", point.requests),
    }
}

fn print(calibration: &Calibration, curve: &Path) -> anyhow::Result<()> {
    let mut table =
        Table::new(&["CPUS", "ANSWERED", "P50 MS", "P95 MS", "MAX MS", "RUNNING", "THROTTLED", "PER S", "MEMORY"]);
    for point in &calibration.points {
        let time = |of: fn(&api::calibration::TimeSpread) -> f64| {
            point.compute.as_ref().map_or("-".to_owned(), |compute| format!("{:.1}", of(compute)))
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
    for words in describe_renamed_topics(&calibration.inputs) {
        output::line(&words)?;
    }
    if !calibration.unused.is_empty() {
        output::line(&format!("not used: {}", calibration.unused.join(", ")))?;
    }
    if let Some(pace) = calibration.pace {
        output::line(&format!("sent {pace:.1} requests per second; limits that cannot keep up are not proposed"))?;
    }
    if let Some(network) = calibration.network {
        output::line(&format!("added for the network: p50 {:.1} ms, p95 {:.1} ms", network.p50, network.p95))?;
    }
    output::line(&format!(
        "largest request {}; peak memory {}, proposed with a margin of {} %",
        calibration.largest, calibration.memory_peak, calibration.memory_margin
    ))?;
    output::line(&format!("curve: {}", curve.display()))?;
    if calibration.rows.is_empty() {
        return output::line("no entry is proposed: no limit answered enough requests at the request rate");
    }
    output::line("")?;
    print_rows(&calibration.rows)
}

/// Writes rows to the dictionary of a service and returns all its rows.
pub(crate) async fn write_rows(client: &DaemonClient, service: &str, rows: Vec<Row>) -> anyhow::Result<Vec<Row>> {
    let new = NewRows { rows, replace: false };
    let path = format!("/api/v1/services/{}/sla", percent_encode(service));
    client.put(&path, &new).await
}

/// Checks that the output file of `option` can be written, before minutes are spent on measuring.
pub(crate) fn check_writable(curve: &Path, option: &str) -> anyhow::Result<()> {
    let new = !curve.exists();
    fs::OpenOptions::new().append(true).create(true).open(curve).with_context(|| {
        format!("cannot write the {option} to {}; name another file with --{option}", curve.display())
    })?;
    if new {
        let _ = fs::remove_file(curve);
    }
    Ok(())
}

/// Prints proposed rows.
pub(crate) fn print_rows(rows: &[Row]) -> anyhow::Result<()> {
    let mut table = Table::new(&["ENTRY", "CPUS", "MEMORY", "P50 MS", "P95 MS", "REQUESTS"]);
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
        let told = check_writable(&place.path().join("gone/curve.svg"), "curve").expect_err("no directory");
        assert!(format!("{told:#}").contains("--curve"), "{told:#}");
        let fine = place.path().join("curve.svg");
        check_writable(&fine, "curve").expect("it can be written");
        assert!(!fine.exists(), "nothing is left");
        fs::write(&fine, "an earlier one").expect("written");
        check_writable(&fine, "curve").expect("it can be written");
        assert_eq!(fs::read_to_string(&fine).expect("read"), "an earlier one");
    }

    #[test]
    fn pictures_come_in_the_order_of_their_names() {
        let directory = std::env::temp_dir().join(format!("calibrate-{}", std::process::id()));
        fs::create_dir_all(&directory).expect("a directory");
        let none = find_pictures(&directory).expect_err("none").to_string();
        assert!(none.contains("holds no .png file"), "{none}");
        for name in ["b.png", "a.PNG", "c.jpg"] {
            fs::write(directory.join(name), name).expect("a file");
        }
        let found = find_pictures(&directory);
        fs::remove_dir_all(&directory).expect("removed");
        let names: Vec<_> =
            found.expect("pictures").iter().filter_map(|path| path.file_name()?.to_str().map(str::to_owned)).collect();
        assert_eq!(names, ["a.PNG", "b.png"]);
    }
}
