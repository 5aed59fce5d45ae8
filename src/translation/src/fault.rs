//! Errors on their way up: they collect the path of the field while they propagate, so that messages without errors pay
//! nothing for it.

use ros_message::codec::{CodecError, CodecErrorKind};

/// An error and the segments of its path, innermost first. Boxed, so that results on the hot path stay one word.
#[derive(Debug)]
pub(crate) struct Fault(Box<(CodecErrorKind, Vec<Segment>)>);

#[derive(Debug)]
enum Segment {
    Field(Box<str>),
    Index(usize),
}

impl From<CodecErrorKind> for Fault {
    #[cold]
    fn from(kind: CodecErrorKind) -> Fault {
        Fault(Box::new((kind, Vec::new())))
    }
}

impl Fault {
    /// Adds the path of a field; an empty one is the message itself.
    #[cold]
    pub(crate) fn in_field(mut self, path: &str) -> Fault {
        if !path.is_empty() {
            self.0.1.push(Segment::Field(path.into()));
        }
        self
    }

    /// Adds the position in an array.
    #[cold]
    pub(crate) fn at_index(mut self, index: usize) -> Fault {
        self.0.1.push(Segment::Index(index));
        self
    }

    /// Returns the error for a message of type `type_name`.
    #[cold]
    pub(crate) fn into_codec_error(self, type_name: &str) -> CodecError {
        let (kind, segments) = *self.0;
        let mut path = String::new();
        for segment in segments.iter().rev() {
            match segment {
                Segment::Field(name) if path.is_empty() => path.push_str(name),
                Segment::Field(name) => {
                    path.push('.');
                    path.push_str(name);
                }
                Segment::Index(index) => path.push_str(&format!("[{index}]")),
            }
        }
        CodecError { type_name: type_name.to_owned(), path, kind }
    }
}
