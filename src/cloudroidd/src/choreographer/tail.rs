//! Reading a servant's log from its file: JSON lines, rotated once.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};

use servant::engine::LogLine;

use crate::state;

/// The last `count` lines of the log at `path`, oldest first; of one node alone where one is named. Lines that
/// cannot be read are passed over.
pub fn read(path: &Path, count: usize, node: Option<&str>) -> Vec<LogLine> {
    let mut last = VecDeque::new();
    for file in [rotated(path), path.to_owned()] {
        let Ok(file) = File::open(file) else { continue };
        for line in BufReader::new(file).lines().map_while(Result::ok) {
            let Ok(entry) = serde_json::from_str::<LogLine>(&line) else {
                continue;
            };
            if node.is_some_and(|node| node != entry.node) {
                continue;
            }
            if last.len() == count {
                last.pop_front();
            }
            if count > 0 {
                last.push_back(entry);
            }
        }
    }
    last.into()
}

/// A line as the API shows it.
pub fn record(line: LogLine) -> api::LogLine {
    api::LogLine {
        time: state::millis(line.time),
        node: line.node,
        stream: line.stream,
        line: line.line,
    }
}

fn rotated(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".1");
    name.into()
}

#[cfg(test)]
mod tests {
    use std::time::SystemTime;

    use super::*;

    fn line(node: &str, text: &str) -> String {
        let entry = LogLine {
            time: SystemTime::UNIX_EPOCH,
            node: node.into(),
            stream: "stdout".into(),
            line: text.into(),
        };
        serde_json::to_string(&entry).expect("plain data") + "\n"
    }

    #[test]
    fn the_last_lines_are_found_across_the_rotation() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("log.jsonl");
        let texts = |count, node| -> Vec<String> {
            read(&path, count, node)
                .into_iter()
                .map(|line| line.line)
                .collect()
        };
        assert!(texts(5, None).is_empty(), "no log yet");
        std::fs::write(rotated(&path), line("/a", "1") + &line("/b", "2")).expect("written");
        std::fs::write(&path, line("/a", "3") + "{torn").expect("written");
        assert_eq!(texts(2, None), ["2", "3"]);
        assert_eq!(texts(9, Some("/a")), ["1", "3"]);
        assert!(texts(0, None).is_empty());
    }
}
