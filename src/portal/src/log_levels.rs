//! Severity of a line of a servant's log, as its node's console output states it.
//!
//! | library | format |
//! |---|---|
//! | roscpp | `[ INFO] [1700000000.123456789]: text`, in colour |
//! | rospy | `[INFO] [1700000000.123456]: text`, warnings and errors in colour |
//! | ROS 2 | `[INFO] [1700000000.123456789] [node]: text` |
//!
//! The stream says nothing: ROS 2 prints everything on standard error.

use api::LogLevel;
use foreign::terminal;

/// Finds the severity of a line; `None` if it is in no console format of ROS, such as a traceback.
pub fn find_level(line: &str) -> Option<LogLevel> {
    let line = terminal::strip_colours(line);
    let (word, _) = line.strip_prefix('[')?.split_once(']')?;
    match word.trim_start() {
        "DEBUG" => Some(LogLevel::Debug),
        "INFO" => Some(LogLevel::Info),
        "WARN" | "WARNING" => Some(LogLevel::Warn),
        "ERROR" => Some(LogLevel::Error),
        "FATAL" | "CRITICAL" => Some(LogLevel::Fatal),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_have_the_level_that_their_node_gave_them() {
        for (line, level) in [
            ("\x1b[0m[ INFO] [1700000000.123456789]: ready\x1b[0m", Some(LogLevel::Info)),
            ("\x1b[33m[ WARN] [1700000000.123456789, 12.5]: late", Some(LogLevel::Warn)),
            ("\x1b[31m[FATAL] [1700000000.1]: no model", Some(LogLevel::Fatal)),
            ("[INFO] [1700000000.123456]: ready", Some(LogLevel::Info)),
            ("\x1b[31m[ERROR] [1700000000.123456]: no", Some(LogLevel::Error)),
            ("[INFO] [1700000000.123456789] [talker]: ready", Some(LogLevel::Info)),
            ("\x1b[1;33m[WARN] [1700000000.123456789] [talker]: late", Some(LogLevel::Warn)),
            ("[DEBUG] [1700000000.123456789] [rcl]: shutdown", Some(LogLevel::Debug)),
            ("Traceback (most recent call last):", None),
            ("[1, 2, 3]", None),
            ("[INFO", None),
            ("\x1b[2J[INFO] text", None),
            ("ERROR: not of ROS", None),
            ("", None),
        ] {
            assert_eq!(find_level(line), level, "{line}");
        }
    }
}
