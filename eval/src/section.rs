//! Section of the report for one experiment.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde::{Serialize, Serializer};

use crate::trace::Trace;

/// One experiment, in the order of the report.
#[derive(Debug, Clone, Serialize)]
pub struct Section {
    /// Number of the experiment.
    pub number: u8,
    /// Short unique name; the section's anchor in the page.
    pub id: String,
    /// Title.
    pub title: String,
    /// Results of the publication.
    pub published: String,
    /// Differences to the publication with their reasons, one sentence each.
    pub differs: Vec<String>,
    /// Sentences computed from the figures; disappointing ones include the reason.
    pub findings: Vec<String>,
    /// Figures as numbers.
    pub tables: Vec<Table>,
    /// Figures as images.
    pub figures: Vec<Figure>,
    /// Measurements that could not be made.
    pub missing: Vec<MissingMeasurement>,
}

impl Section {
    /// Creates an empty section.
    pub fn new(number: u8, id: impl Into<String>, title: impl Into<String>) -> Self {
        Self {
            number,
            id: id.into(),
            title: title.into(),
            published: String::new(),
            differs: Vec::new(),
            findings: Vec::new(),
            tables: Vec::new(),
            figures: Vec::new(),
            missing: Vec::new(),
        }
    }

    /// Adds an SVG figure.
    pub fn add_drawing(&mut self, id: impl Into<String>, caption: impl Into<String>, svg: String) {
        self.figures.push(Figure::svg(id, caption, svg));
    }

    /// Lists what a run did not measure because its node ended before it was done.
    pub fn note_early_end(&mut self, what: impl Into<String>, trace: &Trace) {
        if let Some(why) = &trace.node_ended {
            let next = "look at what the node printed";
            self.missing.push(MissingMeasurement::new(what, why, next));
        }
    }
}

/// A table of formatted cells; units are part of the column heads.
#[derive(Debug, Clone, Serialize)]
pub struct Table {
    /// Caption.
    pub caption: String,
    /// Column heads, with units.
    pub head: Vec<String>,
    /// Rows; the first cell is the name of the row.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// Creates a table without rows, of heads parted by ` | `.
    pub fn new(caption: impl Into<String>, head: &str) -> Self {
        Self { caption: caption.into(), head: head.split(" | ").map(str::to_owned).collect(), rows: Vec::new() }
    }

    /// Returns the table with one more row.
    pub fn row<T: Into<String>>(mut self, cells: impl IntoIterator<Item = T>) -> Self {
        self.push(cells);
        self
    }

    /// Adds a row.
    pub fn push<T: Into<String>>(&mut self, cells: impl IntoIterator<Item = T>) {
        self.rows.push(cells.into_iter().map(Into::into).collect());
    }
}

/// A figure with its caption.
#[derive(Debug, Clone, Serialize)]
pub struct Figure {
    /// Name of its file without the extension; unique in the report.
    pub id: String,
    /// Caption.
    pub caption: String,
    /// The image itself.
    pub image: FigureImage,
}

impl Figure {
    /// Creates a figure from an SVG document.
    pub fn svg(id: impl Into<String>, caption: impl Into<String>, text: impl Into<String>) -> Self {
        Self { id: id.into(), caption: caption.into(), image: FigureImage::Svg(text.into()) }
    }

    /// Creates a figure from a PNG file.
    pub fn png(id: impl Into<String>, caption: impl Into<String>, bytes: Vec<u8>) -> Self {
        Self { id: id.into(), caption: caption.into(), image: FigureImage::Png(bytes) }
    }
}

/// Content of an image file.
#[derive(Debug, Clone, Serialize)]
pub enum FigureImage {
    /// Text of an SVG document.
    Svg(String),
    /// Bytes of a PNG file; base64 in JSON.
    Png(#[serde(serialize_with = "encode_base64")] Vec<u8>),
}

/// Next step after a failed run.
pub const AGAIN: &str = "run make eval again: what was measured stays";

/// A measurement that could not be made.
#[derive(Debug, Clone, Serialize)]
pub struct MissingMeasurement {
    /// Measurement that should have been made.
    pub what: String,
    /// Reason.
    pub why: String,
    /// Next step.
    pub next: String,
}

impl MissingMeasurement {
    /// Creates an entry from these three texts.
    pub fn new(what: impl Into<String>, why: impl Into<String>, next: impl Into<String>) -> Self {
        Self { what: what.into(), why: why.into(), next: next.into() }
    }

    /// Creates an entry for something that may succeed in another run.
    pub fn retryable(what: impl Into<String>, why: impl Into<String>) -> Self {
        Self::new(what, why, AGAIN)
    }
}

fn encode_base64<S: Serializer>(bytes: &[u8], to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(&STANDARD.encode(bytes))
}
