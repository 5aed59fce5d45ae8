//! `sla`: a service's dictionary, which maps what robots state to resources.

use std::collections::BTreeMap;

use anyhow::bail;
use api::dictionary::{Explained, NewRows, Row, Spread};
use api::sla::ParseValueError;
use api::{Limits, Measure};

use crate::client::{DaemonClient, percent_encode};
use crate::output::{self, OutputFormat, Table};
use crate::terms_flags::{StatedFlags, aux, to_query, unique_aux};

/// Manage the SLA table of a service, which maps SLAs to resources: list, set, remove and explain its entries.
#[derive(Debug, clap::Args)]
pub struct SlaArgs {
    #[command(subcommand)]
    verb: SlaCommand,
}

#[derive(Debug, clap::Subcommand)]
enum SlaCommand {
    List(ListRows),
    Set(SetRow),
    Rm(RemoveRows),
    Explain(ExplainRow),
}

/// List the entries of a service's SLA table.
#[derive(Debug, clap::Args)]
struct ListRows {
    /// Service of the table.
    service: String,
}

/// Set an entry: with these limits, a servant reaches this value. Replaces an entry with the same value and auxiliary
/// parameters.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("value").required(true).args(["rrt", "fps", "age"])))]
struct SetRow {
    /// Service of the table.
    service: String,
    /// Response time that is reached, such as 100ms.
    #[arg(long, value_name = "TIME", value_parser = rrt, allow_hyphen_values = true)]
    rrt: Option<f64>,
    /// Frame rate that is reached, in Hz.
    #[arg(long, value_name = "RATE", value_parser = fps, allow_hyphen_values = true)]
    fps: Option<f64>,
    /// Age of an output that is reached, such as 500ms.
    #[arg(long, value_name = "TIME", value_parser = age, allow_hyphen_values = true)]
    age: Option<f64>,
    /// Auxiliary parameter for which the entry holds, up to this value for a number; may be given several times.
    #[arg(long = "aux", value_name = "KEY=VALUE", value_parser = aux)]
    aux: Vec<(String, String)>,
    #[command(flatten)]
    limits: Limits,
    /// Measurement of the entry: p50, p95 and number of requests, such as 80ms,95ms,200.
    #[arg(long, value_name = "P50,P95,N")]
    spread: Option<String>,
}

/// Remove entries by their ids.
#[derive(Debug, clap::Args)]
struct RemoveRows {
    /// Service of the table.
    service: String,
    /// Ids of entries, as shown by `sla list`.
    #[arg(required = true)]
    rows: Vec<i64>,
}

/// Explain which entry a robot with these requests would get, why, and which entries come next.
#[derive(Debug, clap::Args)]
struct ExplainRow {
    /// Service of the table.
    service: String,
    #[command(flatten)]
    stated: StatedFlags,
}

fn rrt(text: &str) -> Result<f64, ParseValueError> {
    Measure::Rrt.parse_value(text)
}

fn fps(text: &str) -> Result<f64, ParseValueError> {
    Measure::Fps.parse_value(text)
}

fn age(text: &str) -> Result<f64, ParseValueError> {
    Measure::Age.parse_value(text)
}

impl SlaArgs {
    /// Sends the requests and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        match self.verb {
            SlaCommand::List(verb) => {
                let rows: Vec<Row> = client.get(&sla_path(&verb.service, "")).await?;
                list(&verb.service, &rows, format)
            }
            SlaCommand::Set(verb) => {
                let new = NewRows { rows: vec![verb.row()?], replace: false };
                let rows: Vec<Row> = client.put(&sla_path(&verb.service, ""), &new).await?;
                list(&verb.service, &rows, format)
            }
            SlaCommand::Rm(verb) => {
                let mut left: Vec<Row> = client.get(&sla_path(&verb.service, "")).await?;
                let gone = |row: &&i64| !left.iter().any(|one| one.id == **row);
                if let Some(row) = verb.rows.iter().find(gone) {
                    bail!(
                        "{} has no entry \"{row}\"; nothing was removed; see its entries with: cloudroidctl sla list \
                            {}",
                        verb.service,
                        verb.service
                    );
                }
                for row in &verb.rows {
                    let path = sla_path(&verb.service, &format!("/{row}"));
                    left = client.delete(&path).await?;
                }
                list(&verb.service, &left, format)
            }
            SlaCommand::Explain(verb) => {
                let query = to_query(&verb.stated.to_stated()?);
                let path = sla_path(&verb.service, &format!("/explain{query}"));
                let explained: Explained = client.get(&path).await?;
                match format {
                    OutputFormat::Json => output::json(&explained),
                    OutputFormat::Table => print_explanation(&explained),
                }
            }
        }
    }
}

fn sla_path(service: &str, rest: &str) -> String {
    format!("/api/v1/services/{}/sla{rest}", percent_encode(service))
}

impl SetRow {
    fn row(&self) -> anyhow::Result<Row> {
        let given = [(Measure::Rrt, self.rrt), (Measure::Fps, self.fps), (Measure::Age, self.age)];
        let given = given.into_iter().find_map(|(measure, value)| Some((measure, value?)));
        let Some((measure, value)) = given else {
            bail!("no goal given; pass --rrt, --fps or --age");
        };
        let limits = self.limits;
        if limits == Limits::default() {
            bail!("no limits given; pass one, such as --cpus 1.5 or --memory 512M");
        }
        let spread = self.spread.as_deref();
        Ok(Row {
            id: 0,
            measure,
            value,
            aux: unique_aux(&self.aux)?,
            limits,
            spread: spread.map(|text| parse_spread(measure, text)).transpose()?,
            revision: None,
            written: 0,
        })
    }
}

fn parse_spread(measure: Measure, text: &str) -> anyhow::Result<Spread> {
    let parts: Vec<&str> = text.split(',').map(str::trim).collect();
    let [p50, p95, requests] = parts[..] else {
        bail!("--spread {text:?} does not have three parts; write P50,P95,N such as 80ms,95ms,200");
    };
    let read = |text| measure.parse_value(text).map_err(|error| anyhow::anyhow!("--spread {error}"));
    let Ok(requests) = requests.parse() else {
        bail!("--spread: {requests:?} is not a number of requests; write one such as 200");
    };
    Ok(Spread { p50: read(p50)?, p95: read(p95)?, requests })
}

fn aux_in_words(aux: &BTreeMap<String, String>) -> String {
    let pairs = aux.iter().map(|(key, value)| format!("{key}={value}"));
    pairs.collect::<Vec<_>>().join(" ")
}

fn cells(row: &Row) -> [String; 6] {
    let print = |value| row.measure.format_value(value);
    let spread = row.spread.map(|spread| {
        format!(
            "p50 {}, p95 {} of {}",
            print(round_digits(spread.p50)),
            print(round_digits(spread.p95)),
            spread.requests
        )
    });
    [
        row.id.to_string(),
        format!("{} {}", row.measure.name(), print(row.value)),
        aux_in_words(&row.aux),
        output::limits(&row.limits),
        spread.unwrap_or_default(),
        row.revision.map_or_else(String::new, |n| n.to_string()),
    ]
}

/// Rounds to three significant digits: more are noise of the measurement.
fn round_digits(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

const HEADINGS: [&str; 6] = ["ENTRY", "REACHES", "FOR", "WITH", "MEASURED", "REVISION"];

fn list(service: &str, rows: &[Row], format: OutputFormat) -> anyhow::Result<()> {
    if format == OutputFormat::Json {
        return output::json(&rows);
    }
    let mut table = Table::new(&HEADINGS);
    for row in rows {
        table.row(cells(row));
    }
    table.print_list(&format!(
        "the SLA table of {service} is empty: every robot gets the service's own limits; add an entry with: \
            cloudroidctl sla set {service} --rrt 100ms --cpus 1.5"
    ))
}

/// Returns a sentence about what the robot gets.
fn outcome(explained: &Explained) -> String {
    let Explained { service, stated, .. } = explained;
    let robot = if stated.is_empty() {
        format!("a robot without requests to {service}")
    } else {
        format!("a robot that requests {stated} of {service}")
    };
    match (&explained.limits, &explained.refused) {
        (_, Some(refused)) => format!("{robot} is refused: {refused}"),
        (Some(limits), None) if *limits != Limits::default() => {
            format!("{robot} gets {}", output::limits(limits))
        }
        _ => format!(
            "{robot} has nothing reserved; its servant gets the server's default limits ([limits] of its \
                configuration)"
        ),
    }
}

fn print_explanation(explained: &Explained) -> anyhow::Result<()> {
    output::line(&outcome(explained))?;
    if let Some(class) = &explained.class {
        output::line(&format!("  class {class}, priority {}", explained.priority))?;
    }
    for why in &explained.why {
        output::line(&format!("  {why}"))?;
    }
    for next in &explained.next {
        output::line(&format!("next {next}"))?;
    }
    for goal in &explained.goals {
        let print = |value| goal.measure.format_value(value);
        output::line(&format!(
            "\n{}: {} desired, {} acceptable",
            goal.measure.name(),
            print(goal.desire),
            print(goal.bound)
        ))?;
        let mut table = Table::new(&["ENTRY", "REACHES", "FOR", "WITH", ""]);
        for considered in &goal.rows {
            let [id, reaches, aux, limits, ..] = cells(&considered.row);
            table.row([id, reaches, aux, limits, considered.why.clone()]);
        }
        if !table.is_empty() {
            table.print()?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use api::Size;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        sla: SlaArgs,
    }

    fn parse(line: &str) -> Result<SlaCommand, clap::Error> {
        Line::try_parse_from(std::iter::once("sla").chain(line.split_whitespace())).map(|line| line.sla.verb)
    }

    #[test]
    fn a_row_is_what_is_typed() {
        let line = "set detect --rrt 100ms --aux width=640 --cpus 1.5 --memory 512M --spread 80ms,95ms,200";
        let SlaCommand::Set(set) = parse(line).expect("valid") else {
            panic!("another verb");
        };
        let row = set.row().expect("a row");
        assert_eq!((row.measure, row.value), (Measure::Rrt, 0.1));
        assert_eq!(row.aux["width"], "640");
        assert_eq!(row.limits.memory, Some(Size(512 << 20)));
        let spread = row.spread.expect("it was measured");
        assert_eq!((spread.p50, spread.p95, spread.requests), (0.08, 0.095, 200));
    }

    #[test]
    fn what_a_robot_gets_is_said_whatever_it_states() {
        let stated = api::Stated::read([("rrt", "100ms")]).expect("valid");
        let limits = |cpus| Limits { cpus, ..Limits::default() };
        let said = |stated, cpus: Option<f64>, refused: Option<&str>| {
            outcome(&Explained {
                service: "s".into(),
                stated,
                limits: refused.is_none().then(|| limits(cpus)),
                refused: refused.map(str::to_owned),
                ..Explained::default()
            })
        };
        let nothing = api::Stated::default();
        for (said, expected) in [
            (said(stated.clone(), Some(1.5), None), "a robot that requests rrt=100ms of s gets 1.5 cpus"),
            (said(stated.clone(), None, Some("no row")), "a robot that requests rrt=100ms of s is refused: no row"),
            (said(nothing, None, None), "a robot without requests to s has nothing reserved; its servant gets"),
        ] {
            assert!(said.starts_with(expected), "{said}");
        }
    }

    #[test]
    fn what_was_measured_is_rounded() {
        let rounded = [0.17320284, 0.236046755, 12.349, 0.08, 0.0].map(round_digits);
        assert_eq!(rounded, [0.173, 0.236, 12.3, 0.08, 0.0]);
    }

    #[test]
    fn what_is_stated_is_what_is_typed() {
        let line = "explain detect --rrt 100ms --max-rrt 0.3 --class urgent --aux width=640";
        let SlaCommand::Explain(explain) = parse(line).expect("valid") else {
            panic!("another verb");
        };
        let stated = explain.stated.to_stated().expect("it can be stated");
        assert_eq!(stated.to_string(), "rrt=100ms max_rrt=300ms class=urgent aux.width=640");
    }

    #[test]
    fn what_makes_no_sense_is_refused_with_what_to_write() {
        for (line, words) in [
            ("set detect", "--rrt"),
            ("set detect --rrt 1 --fps 1 --cpus 1", "cannot be used with"),
            ("set detect --rrt soon --cpus 1", "is not a time"),
            ("set detect --fps 0 --cpus 1", "is not a rate"),
            ("set detect --rrt 1 --aux width --cpus 1", "KEY=VALUE"),
            ("rm detect", "ROWS"),
            ("rm detect one", "invalid"),
        ] {
            let refused = parse(line).expect_err(line).to_string();
            assert!(refused.contains(words), "{line}: {refused}");
        }
        for (line, words) in [
            ("set detect --rrt 1", "no limits given"),
            ("set detect --rrt 1 --cpus 1 --spread 1,2", "P50,P95,N"),
            ("set detect --rrt 1 --cpus 1 --spread 1,x,3", "is not a time"),
            ("set detect --rrt 1 --cpus 1 --spread 1,2,x", "number of requests"),
        ] {
            let SlaCommand::Set(set) = parse(line).expect(line) else {
                panic!("another verb");
            };
            let refused = set.row().expect_err(line).to_string();
            assert!(refused.contains(words), "{line}: {refused}");
        }
        let SlaCommand::Explain(explain) = parse("explain detect --rrt 2 --max-rrt 1").expect("parsed") else {
            panic!("another verb");
        };
        let refused = explain.stated.to_stated().expect_err("in disorder").to_string();
        assert!(refused.contains("greater than max_rrt"), "{refused}");
    }
}
