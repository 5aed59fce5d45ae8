//! Section of the report for one experiment: stored as JSON next to its figures, so that a later run can show it again.

use serde::{Deserialize, Serialize};

/// One experiment, in the order of the report.
#[derive(Debug, Clone, Serialize, Deserialize)]
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
}

/// A table of formatted cells; units are part of the column heads.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Table {
    /// Caption.
    pub caption: String,
    /// Column heads, with units.
    pub head: Vec<String>,
    /// Rows; the first cell is the name of the row.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// Creates a table without rows.
    pub fn new<T: Into<String>>(
        caption: impl Into<String>,
        head: impl IntoIterator<Item = T>,
    ) -> Self {
        Self {
            caption: caption.into(),
            head: head.into_iter().map(Into::into).collect(),
            rows: Vec::new(),
        }
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
#[derive(Debug, Clone, Serialize, Deserialize)]
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
        Self {
            id: id.into(),
            caption: caption.into(),
            image: FigureImage::Svg(text.into()),
        }
    }

    /// Creates a figure from a PNG file.
    pub fn png(id: impl Into<String>, caption: impl Into<String>, bytes: Vec<u8>) -> Self {
        Self {
            id: id.into(),
            caption: caption.into(),
            image: FigureImage::Png(bytes),
        }
    }
}

/// Content of an image file.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub enum FigureImage {
    /// Text of an SVG document.
    Svg(String),
    /// Bytes of a PNG file; base64 in JSON.
    Png(#[serde(with = "as_base64")] Vec<u8>),
}

/// Next step after a failed run.
pub const AGAIN: &str = "run make eval again: what was measured stays";

/// A measurement that could not be made.
#[derive(Debug, Clone, Serialize, Deserialize)]
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
        Self {
            what: what.into(),
            why: why.into(),
            next: next.into(),
        }
    }

    /// Creates an entry for something that may succeed in another run.
    pub fn retryable(what: impl Into<String>, why: impl Into<String>) -> Self {
        Self::new(what, why, AGAIN)
    }
}

mod as_base64 {
    use base64::Engine;
    use base64::engine::general_purpose::STANDARD;
    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    pub(super) fn serialize<S: Serializer>(bytes: &[u8], to: S) -> Result<S::Ok, S::Error> {
        to.serialize_str(&STANDARD.encode(bytes))
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<u8>, D::Error> {
        let text = String::deserialize(from)?;
        STANDARD.decode(text).map_err(D::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_section_comes_back_from_json() {
        let mut section = Section::new(7, "map", "A real robot's map");
        section.tables.push(
            Table::new("error", ["set-up", "RMSE (m)"])
                .row(["native", "0.21"])
                .row(vec!["stub".to_owned(), "0.20".to_owned()]),
        );
        section.figures.push(Figure::svg("plot", "a", "<svg/>"));
        section
            .figures
            .push(Figure::png("map", "b", vec![0x89, b'P', 0, 255]));
        section
            .missing
            .push(MissingMeasurement::new("GPU", "none", "buy one"));
        let text = serde_json::to_string(&section).expect("it is plain data");
        assert!(text.contains(r#"{"Png":"iVAA/w=="}"#), "{text}");
        let again: Section = serde_json::from_str(&text).expect("it was just written");
        assert_eq!(again.tables[0].rows, section.tables[0].rows);
        assert_eq!(again.number, 7);
        let FigureImage::Png(bytes) = &again.figures[1].image else {
            panic!("{:?}", again.figures[1]);
        };
        assert_eq!(bytes, &[0x89, b'P', 0, 255]);
    }

    #[test]
    fn a_picture_that_is_not_base64_is_refused() {
        assert!(serde_json::from_str::<FigureImage>(r#"{"Png":"*"}"#).is_err());
    }
}
