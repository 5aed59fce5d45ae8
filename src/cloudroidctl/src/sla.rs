//! `sla`: a service's dictionary, from what robots state to resources.

use std::collections::BTreeMap;

use anyhow::bail;
use api::dictionary::{Explained, NewRows, Row, Spread};
use api::{Limits, Measure};

use crate::client::{Client, escaped};
use crate::limits::LimitFlags;
use crate::output::{self, Format, Table};
use crate::stated::{StatedFlags, aux, once, query};

/// What an SLA costs: list, set, remove and explain the rows of a service's dictionary.
#[derive(Debug, clap::Args)]
pub struct Sla {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, clap::Subcommand)]
enum Verb {
    List(List),
    Set(Set),
    Rm(Rm),
    Explain(Explain),
}

/// List the rows of a service's dictionary.
#[derive(Debug, clap::Args)]
struct List {
    /// The service.
    service: String,
}

/// Write a row: with these limits, a servant reaches this value. One of the same value and auxiliary parameters is replaced.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("value").required(true).args(["rrt", "fps", "age"])))]
struct Set {
    /// The service.
    service: String,
    /// Response time that is reached, such as 100ms.
    #[arg(long, value_name = "TIME", value_parser = rrt, allow_hyphen_values = true)]
    rrt: Option<f64>,
    /// Frames per second that are reached.
    #[arg(long, value_name = "RATE", value_parser = fps, allow_hyphen_values = true)]
    fps: Option<f64>,
    /// Age of an output that is reached, such as 500ms.
    #[arg(long, value_name = "TIME", value_parser = age, allow_hyphen_values = true)]
    age: Option<f64>,
    /// Auxiliary parameter for which it holds: of a number up to this one; may be given several times.
    #[arg(long = "aux", value_name = "KEY=VALUE", value_parser = aux)]
    aux: Vec<(String, String)>,
    #[command(flatten)]
    limits: LimitFlags,
    /// How it was measured: median, 95th percentile and number of requests, such as 80ms,95ms,200.
    #[arg(long, value_name = "P50,P95,N")]
    spread: Option<String>,
}

/// Remove rows by their numbers.
#[derive(Debug, clap::Args)]
struct Rm {
    /// The service.
    service: String,
    /// Numbers of rows, as `sla list` shows them.
    #[arg(required = true)]
    rows: Vec<i64>,
}

/// Say which row a robot would get that states this, why, and what comes next.
#[derive(Debug, clap::Args)]
struct Explain {
    /// The service.
    service: String,
    #[command(flatten)]
    stated: StatedFlags,
}

fn rrt(text: &str) -> Result<f64, String> {
    Measure::Rrt.read(text)
}

fn fps(text: &str) -> Result<f64, String> {
    Measure::Fps.read(text)
}

fn age(text: &str) -> Result<f64, String> {
    Measure::Age.read(text)
}

impl Sla {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        match self.verb {
            Verb::List(verb) => {
                let rows: Vec<Row> = client.get(&path(&verb.service, "")).await?;
                list(&verb.service, &rows, format)
            }
            Verb::Set(verb) => {
                let new = NewRows {
                    rows: vec![verb.row()?],
                    replace: false,
                };
                let rows: Vec<Row> = client.put(&path(&verb.service, ""), &new).await?;
                list(&verb.service, &rows, format)
            }
            Verb::Rm(verb) => {
                let mut left: Vec<Row> = client.get(&path(&verb.service, "")).await?;
                let gone = |row: &&i64| !left.iter().any(|one| one.id == **row);
                if let Some(row) = verb.rows.iter().find(gone) {
                    bail!(
                        "{} has no row \"{row}\"; nothing was removed; see its rows with: cloudroidctl sla list {}",
                        verb.service,
                        verb.service
                    );
                }
                for row in &verb.rows {
                    let path = path(&verb.service, &format!("/{row}"));
                    left = client.delete(&path).await?;
                }
                list(&verb.service, &left, format)
            }
            Verb::Explain(verb) => {
                let query = query(&verb.stated.stated()?);
                let path = path(&verb.service, &format!("/explain{query}"));
                let explained: Explained = client.get(&path).await?;
                match format {
                    Format::Json => output::json(&explained),
                    Format::Table => explain(&explained),
                }
            }
        }
    }
}

fn path(service: &str, rest: &str) -> String {
    format!("/api/v1/services/{}/sla{rest}", escaped(service))
}

impl Set {
    fn row(&self) -> anyhow::Result<Row> {
        let given = [
            (Measure::Rrt, self.rrt),
            (Measure::Fps, self.fps),
            (Measure::Age, self.age),
        ];
        let given = given
            .into_iter()
            .find_map(|(measure, value)| Some((measure, value?)));
        let Some((measure, value)) = given else {
            bail!("nothing is reached; name --rrt, --fps or --age");
        };
        let limits = Limits::from(self.limits);
        if limits == Limits::default() {
            bail!("nothing is needed; name a limit, such as --cpus 1.5 or --memory 512M");
        }
        let spread = self.spread.as_deref();
        Ok(Row {
            id: 0,
            measure,
            value,
            aux: once(&self.aux)?,
            limits,
            spread: spread.map(|text| spread_of(measure, text)).transpose()?,
            revision: None,
            written: 0,
        })
    }
}

fn spread_of(measure: Measure, text: &str) -> anyhow::Result<Spread> {
    let parts: Vec<&str> = text.split(',').map(str::trim).collect();
    let [p50, p95, requests] = parts[..] else {
        bail!("--spread {text:?} has not three parts; write P50,P95,N such as 80ms,95ms,200");
    };
    let read = |text| {
        measure
            .read(text)
            .map_err(|reason| anyhow::anyhow!("--spread {reason}"))
    };
    let Ok(requests) = requests.parse() else {
        bail!("--spread: {requests:?} is not a number of requests; write one such as 200");
    };
    Ok(Spread {
        p50: read(p50)?,
        p95: read(p95)?,
        requests,
    })
}

fn in_words(aux: &BTreeMap<String, String>) -> String {
    let pairs = aux.iter().map(|(key, value)| format!("{key}={value}"));
    pairs.collect::<Vec<_>>().join(" ")
}

fn cells(row: &Row) -> [String; 6] {
    let print = |value| row.measure.print(value);
    let spread = row.spread.map(|spread| {
        format!(
            "p50 {}, p95 {} of {}",
            print(rounded(spread.p50)),
            print(rounded(spread.p95)),
            spread.requests
        )
    });
    [
        row.id.to_string(),
        format!("{} {}", row.measure.name(), print(row.value)),
        in_words(&row.aux),
        output::limits(&row.limits),
        spread.unwrap_or_default(),
        row.revision.map_or_else(String::new, |n| n.to_string()),
    ]
}

/// To three digits that count: more is noise of the measurement.
fn rounded(value: f64) -> f64 {
    format!("{value:.2e}").parse().unwrap_or(value)
}

const HEADINGS: [&str; 6] = ["ROW", "REACHES", "FOR", "WITH", "MEASURED", "REVISION"];

fn list(service: &str, rows: &[Row], format: Format) -> anyhow::Result<()> {
    if format == Format::Json {
        return output::json(&rows);
    }
    if rows.is_empty() {
        return output::line(&format!(
            "{service} has no rows: every robot gets the service's own limits; add one with: cloudroidctl sla set {service} --rrt 100ms --cpus 1.5"
        ));
    }
    let mut table = Table::new(&HEADINGS);
    for row in rows {
        table.row(cells(row));
    }
    table.print()
}

/// What the robot gets.
fn outcome(explained: &Explained) -> String {
    let Explained {
        service, stated, ..
    } = explained;
    let robot = match stated.is_empty() {
        true => format!("a robot that states nothing to {service}"),
        false => format!("a robot that states {stated} to {service}"),
    };
    match (&explained.limits, &explained.refused) {
        (_, Some(refused)) => format!("{robot} is refused: {refused}"),
        (Some(limits), None) if *limits != Limits::default() => {
            format!("{robot} is promised {}", output::limits(limits))
        }
        _ => format!(
            "{robot} is promised nothing; its servant gets the limits that the server gives to all ([limits] of its configuration)"
        ),
    }
}

fn explain(explained: &Explained) -> anyhow::Result<()> {
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
        let print = |value| goal.measure.print(value);
        output::line(&format!(
            "\n{}: {} is wished for, {} acceptable",
            goal.measure.name(),
            print(goal.desire),
            print(goal.bound)
        ))?;
        let mut table = Table::new(&["ROW", "REACHES", "FOR", "WITH", ""]);
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
        sla: Sla,
    }

    fn parse(line: &str) -> Result<Verb, clap::Error> {
        Line::try_parse_from(std::iter::once("sla").chain(line.split_whitespace()))
            .map(|line| line.sla.verb)
    }

    #[test]
    fn a_row_is_what_is_typed() {
        let line = "set detect --rrt 100ms --aux width=640 --cpus 1.5 --memory 512M --spread 80ms,95ms,200";
        let Verb::Set(set) = parse(line).expect("valid") else {
            panic!("another verb");
        };
        let row = set.row().expect("a row");
        assert_eq!((row.measure, row.value), (Measure::Rrt, 0.1));
        assert_eq!(row.aux["width"], "640");
        assert_eq!(row.limits.memory, Some(Size(512 << 20)));
        let spread = row.spread.expect("it was measured");
        assert_eq!(
            (spread.p50, spread.p95, spread.requests),
            (0.08, 0.095, 200)
        );
    }

    #[test]
    fn what_a_robot_gets_is_said_whatever_it_states() {
        let stated = api::Stated::read([("rrt", "100ms")]).expect("valid");
        let limits = |cpus| Limits {
            cpus,
            ..Limits::default()
        };
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
            (
                said(stated.clone(), Some(1.5), None),
                "a robot that states rrt=100ms to s is promised 1.5 cpus",
            ),
            (
                said(stated.clone(), None, Some("no row")),
                "a robot that states rrt=100ms to s is refused: no row",
            ),
            (
                said(nothing, None, None),
                "a robot that states nothing to s is promised nothing; its servant gets",
            ),
        ] {
            assert!(said.starts_with(expected), "{said}");
        }
    }

    #[test]
    fn what_was_measured_is_rounded() {
        let rounded = [0.17320284, 0.236046755, 12.349, 0.08, 0.0].map(rounded);
        assert_eq!(rounded, [0.173, 0.236, 12.3, 0.08, 0.0]);
    }

    #[test]
    fn what_is_stated_is_what_is_typed() {
        let line = "explain detect --rrt 100ms --max-rrt 0.3 --class urgent --aux width=640";
        let Verb::Explain(explain) = parse(line).expect("valid") else {
            panic!("another verb");
        };
        let stated = explain.stated.stated().expect("it can be stated");
        assert_eq!(
            stated.to_string(),
            "rrt=100ms max_rrt=300ms class=urgent aux.width=640"
        );
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
            ("set detect --rrt 1", "name a limit"),
            ("set detect --rrt 1 --cpus 1 --spread 1,2", "P50,P95,N"),
            (
                "set detect --rrt 1 --cpus 1 --spread 1,x,3",
                "is not a time",
            ),
            (
                "set detect --rrt 1 --cpus 1 --spread 1,2,x",
                "number of requests",
            ),
        ] {
            let Verb::Set(set) = parse(line).expect(line) else {
                panic!("another verb");
            };
            let refused = set.row().expect_err(line).to_string();
            assert!(refused.contains(words), "{line}: {refused}");
        }
        let Verb::Explain(explain) = parse("explain detect --rrt 2 --max-rrt 1").expect("parsed")
        else {
            panic!("another verb");
        };
        let refused = explain
            .stated
            .stated()
            .expect_err("in disorder")
            .to_string();
        assert!(refused.contains("greater than max_rrt"), "{refused}");
    }
}
