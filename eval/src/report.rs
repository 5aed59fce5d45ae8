//! The files of the report.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result};
use bench_report::MachineDescription;
use serde::Serialize;
use serde_json::Value;

use crate::cells::RunCache;
use crate::page;
use crate::section::{FigureImage, Section};

/// Things that were not available: the published one, its substitute, and the reason.
const STAND_INS: [[&str; 3]; 5] = [
    [
        "RGBD-SLAM, RTAB-Map, SSD",
        "laser_slam, graph_slam and object_detector of examples/",
        "they are not packaged for Debian 12, and their data sets are not in its archive",
    ],
    ["a GPU in the cloud", "none: all computes on processor cores", "the packages that stand in have no code for one"],
    ["a real robot, a Raspberry Pi, an ultrabook", "parts of a core, in network namespaces", "one machine has to do"],
    ["a data centre, wireless networks", "delay, rate and loss between network namespaces", "one machine has to do"],
    ["KinectFusion's SLAMBench", "the same three phases, told by laser_slam", "it needs a depth camera's data set"],
];

#[derive(Serialize)]
struct ReportFile<'a> {
    made: String,
    machine: MachineDescription,
    sections: &'a [Section],
    measured: Option<(String, String)>,
    runs: BTreeMap<String, Value>,
}

/// Writes report.html, report.json (with the raw results of `cells`) and one file per figure into `target`; returns
/// whether nothing is missing.
pub fn write(target: &Path, sections: &[Section], cells: &RunCache) -> Result<bool> {
    let figures = target.join("figures");
    std::fs::create_dir_all(&figures).with_context(|| figures.display().to_string())?;
    for figure in sections.iter().flat_map(|section| &section.figures) {
        let (ending, bytes) = match &figure.image {
            FigureImage::Svg(text) => ("svg", text.as_bytes()),
            FigureImage::Png(bytes) => ("png", &bytes[..]),
        };
        std::fs::write(figures.join(format!("{}.{ending}", figure.id)), bytes)?;
    }
    let machine = MachineDescription::describe();
    let told = format!(
        "{} × {}, {} GiB, {}, Linux {}",
        machine.processors, machine.processor, machine.memory_gib, machine.system, machine.kernel
    );
    let (made, measured) = (current_date(), cells.dates());
    let from_to = match &measured {
        Some((oldest, newest)) if oldest != newest => {
            format!("{made}, of what was measured from {oldest} to {newest}")
        }
        Some((oldest, _)) => format!("{made}, of what was measured on {oldest}"),
        None => made.clone(),
    };
    let html = target.join("report.html");
    std::fs::write(&html, page::render(sections, &told, &from_to, &STAND_INS))?;
    let whole = ReportFile { made, machine, sections, measured, runs: cells.used_figures() };
    std::fs::write(target.join("report.json"), serde_json::to_vec_pretty(&whole)?)?;
    print_summary(sections);
    println!("the report is {}", html.display());
    Ok(sections.iter().all(|section| section.missing.is_empty()))
}

fn print_summary(sections: &[Section]) {
    for section in sections {
        println!("{}. {}", section.number, section.title);
        for finding in &section.findings {
            println!("   {finding}");
        }
        for missing in &section.missing {
            println!("   NOT measured: {}: {} ({})", missing.what, missing.why, missing.next);
        }
    }
}

/// Returns the current time by this machine's clock.
pub fn current_date() -> String {
    let output = Command::new("date").arg("+%Y-%m-%d %H:%M").output();
    let said = output.map(|output| String::from_utf8_lossy(&output.stdout).trim().to_owned());
    said.unwrap_or_default()
}
