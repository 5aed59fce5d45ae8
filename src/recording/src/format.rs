//! Which ROS the messages of a file are of, in the words of MCAP's registry (<https://mcap.dev/spec/registry>), which are
//! those of Foxglove's protocol, too.

/// How messages and their definitions are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Format {
    /// As ROS 1 does.
    #[default]
    Ros1,
    /// As ROS 2 does.
    Ros2,
}

impl Format {
    /// What a file is said to be.
    pub fn profile(self) -> &'static str {
        match self {
            Self::Ros1 => "ros1",
            Self::Ros2 => "ros2",
        }
    }

    /// How messages are written.
    pub fn encoding(self) -> &'static str {
        match self {
            Self::Ros1 => "ros1",
            Self::Ros2 => "cdr",
        }
    }

    /// How their definitions are written: the text of the message, followed by those of all that it contains.
    pub fn schema(self) -> &'static str {
        match self {
            Self::Ros1 => "ros1msg",
            Self::Ros2 => "ros2msg",
        }
    }

    /// The one whose messages are written so; none where it is neither.
    pub fn of_encoding(encoding: &str) -> Option<Self> {
        let all = [Self::Ros1, Self::Ros2];
        all.into_iter().find(|one| one.encoding() == encoding)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_format_is_found_by_how_messages_are_written() {
        assert_eq!(Format::of_encoding("cdr"), Some(Format::Ros2));
        assert_eq!(Format::of_encoding("ros1"), Some(Format::Ros1));
        assert_eq!(Format::of_encoding("json"), None);
    }
}
