//! Metrics as monitoring servers read them.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::run;
use support::world::{ADDER, world};
use support::{Verdict, binaries};

const LIST: &str = include_str!("../../docs/metrics.md");
const DASHBOARD: &str = include_str!("../../grafana/cloudroid.json");

/// Prints as JSON the metric families that Prometheus's own parsers of both formats find.
const READER: &str = r#"
import json, sys
from prometheus_client.openmetrics.parser import text_string_to_metric_families as open_metrics
from prometheus_client.parser import text_string_to_metric_families as prometheus
read = open_metrics if sys.argv[1] == "open" else prometheus
print(json.dumps([
    {"name": one.name, "type": one.type, "help": one.documentation,
     "labels": sorted({label for sample in one.samples for label in sample.labels}), "values": len(one.samples)}
    for one in read(open(sys.argv[2]).read())]))
"#;

/// Returns what an independent parser finds.
fn read_with_parser(format: &str, text: &str) -> anyhow::Result<Vec<Value>> {
    let place = world().directory("metrics")?;
    let file = place.path().join("metrics");
    std::fs::write(&file, text)?;
    let mut reader = Command::new(binaries::readers().join("python"));
    reader.args(["-c", READER, format]).arg(&file);
    Ok(serde_json::from_str(&run(&mut reader)?.expect_success()?.stdout)?)
}

/// Returns name, type, meaning and labels of the documented metrics.
fn documented_metrics() -> BTreeMap<&'static str, (&'static str, &'static str, BTreeSet<&'static str>)> {
    let rows = LIST.lines().filter_map(|line| line.strip_prefix("| `"));
    rows.filter_map(|row| {
        let cells: Vec<&str> = row.trim_end_matches(" |").split(" | ").collect();
        let [name, kind, _, labels, meaning] = cells.as_slice() else {
            return None;
        };
        let labels = labels.split(", ").map(str::trim);
        let labels = labels.filter(|label| !label.is_empty()).collect();
        Some((name.trim_end_matches('`'), (*kind, *meaning, labels)))
    })
    .collect()
}

fn get_metrics(daemon: &Daemon, accept: &str) -> anyhow::Result<String> {
    let (status, text) = daemon.request("GET", "/metrics", &[("Accept", accept)])?;
    ensure!(status == 200, "{text}");
    Ok(text)
}

pub fn every_metric_is_listed_and_read_by_others() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let mut robot = daemon.robot("adder_py?robot=counted")?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 1}))?["result"] == true);
    let open = get_metrics(&daemon, "application/openmetrics-text;version=1.0.0,text/plain;q=0.5")?;
    ensure!(open.ends_with("# EOF\n"), "it may be half of an answer");
    let listed = documented_metrics();
    let families = read_with_parser("open", &open)?;
    ensure!(families.len() > 40, "{families:?}");
    for family in &families {
        let name = family["name"].as_str().context("a name")?;
        let (kind, meaning, labels) =
            listed.get(name).with_context(|| format!("docs/metrics.md does not list {name}"))?;
        ensure!(family["type"] == *kind, "{family}, listed as {kind}");
        ensure!(family["help"] == *meaning, "{family}, listed as {meaning:?}");
        for label in family["labels"].as_array().context("labels")? {
            let label = label.as_str().context("a label")?;
            ensure!(labels.contains(label), "{name}: {label} is not listed");
        }
    }
    let told: BTreeSet<&str> = families.iter().filter_map(|family| family["name"].as_str()).collect();
    // Only a daemon with TLS has the first two, only one with `[telemetry]` the last.
    let elsewhere = ["cloudroid_refused_handshakes", "cloudroid_certificate_end_seconds", "cloudroid_dropped_spans"];
    for name in listed.keys() {
        ensure!(told.contains(name) || elsewhere.contains(name), "{name} is listed, and not told");
    }
    let count = |families: &[Value], name: &str| {
        let found = families.iter().find(|family| family["name"] == name);
        found.and_then(|family| family["values"].as_u64())
    };
    ensure!(count(&families, "cloudroid_request_seconds") > Some(10));
    // The same metrics in the older format.
    let older = read_with_parser("prometheus", &get_metrics(&daemon, "text/plain")?)?;
    ensure!(older.len() == families.len(), "{older:?}");
    Ok(())
}

pub fn the_dashboard_asks_for_what_there_is() -> Verdict {
    let dashboard: Value = serde_json::from_str(DASHBOARD)?;
    let listed = documented_metrics();
    let panels = dashboard["panels"].as_array().context("panels")?;
    let mut asked = BTreeSet::new();
    for panel in panels.iter().filter(|panel| panel["type"] != "row") {
        let targets = panel["targets"].as_array().context("targets")?;
        ensure!(!targets.is_empty(), "{panel}");
        for target in targets {
            let query = target["expr"].as_str().context("a query")?;
            let words = query.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
            for name in words.filter(|word| word.starts_with("cloudroid_")) {
                let family = listed.iter().find(|(family, (kind, ..))| match *kind {
                    "counter" => name == format!("{family}_total"),
                    "histogram" => ["bucket", "sum", "count"].iter().any(|end| name == format!("{family}_{end}")),
                    _ => name == **family,
                });
                ensure!(family.is_some(), "{query}: no metric is called {name}");
                asked.insert(name);
            }
        }
    }
    ensure!(asked.len() > 20, "{asked:?}");
    Ok(())
}
