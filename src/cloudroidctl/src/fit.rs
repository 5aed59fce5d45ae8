//! `fit`: whether one more servant of a service would fit.

use api::Size;

use crate::client::{Client, escaped};
use crate::output::{self, Format, Table};
use crate::stated::{StatedFlags, query};

/// Say whether one more robot would find room, what it would cost the others, and how many more would fit.
#[derive(Debug, clap::Args)]
pub struct Fit {
    /// The service.
    service: String,
    #[command(flatten)]
    stated: StatedFlags,
}

impl Fit {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let fit: api::Fit = client.get(&self.path()?).await?;
        match format {
            Format::Json => output::json(&fit),
            Format::Table => {
                print(&self.service, &fit)?;
                let stated = self.stated.stated()?;
                if stated.sla.rrt.is_some() && fit.expected.is_none() {
                    output::line(&format!(
                        "how long its requests would take is not known: no row of the dictionary says so, and nobody's requests were measured; measure with: cloudroidctl calibrate {}",
                        self.service
                    ))?;
                }
                Ok(())
            }
        }
    }

    fn path(&self) -> anyhow::Result<String> {
        let query = query(&self.stated.stated()?);
        Ok(format!(
            "/api/v1/services/{}/fit{query}",
            escaped(&self.service)
        ))
    }
}

fn print(service: &str, fit: &api::Fit) -> anyhow::Result<()> {
    output::line(&in_words(service, fit))?;
    if fit.costs.is_empty() {
        return Ok(());
    }
    output::line("\nif it used all of that, these would have less than they use now")?;
    let mut table = Table::new(&[
        "SERVANT", "ROBOT", "CORES", "LEFT", "RRT", "THEN", "ACCEPTS",
    ]);
    for cost in &fit.costs {
        table.row([
            cost.servant.clone(),
            cost.robot.clone(),
            format!("{:.2}", cost.cpus),
            format!("{:.2}", cost.left),
            time(cost.rrt),
            time(cost.later),
            time(cost.accepts),
        ]);
    }
    table.print()
}

/// A time in whole milliseconds; a dash where it is not known.
fn time(seconds: Option<f64>) -> String {
    seconds.map_or_else(
        || "-".to_owned(),
        |seconds| format!("{:.0} ms", seconds * 1000.0),
    )
}

/// What is lacking.
fn lacking(cpus: f64, memory: Size) -> String {
    let cores = (cpus > 0.0).then(|| format!("{cpus} cores"));
    let memory = (memory > Size(0)).then(|| format!("{memory} of memory"));
    let all: Vec<String> = cores.into_iter().chain(memory).collect();
    format!("{} are lacking", all.join(" and "))
}

/// The answer in sentences.
fn in_words(service: &str, fit: &api::Fit) -> String {
    let expected = fit.expected.as_ref().map(|expected| {
        let rrt = time(Some(expected.rrt));
        format!(
            "\n19 of 20 of its requests would take up to {rrt} ({})",
            expected.from
        )
    });
    let expected = expected.unwrap_or_default();
    if let Some(servants @ 1..) = fit.shared {
        let servants = match servants {
            1 => "1 servant".to_owned(),
            more => format!("{more} servants"),
        };
        return format!(
            "robots share {servants} of {service}; one more robot needs no room{expected}"
        );
    }
    let wanted = format!(
        "one more servant of {service} is promised {} cores and {} of memory",
        fit.cpus, fit.memory
    );
    let lacks = fit.lacking_cpus > 0.0 || fit.lacking_memory > Size(0);
    let now = match (&fit.stalled, fit.now) {
        (Some(why), _) => format!("it would wait: {why}"),
        (None, true) => "it would be started at once".to_owned(),
        (None, false) if fit.full => format!(
            "it would be refused: {} wait already, and no further one may ([capacity] queue)",
            fit.waiting
        ),
        (None, false) if lacks => format!(
            "it would wait: {}, and {} wait already",
            lacking(fit.lacking_cpus, fit.lacking_memory),
            fit.waiting
        ),
        (None, false) => format!(
            "it would be started when these have ended, which are idle: {}",
            fit.ends.join(", ")
        ),
    };
    let answer = match &fit.never {
        Some(why) => format!("it would be refused, now and later: {why}"),
        None => now,
    };
    let more = match fit.more {
        None => "as many as one likes would fit".to_owned(),
        Some(0) => "none would fit beside those that are in use".to_owned(),
        Some(more) => format!(
            "{more} would fit, {} would not: {}",
            more.saturating_add(1),
            lacking(fit.beyond_cpus, fit.beyond_memory)
        ),
    };
    format!(
        "{wanted}; {} cores and {} are free\n{answer}\n{more}{expected}",
        fit.free_cpus, fit.free_memory
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fit() -> api::Fit {
        api::Fit {
            cpus: 1.0,
            memory: Size(64 << 20),
            free_cpus: 0.5,
            free_memory: Size(1 << 30),
            waiting: 2,
            stalled: None,
            full: false,
            never: None,
            now: false,
            ends: vec!["a-1".into()],
            lacking_cpus: 0.0,
            lacking_memory: Size(0),
            costs: Vec::new(),
            more: Some(1),
            beyond_cpus: 1.5,
            beyond_memory: Size(0),
            expected: None,
            shared: None,
        }
    }

    #[test]
    fn every_answer_has_its_words() {
        let lacking = api::Fit {
            lacking_cpus: 0.5,
            more: Some(0),
            ..fit()
        };
        let never = api::Fit {
            never: Some("64 cores are more than the 2 that servants may have".into()),
            ..lacking.clone()
        };
        let full = api::Fit {
            full: true,
            ..lacking.clone()
        };
        let now = api::Fit {
            now: true,
            more: None,
            ..fit()
        };
        let stalled = api::Fit {
            stalled: Some("this machine swaps".into()),
            ..now.clone()
        };
        let expected = api::Fit {
            expected: Some(api::Expected {
                rrt: 0.11,
                from: "row 3 of the dictionary".into(),
            }),
            ..fit()
        };
        let shared = api::Fit {
            shared: Some(2),
            ..expected.clone()
        };
        let none_yet = api::Fit {
            shared: Some(0),
            ..fit()
        };
        assert_eq!(
            (time(None).as_str(), time(Some(0.0126)).as_str()),
            ("-", "13 ms")
        );
        for (fit, words) in [
            (
                expected,
                "1.5 cores are lacking\n19 of 20 of its requests would take up to 110 ms (row 3",
            ),
            (
                shared,
                "robots share 2 servants of a; one more robot needs no room\n19 of 20",
            ),
            (none_yet, "one more servant of a is promised"),
            (
                fit(),
                "1 cores and 64M of memory; 0.5 cores and 1G are free",
            ),
            (
                fit(),
                "idle: a-1\n1 would fit, 2 would not: 1.5 cores are lacking",
            ),
            (
                lacking,
                "0.5 cores are lacking, and 2 wait already\nnone would fit",
            ),
            (never, "it would be refused, now and later: 64 cores"),
            (full, "it would be refused: 2 wait already"),
            (now, "at once\nas many"),
            (stalled, "it would wait: this machine swaps"),
        ] {
            let said = in_words("a", &fit);
            assert!(said.contains(words), "{said}");
        }
    }

    #[test]
    fn what_the_robot_states_is_asked_for() {
        use clap::Parser;
        #[derive(Parser)]
        struct Line {
            #[command(flatten)]
            fit: Fit,
        }
        let line = [
            "fit",
            "a b",
            "--rrt",
            "100ms",
            "--memory",
            "1G",
            "--class",
            "x-y",
            "--aux",
            "width=640",
        ];
        let path = |line: &[&str]| {
            let path = Line::parse_from(line).fit.path();
            path.map_err(|error| error.to_string())
        };
        let stated = "/api/v1/services/a%20b/fit?rrt=100ms&class=x-y&memory=1G&aux.width=640";
        assert_eq!(path(&line).as_deref(), Ok(stated));
        assert_eq!(path(&["fit", "a"]).as_deref(), Ok("/api/v1/services/a/fit"));
        let wrong = path(&["fit", "a", "--rrt", "soon"]).expect_err("no time");
        assert!(wrong.contains("rrt"), "{wrong}");
    }
}
