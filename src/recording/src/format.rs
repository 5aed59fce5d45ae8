//! ROS version of a file's messages, by the names of MCAP's registry (<https://mcap.dev/spec/registry>), which
//! Foxglove's protocol uses as well.

/// Encoding of messages and their definitions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum RecordingFormat {
    /// ROS 1.
    #[default]
    Ros1,
    /// ROS 2.
    Ros2,
}

impl RecordingFormat {
    /// Returns the MCAP profile.
    pub fn profile(self) -> &'static str {
        match self {
            Self::Ros1 => "ros1",
            Self::Ros2 => "ros2",
        }
    }

    /// Returns the message encoding.
    pub fn encoding(self) -> &'static str {
        match self {
            Self::Ros1 => "ros1",
            Self::Ros2 => "cdr",
        }
    }

    /// Returns the schema encoding: the message text followed by the texts of all types it contains.
    pub fn schema(self) -> &'static str {
        match self {
            Self::Ros1 => "ros1msg",
            Self::Ros2 => "ros2msg",
        }
    }

    /// Returns the format with this message encoding, if there is one.
    pub fn from_encoding(encoding: &str) -> Option<Self> {
        let all = [Self::Ros1, Self::Ros2];
        all.into_iter().find(|one| one.encoding() == encoding)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_format_is_found_by_how_messages_are_written() {
        assert_eq!(RecordingFormat::from_encoding("cdr"), Some(RecordingFormat::Ros2));
        assert_eq!(RecordingFormat::from_encoding("ros1"), Some(RecordingFormat::Ros1));
        assert_eq!(RecordingFormat::from_encoding("json"), None);
    }
}
