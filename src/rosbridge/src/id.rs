//! Id of an interaction.

use std::borrow::Cow;
use std::fmt;

/// An arbitrary string or integer, repeated in answers so that the client can match them.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Id<'a> {
    /// A string, as most clients use.
    Text(Cow<'a, str>),
    /// An integer, as used by clients that count.
    Integer(i64),
}

impl Id<'_> {
    /// Returns an id that does not borrow from the frame.
    pub fn into_owned(self) -> Id<'static> {
        match self {
            Id::Text(text) => Id::Text(Cow::Owned(text.into_owned())),
            Id::Integer(number) => Id::Integer(number),
        }
    }
}

impl fmt::Display for Id<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Id::Text(text) => f.write_str(text),
            Id::Integer(number) => write!(f, "{number}"),
        }
    }
}

impl<'a> From<&'a str> for Id<'a> {
    fn from(text: &'a str) -> Self {
        Id::Text(Cow::Borrowed(text))
    }
}

impl From<String> for Id<'static> {
    fn from(text: String) -> Self {
        Id::Text(Cow::Owned(text))
    }
}

/// Splits the id off a name: old clients wrote a call with id 7 as `/service#7`.
pub(crate) fn split_name<'a>(name: Cow<'a, str>, id: Option<Id<'a>>) -> (Cow<'a, str>, Option<Id<'a>>) {
    let Some(at) = name.find('#') else {
        return (name, id);
    };
    let suffix = Id::from(name[at + 1..].to_owned());
    let name = match name {
        Cow::Borrowed(name) => Cow::Borrowed(&name[..at]),
        Cow::Owned(mut name) => {
            name.truncate(at);
            Cow::Owned(name)
        }
    };
    (name, id.or(Some(suffix)))
}
