//! Prints an evaluation for people.

use std::path::Path;

use api::Size;
use api::calibration::TimeSpread;

use super::side::SideResult;
use super::verdict::Evaluation;
use crate::calibrate::print_rows;
use crate::output::{self, Table};
use crate::trial::describe_renamed_topics;

/// Prints the evaluation.
pub fn print(of: &Evaluation, plot: &Path) -> anyhow::Result<()> {
    output::line("")?;
    response_times(of)?;
    output::line("")?;
    phases(of)?;
    if let Some(words) = messages(&of.outsourced) {
        output::line(&words)?;
    }
    if let Some(network) = of.network.filter(|network| network.has_effect()) {
        output::line(&format!("UP and DOWN are calculated, not measured: a network of {network} is added"))?;
    }
    for words in describe_renamed_topics(&of.inputs) {
        output::line(&words)?;
    }
    if !of.unused.is_empty() {
        output::line(&format!("not used: {}", of.unused.join(", ")))?;
    }
    output::line(&format!(
        "native was measured on this server's cores; a robot with slower cores takes longer\nplot: {}\n",
        plot.display()
    ))?;
    output::line(&of.verdict)?;
    let Some(sla) = &of.sla else {
        let why = of.unsuggested.as_deref().unwrap_or_default();
        return output::line(&format!("no SLA is suggested: {why}"));
    };
    output::line(&format!("\nin stub.toml ({}):", sla.reason))?;
    for line in sla.stub_toml() {
        output::line(&format!("    {line}"))?;
    }
    output::line("")?;
    print_rows(std::slice::from_ref(&sla.row))
}

/// Returns the sizes of the largest request and answer over the network.
fn messages(outsourced: &SideResult) -> Option<String> {
    let answered_by = outsourced.answered_by.as_deref()?;
    let (request, answer) = outsourced.bytes;
    let size = |bytes: usize| Size(bytes as u64);
    Some(format!(
        "request: {} {}, answer: {answered_by} {}",
        outsourced.asked.as_deref().unwrap_or("-"),
        size(request),
        size(answer)
    ))
}

fn sides(of: &Evaluation) -> [(&'static str, &SideResult); 2] {
    [("native", &of.native), ("outsourced", &of.outsourced)]
}

fn response_times(of: &Evaluation) -> anyhow::Result<()> {
    let mut table = Table::new(&["", "CPUS", "MEMORY", "USED", "ANSWERED", "P50 MS", "P95 MS", "MAX MS"]);
    for (name, side) in sides(of) {
        let time = |of: fn(&TimeSpread) -> f64| {
            let shown = side.rrt.as_ref().map(|rrt| format!("{:.1}", of(rrt)));
            shown.unwrap_or_else(|| "-".to_owned())
        };
        let answered = match side.out_of_memory {
            Some(_) => "out of memory".to_owned(),
            None if side.broken.is_some() => "broken off".to_owned(),
            None => format!("{} of {}", side.answered, side.requests),
        };
        let limit = side.memory_limit.map(|limit| limit.to_string());
        table.row([
            name.to_owned(),
            side.cpus.to_string(),
            limit.unwrap_or_else(|| "no limit".to_owned()),
            match side.memory {
                Size(0) => "-".to_owned(),
                used => used.to_string(),
            },
            answered,
            time(|rrt| rrt.p50),
            time(|rrt| rrt.p95),
            time(|rrt| rrt.max),
        ]);
    }
    table.print()
}

fn phases(of: &Evaluation) -> anyhow::Result<()> {
    let mut table = Table::new(&["", "UP MS", "TRANSPORT MS", "DOWN MS", "COMPUTE MS", "RUNNING MS", "THROTTLED MS"]);
    for (name, side) in sides(of) {
        let cells = side.phases.map(|phases| {
            [phases.up, phases.transport, phases.down, Some(phases.compute), Some(phases.running), Some(phases.held_up)]
                .map(|time| time.map_or("-".to_owned(), |time| format!("{time:.1}")))
        });
        let cells = cells.unwrap_or_else(|| std::array::from_fn(|_| "-".to_owned()));
        table.row(std::iter::once(name.to_owned()).chain(cells));
    }
    table.print()
}
