//! `shadow`: compares the answers of another revision with those of the one that a robot uses.

use anyhow::bail;
use api::calibration::TimeSpread;
use api::shadow::{Compared, Shadow as Found, ShadowEvent, ShadowOptions};
use futures_util::StreamExt;
use hyper::Method;

use crate::client::{self, DaemonClient, json_body, percent_encode};
use crate::output::{self, OutputFormat, Table, count};

/// Number of fields that are printed for each topic, service and action.
const FIELDS: usize = 8;

/// Shadow a robot's servant with a candidate of another revision: send it the same requests, and report differences.
///
/// The candidate is a servant of its own, which is started now and ended afterwards. The robot is served as before and
/// gets no answers of the candidate. A robot that needs the candidate's capacity gets it.
#[derive(Debug, clap::Args)]
pub struct ShadowArgs {
    /// Service to compare.
    service: String,
    /// Revision of the candidate.
    revision: u64,
    /// Robot whose requests are used (default: the first one that uses the service).
    #[arg(long)]
    robot: Option<String>,
    /// Longest duration in seconds (default: 60).
    #[arg(long, value_name = "N")]
    seconds: Option<f64>,
    /// Number of messages, calls and goals after which the comparison ends.
    #[arg(long, value_name = "N")]
    requests: Option<u64>,
    /// Largest difference at which two numbers count as equal (default: 0.000001); unless both are integers, it is
    /// multiplied by the greater magnitude if that is above 1.
    #[arg(long, value_name = "NUMBER")]
    tolerance: Option<f64>,
    /// Field that may differ, such as pose.covariance or detections[].id; may be given several times.
    #[arg(long, value_name = "FIELD")]
    ignore: Vec<String>,
    /// Allowed relative increase of the candidate's p50 response time (default: 0.1).
    #[arg(long, value_name = "PART")]
    bound: Option<f64>,
    /// Let the candidate use the hosts and devices granted to its revision, although the robot's servant uses them,
    /// too.
    #[arg(long)]
    acting: bool,
}

impl ShadowArgs {
    /// Runs the comparison and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let found = tokio::select! {
            found = self.compare(client, format) => found?,
            _ = tokio::signal::ctrl_c() => bail!("cancelled; the candidate was ended"),
        };
        match format {
            OutputFormat::Json => output::json_line(&found),
            OutputFormat::Table => print(&found),
        }
    }

    fn options(&self) -> ShadowOptions {
        let of = ShadowOptions::default();
        ShadowOptions {
            revision: self.revision,
            robot: self.robot.clone(),
            seconds: self.seconds.unwrap_or(of.seconds),
            requests: self.requests,
            tolerance: self.tolerance.unwrap_or(of.tolerance),
            ignore: self.ignore.clone(),
            bound: self.bound.unwrap_or(of.bound),
            acting: self.acting,
        }
    }

    async fn compare(&self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<Found> {
        let path = format!("/api/v1/services/{}/shadow", percent_encode(&self.service));
        let answer = client.send(Method::POST, &path, json_body(&self.options())?).await?;
        let mut events = client::json_lines(answer);
        while let Some(event) = events.next().await {
            match event? {
                ShadowEvent::Done { shadow } => return Ok(*shadow),
                ShadowEvent::Error { problem } => return Err(problem.into()),
                event if format == OutputFormat::Json => output::json_line(&event)?,
                ShadowEvent::Step { title } => output::line(&format!("== {title}"))?,
            }
        }
        bail!("the daemon aborted the comparison")
    }
}

fn print(found: &Found) -> anyhow::Result<()> {
    for line in summary(found) {
        output::line(&line)?;
    }
    if !found.compared.is_empty() {
        output::line("")?;
        table(&found.compared).print()?;
    }
    for row in found.compared.iter().filter(|row| !row.fields.is_empty()) {
        output::line("")?;
        for line in fields(found, row) {
            output::line(&line)?;
        }
    }
    if found.not_compared.is_empty() {
        return Ok(());
    }
    output::line("\nnot compared")?;
    for note in &found.not_compared {
        let times = match note.count {
            0 => String::new(),
            times => format!(" ({})", count(times, "time")),
        };
        output::line(&format!("  {}: {}{times}", note.what, note.why))?;
    }
    Ok(())
}

fn summary(found: &Found) -> [String; 2] {
    [
        format!(
            "revision {} of {} beside revision {}, with {} of robot {} in {:.1} s ({})",
            found.candidate,
            found.service,
            found.revision,
            count(found.given, "request"),
            found.robot,
            found.seconds,
            found.ended
        ),
        format!("{}: {}", found.verdict, found.why),
    ]
}

fn table(rows: &[Compared]) -> Table {
    let mut table =
        Table::new(&["KIND", "NAME", "EQUAL", "DIFFERENT", "MISSING", "SURPLUS", "P50/P95 MS", "CANDIDATE"]);
    for row in rows {
        table.row([
            row.kind.to_string(),
            row.name.clone(),
            row.equal.to_string(),
            row.different.to_string(),
            row.missing.to_string(),
            row.surplus.to_string(),
            times(row.present.as_ref()),
            times(row.candidate.as_ref()),
        ]);
    }
    table
}

fn times(times: Option<&TimeSpread>) -> String {
    times.map_or("-".to_owned(), |times| format!("{:.1}/{:.1}", times.p50, times.p95))
}

/// Returns the differing fields of a topic, service or action as lines.
fn fields(found: &Found, row: &Compared) -> Vec<String> {
    let mut lines = vec![format!("{} differs in", row.name)];
    for field in row.fields.iter().take(FIELDS) {
        let name = match field.field.as_str() {
            "" => "the whole",
            name => name,
        };
        lines.push(format!(
            "  {name}, in {}: {} of revision {}, {} of revision {}",
            count(field.answers, "answer"),
            field.present,
            found.revision,
            field.candidate,
            found.candidate
        ));
    }
    let more = row.fields.len().saturating_sub(FIELDS);
    if more > 0 {
        lines.push(format!("  and {more} more; --format json lists all"));
    }
    lines
}

#[cfg(test)]
mod tests {
    use api::shadow::{FieldDifference, Verdict};

    use super::*;

    #[test]
    fn what_differs_is_told_by_its_name_with_both_values() {
        let field = |name: &str| FieldDifference {
            field: name.into(),
            answers: 2,
            present: "3".into(),
            candidate: "103".into(),
        };
        let row = Compared {
            name: "/add_two".into(),
            different: 2,
            fields: (0..10).map(|number| field(&format!("f{number}"))).collect(),
            ..Compared::default()
        };
        let found = Found {
            service: "adder".into(),
            robot: "r1".into(),
            revision: 1,
            candidate: 2,
            verdict: Verdict::Different,
            why: "2 of 2 answers differ: /add_two".into(),
            ended: "its time is up".into(),
            given: 2,
            ..Found::default()
        };
        let lines = fields(&found, &row);
        assert_eq!(lines.len(), 10);
        assert_eq!(lines[1], "  f0, in 2 answers: 3 of revision 1, 103 of revision 2");
        assert!(lines[9].contains("2 more"), "{lines:?}");
        let whole = Compared { fields: vec![field("")], ..row };
        assert!(fields(&found, &whole)[1].starts_with("  the whole, in 2 answers"));
        assert!(summary(&found)[0].contains("with 2 requests of robot r1"));
        assert!(summary(&found)[1].starts_with("different: 2 of 2"));
        assert_eq!(times(None), "-");
    }
}
