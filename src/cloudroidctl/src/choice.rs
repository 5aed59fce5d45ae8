//! Choice of the output, as `--format`, `-o` and `-q` name it. The process makes it once, before the verb runs.

use std::sync::OnceLock;

/// Output as chosen on the command line.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum OutputChoice {
    /// Aligned columns, for people.
    Table,
    /// All columns of a table.
    Wide,
    /// Only names or ids, one per line, of verbs that list.
    Name,
    /// JSON, for programs; streams as one value per line.
    Json,
    /// YAML, for programs; streams as one document per value.
    Yaml,
}

/// Kind of output that a verb distinguishes: text for people, or values for programs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputFormat {
    /// Text for people.
    Table,
    /// Values for programs: JSON or YAML.
    Json,
}

static CHOICE: OnceLock<OutputChoice> = OnceLock::new();

impl OutputChoice {
    /// Makes this the choice of the process, unless there is one already; returns the kind of output that it means.
    pub fn apply(self) -> OutputFormat {
        let chosen = CHOICE.get_or_init(|| self);
        match chosen {
            OutputChoice::Table | OutputChoice::Wide | OutputChoice::Name => OutputFormat::Table,
            OutputChoice::Json | OutputChoice::Yaml => OutputFormat::Json,
        }
    }

    /// Returns the choice of the process.
    pub fn current() -> OutputChoice {
        CHOICE.get().copied().unwrap_or(OutputChoice::Table)
    }
}
