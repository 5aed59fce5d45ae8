//! Section of the report for one experiment.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Serialize, Serializer};

use crate::trace::Trace;

/// Facts of an experiment that are known before it runs.
#[derive(Debug, Clone, Copy)]
pub struct About {
    pub number: u8,
    /// Short unique name; the section's anchor in the page.
    pub id: &'static str,
    pub title: &'static str,
    pub published: &'static str,
    /// Differences to the publication with their reasons.
    pub differs: &'static [&'static str],
}

impl About {
    /// Creates the section of the experiment, without results.
    pub fn section(&self) -> Section {
        let mut section = Section::new(self.number, self.id, self.title);
        section.published = self.published.to_owned();
        section.differs = self.differs.iter().map(|one| (*one).to_owned()).collect();
        section
    }
}

/// One experiment, in the order of the report.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Section {
    pub number: u8,
    /// Short unique name; the section's anchor in the page.
    pub id: String,
    pub title: String,
    pub published: String,
    /// Differences to the publication with their reasons, one sentence each.
    pub differs: Vec<String>,
    /// Sentences computed from the figures; disappointing ones say so.
    pub findings: Vec<String>,
    pub tables: Vec<Table>,
    pub figures: Vec<Figure>,
    pub missing: Vec<MissingMeasurement>,
}

impl Section {
    pub fn new(number: u8, id: impl Into<String>, title: impl Into<String>) -> Self {
        Self { number, id: id.into(), title: title.into(), ..Self::default() }
    }

    pub fn add_drawing(&mut self, id: impl Into<String>, caption: impl Into<String>, svg: String) {
        self.figures.push(Figure { id: id.into(), caption: caption.into(), image: FigureImage::Svg(svg) });
    }

    /// Lists something that could not be measured, and the next step.
    pub fn add_missing(&mut self, what: impl Into<String>, why: impl Into<String>, next: &str) {
        self.missing.push(MissingMeasurement::new(what, why, next));
    }

    /// Lists what a run did not measure because its node ended before it was done.
    pub fn note_early_end(&mut self, what: &str, trace: &Trace) {
        if let Some(why) = &trace.node_ended {
            let answered = trace.requests.len();
            self.add_missing(format!("{what}: after request {answered}"), why, "look at what the node printed");
        }
    }
}

/// A table of formatted cells; units are part of the column heads.
#[derive(Debug, Clone, Serialize)]
pub struct Table {
    pub caption: String,
    pub head: Vec<String>,
    /// Rows; the first cell is the name of the row.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// Creates a table without rows, of heads parted by ` | `.
    pub fn new(caption: impl Into<String>, head: &str) -> Self {
        Self { caption: caption.into(), head: head.split(" | ").map(str::to_owned).collect(), rows: Vec::new() }
    }

    pub fn push<T: Into<String>>(&mut self, cells: impl IntoIterator<Item = T>) {
        self.rows.push(cells.into_iter().map(Into::into).collect());
    }
}

/// A figure with its caption.
#[derive(Debug, Clone, Serialize)]
pub struct Figure {
    /// Name of its file without the extension; unique in the report.
    pub id: String,
    pub caption: String,
    pub image: FigureImage,
}

impl Figure {
    pub fn png(id: impl Into<String>, caption: impl Into<String>, bytes: Vec<u8>) -> Self {
        Self { id: id.into(), caption: caption.into(), image: FigureImage::Png(bytes) }
    }
}

/// Content of an image file.
#[derive(Debug, Clone, Serialize)]
pub enum FigureImage {
    Svg(String),
    /// Bytes of a PNG file; base64 in JSON.
    Png(#[serde(serialize_with = "encode_base64")] Vec<u8>),
}

/// Next step after a failed run.
pub const AGAIN: &str = "run make eval again: what was measured stays";

/// A measurement that could not be made.
#[derive(Debug, Clone, Serialize)]
pub struct MissingMeasurement {
    pub what: String,
    pub why: String,
    pub next: String,
}

impl MissingMeasurement {
    pub fn new(what: impl Into<String>, why: impl Into<String>, next: impl Into<String>) -> Self {
        Self { what: what.into(), why: why.into(), next: next.into() }
    }
}

fn encode_base64<S: Serializer>(bytes: &[u8], to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(&STANDARD.encode(bytes))
}
