//! `fit`: predicts whether another servant of a service would fit.

use api::Size;

use crate::client::{DaemonClient, percent_encode};
use crate::output::{self, OutputFormat, Table, count};
use crate::terms_flags::{StatedFlags, to_query};

/// Predict whether the server has capacity for another robot, what it would cost the others, and how many more would
/// fit.
#[derive(Debug, clap::Args)]
pub struct FitArgs {
    /// Service that the robot would use.
    service: String,
    #[command(flatten)]
    stated: StatedFlags,
}

impl FitArgs {
    /// Sends the request and prints the prediction.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let fit: api::Fit = client.get(&self.path()?).await?;
        match format {
            OutputFormat::Json => output::json(&fit),
            OutputFormat::Table => {
                print(&self.service, &fit)?;
                let stated = self.stated.to_stated()?;
                if stated.sla.rrt.is_some() && fit.expected.is_none() {
                    output::line(&format!(
                        "unknown how long its requests would take: the SLA table has no entry for it, and no robot's \
                            requests were measured; measure with: cloudroidctl calibrate {}",
                        self.service
                    ))?;
                }
                Ok(())
            }
        }
    }

    fn path(&self) -> anyhow::Result<String> {
        let query = to_query(&self.stated.to_stated()?);
        Ok(format!("/api/v1/services/{}/fit{query}", percent_encode(&self.service)))
    }
}

fn print(service: &str, fit: &api::Fit) -> anyhow::Result<()> {
    output::line(&fit_in_words(service, fit))?;
    if fit.costs.is_empty() {
        return Ok(());
    }
    output::line("\nif it used all of that, these servants would get less than they use now")?;
    let mut table = Table::new(&["SERVANT", "ROBOT", "CORES", "LEFT", "RRT", "THEN", "ACCEPTS"]);
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

/// Formats a time in whole milliseconds; a dash if it is unknown.
fn time(seconds: Option<f64>) -> String {
    seconds.map_or_else(|| "-".to_owned(), |seconds| format!("{:.0} ms", seconds * 1000.0))
}

/// Formats missing resources.
fn lacking_in_words(cpus: f64, memory: Size) -> String {
    let cores = (cpus > 0.0).then(|| format!("{cpus} cores"));
    let memory = (memory > Size(0)).then(|| format!("{memory} of memory"));
    let all: Vec<String> = cores.into_iter().chain(memory).collect();
    format!("lacking {}", all.join(" and "))
}

/// Formats the prediction as sentences.
fn fit_in_words(service: &str, fit: &api::Fit) -> String {
    let expected = fit.expected.as_ref().map(|expected| {
        let rrt = time(Some(expected.rrt));
        format!("\n95 % of its requests would take up to {rrt} ({})", expected.from)
    });
    let expected = expected.unwrap_or_default();
    if let Some(servants @ 1..) = fit.shared {
        let servants = count(servants, "servant");
        return format!("robots share {servants} of {service}; one more robot needs no more capacity{expected}");
    }
    let wanted = format!("one more servant of {service} reserves {} cores and {} of memory", fit.cpus, fit.memory);
    let lacks = fit.lacking_cpus > 0.0 || fit.lacking_memory > Size(0);
    let now = match (&fit.stalled, fit.now) {
        (Some(why), _) => format!("it would wait: {why}"),
        (None, true) => "it would start at once".to_owned(),
        (None, false) if fit.full => {
            format!("it would be refused: the queue is full with {} ([capacity] queue)", count(fit.waiting, "robot"))
        }
        (None, false) if lacks => format!(
            "it would wait: {}; {} already waiting",
            lacking_in_words(fit.lacking_cpus, fit.lacking_memory),
            fit.waiting
        ),
        (None, false) => format!("it would start once these idle servants have ended: {}", fit.ends.join(", ")),
    };
    let answer = match &fit.never {
        Some(why) => format!("it would always be refused: {why}"),
        None => now,
    };
    let more = match fit.more {
        None => "any number would fit".to_owned(),
        Some(0) => "none would fit beside the servants in use".to_owned(),
        Some(more) => format!(
            "{more} would fit, {} would not: {}",
            more.saturating_add(1),
            lacking_in_words(fit.beyond_cpus, fit.beyond_memory)
        ),
    };
    let cores = cores_in_words(fit);
    format!("{wanted}; {} cores and {} are free\n{answer}\n{more}{cores}{expected}", fit.free_cpus, fit.free_memory)
}

/// Tells what follows from the present use if no cores are requested: room for a nominal reservation means little.
fn cores_in_words(fit: &api::Fit) -> String {
    let Some(forecast) = fit.at_present_use else {
        return String::new();
    };
    match (forecast.cpus, forecast.more) {
        (Some(cpus), Some(more)) => format!(
            "\nno cores are requested (--cpus): at the present use of {cpus:.2} cores each, with {:.2} cores unused, \
                {} would find enough",
            forecast.unused_cpus,
            count(more, "more servant")
        ),
        _ => format!(
            "\nno cores are requested (--cpus), and how many it would use is not known yet; {:.2} cores are unused",
            forecast.unused_cpus
        ),
    }
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
            at_present_use: None,
            expected: None,
            shared: None,
        }
    }

    #[test]
    fn every_answer_has_its_words() {
        let lacking = api::Fit { lacking_cpus: 0.5, more: Some(0), ..fit() };
        let never =
            api::Fit { never: Some("64 cores are more than the 2 that servants may have".into()), ..lacking.clone() };
        let full = api::Fit { full: true, ..lacking.clone() };
        let now = api::Fit { now: true, more: None, ..fit() };
        let stalled = api::Fit { stalled: Some("this machine swaps".into()), ..now.clone() };
        let expected =
            api::Fit { expected: Some(api::Expected { rrt: 0.11, from: "entry 3 of the SLA table".into() }), ..fit() };
        let shared = api::Fit { shared: Some(2), ..expected.clone() };
        let none_yet = api::Fit { shared: Some(0), ..fit() };
        let forecast = |cpus, more| Some(api::UseForecast { unused_cpus: 1.25, cpus, more });
        let by_use = api::Fit { at_present_use: forecast(Some(0.4), Some(3)), ..fit() };
        let unknown = api::Fit { at_present_use: forecast(None, None), ..fit() };
        assert_eq!((time(None).as_str(), time(Some(0.0126)).as_str()), ("-", "13 ms"));
        for (fit, words) in [
            (expected, "lacking 1.5 cores\n95 % of its requests would take up to 110 ms (entry 3"),
            (shared, "robots share 2 servants of a; one more robot needs no more capacity\n95 %"),
            (none_yet, "one more servant of a reserves"),
            (fit(), "1 cores and 64M of memory; 0.5 cores and 1G are free"),
            (fit(), "ended: a-1\n1 would fit, 2 would not: lacking 1.5 cores"),
            (lacking, "lacking 0.5 cores; 2 already waiting\nnone would fit"),
            (never, "it would always be refused: 64 cores"),
            (full, "it would be refused: the queue is full with 2"),
            (now, "at once\nany number"),
            (stalled, "it would wait: this machine swaps"),
            (
                by_use,
                "2 would not: lacking 1.5 cores\nno cores are requested (--cpus): at the present use of 0.40 cores",
            ),
            (unknown, "how many it would use is not known yet; 1.25 cores are unused"),
        ] {
            let said = fit_in_words("a", &fit);
            assert!(said.contains(words), "{said}");
        }
    }

    #[test]
    fn what_the_robot_states_is_asked_for() {
        use clap::Parser;
        #[derive(Parser)]
        struct Line {
            #[command(flatten)]
            fit: FitArgs,
        }
        let line = ["fit", "a b", "--rrt", "100ms", "--memory", "1G", "--class", "x-y", "--aux", "width=640"];
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
