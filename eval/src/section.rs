//! What the report shows of one experiment: kept as JSON beside its figures, so that a later run can show it again.

use serde::{Deserialize, Serialize};

/// One experiment, in the order in which the report shows its parts.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Section {
    /// Its row in the list of experiments.
    pub number: u8,
    /// Short, unique; the section's anchor in the page.
    pub id: String,
    /// What was asked.
    pub title: String,
    /// What the publication reported.
    pub published: String,
    /// What is different here, and why: one sentence each.
    pub differs: Vec<String>,
    /// Sentences computed from the figures; those that are worse than hoped say why.
    pub findings: Vec<String>,
    /// The figures as numbers.
    pub tables: Vec<Table>,
    /// The figures as pictures.
    pub figures: Vec<Figure>,
    /// What was to be measured and was not.
    pub missing: Vec<Missing>,
}

impl Section {
    /// A section that says nothing yet.
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

    /// Adds a drawing.
    pub fn drawing(&mut self, id: impl Into<String>, caption: impl Into<String>, svg: String) {
        self.figures.push(Figure::svg(id, caption, svg));
    }
}

/// A table whose cells are already text: units belong to its head.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Table {
    /// What it shows.
    pub caption: String,
    /// The columns' names, with their units.
    pub head: Vec<String>,
    /// The first cell names the row.
    pub rows: Vec<Vec<String>>,
}

impl Table {
    /// A table without rows.
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

    /// The table with one more row.
    pub fn row<T: Into<String>>(mut self, cells: impl IntoIterator<Item = T>) -> Self {
        self.push(cells);
        self
    }

    /// Adds a row.
    pub fn push<T: Into<String>>(&mut self, cells: impl IntoIterator<Item = T>) {
        self.rows.push(cells.into_iter().map(Into::into).collect());
    }
}

/// A picture with its caption.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Figure {
    /// The name of its file without the ending; unique in the report.
    pub id: String,
    /// What it shows.
    pub caption: String,
    /// The picture itself.
    pub image: Image,
}

impl Figure {
    /// A drawing.
    pub fn svg(id: impl Into<String>, caption: impl Into<String>, text: impl Into<String>) -> Self {
        Self {
            id: id.into(),
            caption: caption.into(),
            image: Image::Svg(text.into()),
        }
    }

    /// A picture made of pixels.
    pub fn png(id: impl Into<String>, caption: impl Into<String>, bytes: Vec<u8>) -> Self {
        Self {
            id: id.into(),
            caption: caption.into(),
            image: Image::Png(bytes),
        }
    }
}

/// A picture, as its file holds it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub enum Image {
    /// The text of an SVG document.
    Svg(String),
    /// The bytes of a PNG file; base64 in JSON.
    Png(#[serde(with = "as_base64")] Vec<u8>),
}

/// What helps where a run failed.
pub const AGAIN: &str = "run make eval again: what was measured stays";

/// Something that was to be measured and was not.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Missing {
    /// What was to be measured.
    pub what: String,
    /// What prevented it.
    pub why: String,
    /// What would bring it.
    pub next: String,
}

impl Missing {
    /// The three sentences.
    pub fn new(what: impl Into<String>, why: impl Into<String>, next: impl Into<String>) -> Self {
        Self {
            what: what.into(),
            why: why.into(),
            next: next.into(),
        }
    }

    /// Something that another run may bring.
    pub fn again(what: impl Into<String>, why: impl Into<String>) -> Self {
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
        section.missing.push(Missing::new("GPU", "none", "buy one"));
        let text = serde_json::to_string(&section).expect("it is plain data");
        assert!(text.contains(r#"{"Png":"iVAA/w=="}"#), "{text}");
        let again: Section = serde_json::from_str(&text).expect("it was just written");
        assert_eq!(again.tables[0].rows, section.tables[0].rows);
        assert_eq!(again.number, 7);
        let Image::Png(bytes) = &again.figures[1].image else {
            panic!("{:?}", again.figures[1]);
        };
        assert_eq!(bytes, &[0x89, b'P', 0, 255]);
    }

    #[test]
    fn a_picture_that_is_not_base64_is_refused() {
        assert!(serde_json::from_str::<Image>(r#"{"Png":"*"}"#).is_err());
    }
}
