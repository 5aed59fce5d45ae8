//! YAML events in the order of the text, each with its line.

use saphyr_parser::{Event, Parser, StrInput};

/// A syntax or content error in a text. It is displayed without its line, which only a text of several lines has.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{reason}")]
pub struct Problem {
    /// Line number, starting at 1.
    pub line: usize,
    /// Reason for the error.
    pub reason: String,
}

impl Problem {
    /// Creates an error for this line and reason.
    pub fn new(line: usize, reason: impl Into<String>) -> Problem {
        Problem { line, reason: reason.into() }
    }
}

/// A reader of the YAML events in a text.
pub struct YamlEvents<'a>(Parser<'a, StrInput<'a>>);

impl<'a> YamlEvents<'a> {
    /// Creates a reader of this text.
    pub fn new(text: &'a str) -> YamlEvents<'a> {
        YamlEvents(Parser::new_from_str(text))
    }

    /// Returns the next event and its line; after the end, always [`Event::StreamEnd`].
    pub fn next_event(&mut self) -> Result<(Event<'a>, usize), Problem> {
        match self.0.next_event() {
            Some(Ok((event, span))) => Ok((event, span.start.line())),
            Some(Err(error)) => Err(Problem::new(error.marker().line(), error.info())),
            None => Ok((Event::StreamEnd, 0)),
        }
    }
}
