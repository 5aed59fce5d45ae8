//! Experiments that the project's benchmarks measure: their programs are run, and what they write is told beside the publication's values.

use std::path::PathBuf;
use std::process::Command;

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};
use support::binaries;

use crate::cells::{Cells, Measured};
use crate::section::{Missing, Section, Table};
use crate::words::{digits, ratio};

/// A benchmark, and the experiment that it stands for.
pub struct Bench {
    number: u8,
    /// Of its program, `bench-NAME`, and its file, `target/bench/NAME.json`.
    name: &'static str,
    title: &'static str,
    published: &'static str,
    differs: &'static str,
}

impl Bench {
    /// Of the experiment.
    pub fn number(&self) -> u8 {
        self.number
    }
}

/// In the order of the publication's experiments.
pub const ALL: [Bench; 2] = [
    Bench {
        number: 6,
        name: "failover",
        title: "A network that becomes bad and good again",
        published: "Fig. 7 of the publication: response times while the network is bad during requests 24-45, 75-96 and 111-122; the local original takes over.",
        differs: "people_detect is asked, the network is degraded to 2 Mbit/s, 100 ms each way and 1 % loss; beside the stub, the cloud alone and the original alone.",
    },
    Bench {
        number: 8,
        name: "codecs",
        title: "Bytes that codecs save",
        published: "Table I of the publication: video by libav saves 75.4 %, images by deflate 96.1 %, grid maps by zlib 99.9 %.",
        differs: "Pictures, depth images and maps of other sources; each codec beside the one that the publication used.",
    },
];

/// What a benchmark writes: `bench_report::Report`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Written {
    /// In the order in which they were measured.
    pub figures: Vec<Figure>,
    /// What could not be measured.
    #[serde(default)]
    pub left_out: Vec<LeftOut>,
    /// A drawing, if it makes one.
    #[serde(default)]
    drawing: Option<String>,
}

/// One measured number: `bench_report::Figure`.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub struct Figure {
    /// What was measured.
    pub figure: String,
    /// In what unit.
    pub unit: String,
    /// The number.
    pub value: Option<f64>,
    /// What it was measured beside.
    pub peer: Option<String>,
    /// The peer's number, in the same unit.
    pub floor: Option<f64>,
    ratio: Option<f64>,
    to_reach: Option<String>,
    met: Option<bool>,
    note: Option<String>,
}

/// Something that could not be measured on this machine: `bench_report::LeftOut`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct LeftOut {
    /// What it is.
    pub what: String,
    /// Why.
    pub why: String,
}

impl Written {
    /// Sentences about what was to be reached and was not.
    pub fn unmet(&self) -> Vec<String> {
        let unmet = self
            .figures
            .iter()
            .filter(|figure| figure.met == Some(false));
        let sentence = |figure: &Figure| {
            format!(
                "{}: {} {}, which is not {}.",
                figure.figure,
                figure.value.map(digits).unwrap_or_default(),
                figure.unit,
                figure.to_reach.as_deref().unwrap_or_default()
            )
        };
        unmet.map(sentence).collect()
    }
}

/// Runs one, unless that was done before.
pub fn measure(cells: &Cells, bench: &Bench) -> Result<Measured<Written>> {
    part(cells, bench.name, &[])
}

/// Runs what `arguments` choose of a benchmark, unless that was done before.
pub fn part(cells: &Cells, name: &str, arguments: &[&str]) -> Result<Measured<Written>> {
    let cell = [&["bench", name], arguments].concat().join(" ");
    cells.measure(&cell, &name, || {
        let program = binaries::path(&format!("bench-{name}"));
        ensure!(
            program.exists(),
            "{} is not built: make eval builds it",
            program.display()
        );
        let status = Command::new(&program).args(arguments).status()?;
        ensure!(
            status.success(),
            "{} ended with {status}",
            program.display()
        );
        let file = written(name, "json");
        let text = std::fs::read(&file).with_context(|| file.display().to_string())?;
        let mut written: Written = serde_json::from_slice(&text)?;
        written.drawing = std::fs::read_to_string(self::written(name, "svg")).ok();
        Ok(written)
    })
}

fn written(name: &str, ending: &str) -> PathBuf {
    bench_report::root().join(format!("target/bench/{name}.{ending}"))
}

/// What the report says.
pub fn section(bench: &Bench, measured: &Measured<Written>) -> Section {
    let mut section = Section::new(bench.number, bench.name, bench.title);
    section.published = bench.published.to_owned();
    section.differs = vec![
        bench.differs.to_owned(),
        format!("Measured by make bench ONLY={}.", bench.name),
    ];
    let written = match measured {
        Measured::Done(written) => written,
        Measured::Missing(why) => {
            section.missing.push(Missing {
                what: format!("all of make bench ONLY={}", bench.name),
                why: why.clone(),
                next: format!("make bench ONLY={}, then make eval again", bench.name),
            });
            return section;
        }
    };
    let mut table = Table::new(
        bench.title,
        ["figure", "value", "beside", "ratio", "to reach", "", "note"],
    );
    for figure in &written.figures {
        let beside = figure
            .floor
            .zip(figure.peer.as_ref())
            .map(|(floor, peer)| format!("{} {peer}", digits(floor)));
        table.push([
            figure.figure.clone(),
            figure.value.map_or_else(
                || "–".to_owned(),
                |value| format!("{} {}", digits(value), figure.unit),
            ),
            beside.unwrap_or_default(),
            figure
                .ratio
                .map(|times| ratio(Some(times)))
                .unwrap_or_default(),
            figure.to_reach.clone().unwrap_or_default(),
            match figure.met {
                Some(true) => "met",
                Some(false) => "NOT met",
                None => "",
            }
            .to_owned(),
            figure.note.clone().unwrap_or_default(),
        ]);
    }
    section.tables.push(table);
    section.findings = written.unmet();
    for one in &written.left_out {
        section.missing.push(Missing::new(
            &one.what,
            &one.why,
            format!("make bench ONLY={}, then make eval again", bench.name),
        ));
    }
    if let Some(drawing) = &written.drawing {
        section.drawing(bench.name, bench.title, drawing.clone());
    }
    section
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_not_reached_is_a_finding() {
        let mut report = bench_report::Report::new("codecs");
        report
            .figure("saved", "%", 50.0)
            .reach(bench_report::Target::AtLeast(70.0));
        report.figure("fast", "MB/s", 50.0).beside("zlib", 25.0);
        let text = serde_json::to_string(&report).expect("JSON");
        let written = serde_json::from_str(&text).expect("what a benchmark writes");
        let section = section(&ALL[1], &Measured::Done(written));
        assert_eq!(section.findings, ["saved: 50.0 %, which is not ≥ 70."]);
        assert_eq!(
            section.tables[0].rows[1][2..4],
            ["25.0 zlib", "2.0"].map(str::to_owned)
        );
    }

    #[test]
    fn a_benchmark_that_did_not_run_says_why() {
        let section = section(&ALL[0], &Measured::Missing("it is not built".to_owned()));
        assert_eq!(section.missing[0].why, "it is not built");
    }
}
