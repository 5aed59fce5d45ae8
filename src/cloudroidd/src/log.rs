//! The daemon's log: one line per event on standard error, as text or as JSON, within the spans that say what it is
//! about.

use std::io::IsTerminal;

use clap::ValueEnum;
use serde::Deserialize;
use tracing::Dispatch;
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::writer::BoxMakeWriter;
use tracing_subscriber::util::SubscriberInitExt;

/// Format of the log's lines.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum LogFormat {
    /// Lines for people.
    #[default]
    Text,
    /// One JSON object per line.
    Json,
}

/// Starts writing the log to standard error: what `CLOUDROID_LOG` selects, from level `info` by default.
pub fn start(format: LogFormat) {
    let filter = EnvFilter::try_from_env("CLOUDROID_LOG").unwrap_or_else(|_| EnvFilter::new("info"));
    let has_colours = std::io::stderr().is_terminal();
    let writer = BoxMakeWriter::new(std::io::stderr);
    make_log(format, filter, writer, has_colours).init();
}

fn make_log(format: LogFormat, filter: EnvFilter, writer: BoxMakeWriter, has_colours: bool) -> Dispatch {
    let lines =
        tracing_subscriber::fmt().with_env_filter(filter).with_writer(writer).with_ansi(has_colours).with_target(false);
    match format {
        LogFormat::Text => Dispatch::new(lines.finish()),
        LogFormat::Json => Dispatch::new(lines.json().finish()),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::sync::Arc;

    use tracing::dispatcher;
    use tracing::field::Empty;

    use super::*;

    /// Returns the line that the log has of an event within a servant's span and a node's.
    fn line_of_event(format: LogFormat) -> String {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let writer = Arc::new(file.reopen().expect("it exists"));
        let filter = EnvFilter::new("warn");
        let log = make_log(format, filter, BoxMakeWriter::new(writer), false);
        dispatcher::with_default(&log, || {
            let servant = tracing::error_span!("servant", id = "s-1", robot = Empty);
            servant.record("robot", "r2d2");
            let node = tracing::error_span!(parent: &servant, "node", node = "/camera");
            node.in_scope(|| tracing::warn!(topic = "/image", "it is late"));
        });
        fs::read_to_string(file.path()).expect("written")
    }

    #[test]
    fn a_line_of_text_says_what_it_is_about() {
        let line = line_of_event(LogFormat::Text);
        let about = "servant{id=\"s-1\" robot=\"r2d2\"}:node{node=\"/camera\"}: it is late";
        assert!(line.contains(about), "{line}");
    }

    #[test]
    fn a_line_of_json_has_its_spans() {
        let line = line_of_event(LogFormat::Json);
        let line: serde_json::Value = serde_json::from_str(&line).expect("one object");
        assert_eq!(line["level"], "WARN");
        assert_eq!(line["fields"]["message"], "it is late");
        assert_eq!(line["fields"]["topic"], "/image");
        let node = serde_json::json!({ "name": "node", "node": "/camera" });
        let servant = serde_json::json!({ "name": "servant", "id": "s-1", "robot": "r2d2" });
        assert_eq!(line["span"], node);
        assert_eq!(line["spans"], serde_json::json!([servant, node]));
    }
}
