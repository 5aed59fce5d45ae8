//! YAML as it is read from its beginning to its end, each part with its line.

use saphyr_parser::{Event, Parser, StrInput};

/// What is wrong with a text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Counted from 1.
    pub line: usize,
    /// The reason.
    pub reason: String,
}

impl Problem {
    /// In this line, for this reason.
    pub fn new(line: usize, reason: impl Into<String>) -> Problem {
        Problem {
            line,
            reason: reason.into(),
        }
    }
}

/// The parts of a text.
pub struct Events<'a>(Parser<'a, StrInput<'a>>);

impl<'a> Events<'a> {
    /// Those of this text.
    pub fn of(text: &'a str) -> Events<'a> {
        Events(Parser::new_from_str(text))
    }

    /// The next one, and its line; at the end [`Event::StreamEnd`] again and again.
    pub fn next(&mut self) -> Result<(Event<'a>, usize), Problem> {
        match self.0.next_event() {
            Some(Ok((event, span))) => Ok((event, span.start.line())),
            Some(Err(error)) => Err(Problem::new(error.marker().line(), error.info())),
            None => Ok((Event::StreamEnd, 0)),
        }
    }
}
