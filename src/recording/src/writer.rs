//! Writes messages as they come. Every second what came is written out: whatever ends this, the file can be read up to there.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Cursor, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions};
use serde::Serialize;

use crate::{Error, Format};

/// A file that is being written.
pub struct Writer {
    path: PathBuf,
    format: Format,
    /// The same file, to be asked how large it is: who writes it may not be allowed to look into its directory.
    asked: File,
    file: mcap::Writer<Whole>,
    topics: BTreeMap<u16, Topic>,
    /// Bytes of messages since the last flush.
    pending: usize,
}

/// More bytes of messages than these are not held back.
const PENDING: usize = 8 << 20;

struct Topic {
    name: String,
    of: String,
    messages: u32,
    bytes: u64,
}

/// What a file holds.
#[derive(Debug, Serialize)]
pub struct Summary {
    /// Where it is.
    pub file: PathBuf,
    /// Its size in bytes.
    pub size: u64,
    /// Of all topics.
    pub messages: u64,
    /// By name.
    pub topics: Vec<TopicSummary>,
}

/// What a file holds of one topic.
#[derive(Debug, Serialize)]
pub struct TopicSummary {
    /// Its name.
    pub topic: String,
    /// `package/Type`.
    #[serde(rename = "type")]
    pub of: String,
    /// How many.
    pub messages: u32,
    /// Of them, before they were compressed.
    pub bytes: u64,
}

impl Writer {
    /// Makes a file that is not there yet.
    ///
    /// # Errors
    /// [`Error::NotMade`], [`Error::Unwritable`].
    pub fn create(path: &Path, format: Format) -> Result<Self, Error> {
        let mut options = OpenOptions::new();
        let file = options.write(true).create_new(true).open(path);
        let file = file.map_err(|reason| Error::NotMade {
            path: path.to_owned(),
            reason,
        })?;
        Self::of(path, file, format)
    }

    /// Writes into `file`, which is empty, and is at `path`.
    ///
    /// # Errors
    /// [`Error::Unwritable`].
    pub fn of(path: &Path, file: File, format: Format) -> Result<Self, Error> {
        let asked = file.try_clone().map_err(|reason| Error::NotMade {
            path: path.to_owned(),
            reason,
        })?;
        let options = WriteOptions::new()
            .profile(format.profile())
            .library(concat!("cloudroid ", env!("CARGO_PKG_VERSION")));
        let file = options.create(Whole::of(file)).map_err(unwritable(path))?;
        Ok(Self {
            path: path.to_owned(),
            format,
            asked,
            file,
            topics: BTreeMap::new(),
            pending: 0,
        })
    }

    /// The channel of a topic whose messages are of type `of`, as `definition` says.
    ///
    /// # Errors
    /// [`Error::Unwritable`], as of what follows.
    pub fn channel(&mut self, topic: &str, of: &str, definition: &[u8]) -> Result<u16, Error> {
        let schema = self.file.add_schema(of, self.format.schema(), definition);
        let schema = schema.map_err(unwritable(&self.path))?;
        let encoding = self.format.encoding();
        let channel = self
            .file
            .add_channel(schema, topic, encoding, &BTreeMap::new());
        let channel = channel.map_err(unwritable(&self.path))?;
        self.topics.entry(channel).or_insert_with(|| Topic {
            name: topic.to_owned(),
            of: of.to_owned(),
            messages: 0,
            bytes: 0,
        });
        Ok(channel)
    }

    /// Adds a message that was heard at `time`, in nanoseconds since 1970.
    pub fn add(&mut self, channel_id: u16, time: u64, message: &[u8]) -> Result<(), Error> {
        let mut sequence = 0;
        if let Some(topic) = self.topics.get_mut(&channel_id) {
            sequence = topic.messages;
            topic.messages += 1;
            topic.bytes += message.len() as u64;
        }
        let header = MessageHeader {
            channel_id,
            sequence,
            log_time: time,
            publish_time: time,
        };
        let written = self.file.write_to_known_channel(&header, message);
        written.map_err(unwritable(&self.path))?;
        self.pending += message.len();
        match self.pending > PENDING {
            true => self.flush(),
            false => Ok(()),
        }
    }

    /// Writes out what has come.
    ///
    /// # Errors
    /// [`Error::Unwritable`].
    pub fn flush(&mut self) -> Result<(), Error> {
        self.pending = 0;
        self.file.flush().map_err(unwritable(&self.path))
    }

    /// How many messages there are by now.
    pub fn messages(&self) -> u64 {
        let all = self.topics.values();
        all.map(|topic| u64::from(topic.messages)).sum()
    }

    /// Ends the file with its index.
    pub fn finish(mut self) -> Result<Summary, Error> {
        self.file.finish().map_err(unwritable(&self.path))?;
        let messages = self.messages();
        let mut topics: Vec<_> = self
            .topics
            .into_values()
            .map(|topic| TopicSummary {
                topic: topic.name,
                of: topic.of,
                messages: topic.messages,
                bytes: topic.bytes,
            })
            .collect();
        topics.sort_by(|a, b| a.topic.cmp(&b.topic));
        let size = self.asked.metadata().map_or(0, |found| found.len());
        Ok(Summary {
            file: self.path,
            size,
            messages,
            topics,
        })
    }
}

/// A file that is given whole chunks alone, by `flush`: half a chunk with the length of none could not be read, nor what comes before it
/// by every program.
struct Whole {
    file: File,
    /// Where the file ends.
    end: u64,
    next: Cursor<Vec<u8>>,
}

impl Whole {
    fn of(file: File) -> Self {
        Self {
            file,
            end: 0,
            next: Cursor::default(),
        }
    }
}

impl Write for Whole {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.next.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        let next = std::mem::take(&mut self.next).into_inner();
        self.end += next.len() as u64;
        self.file.write_all(&next)
    }
}

impl Seek for Whole {
    /// Within what was not flushed yet.
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let to = match to {
            SeekFrom::Start(at) => match at.checked_sub(self.end) {
                Some(at) => SeekFrom::Start(at),
                None => return Err(io::ErrorKind::InvalidInput.into()),
            },
            other => other,
        };
        Ok(self.end + self.next.seek(to)?)
    }
}

fn unwritable(path: &Path) -> impl FnOnce(McapError) -> Error {
    |reason| Error::Unwritable {
        path: path.to_owned(),
        reason,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reader;

    #[test]
    fn a_file_of_ros_2_says_so() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("two.mcap");
        let mut writer = Writer::create(&path, Format::Ros2).expect("a new file");
        let channel = writer.channel("/chatter", "std_msgs/msg/String", b"string data");
        let message = [0, 1, 0, 0, 2, 0, 0, 0, b'a', 0];
        writer
            .add(channel.expect("a channel"), 7, &message)
            .expect("is written");
        writer.finish().expect("an end");
        let bytes = std::fs::read(&path).expect("it is there");
        // Magic, opcode and length of the header, and its first text.
        assert_eq!(&bytes[17..25], b"\x04\0\0\0ros2");
        let summary = mcap::Summary::read(&bytes)
            .expect("it is whole")
            .expect("a summary");
        let channel = summary.channels.values().next().expect("a channel");
        assert_eq!(channel.message_encoding, "cdr");
        let schema = channel.schema.as_ref().expect("a schema");
        assert_eq!(
            (&*schema.name, &*schema.encoding),
            ("std_msgs/msg/String", "ros2msg")
        );
        let mut reader = Reader::open(&path).expect("it opens");
        let played = reader
            .next_message()
            .expect("it is read")
            .expect("a message");
        assert_eq!(Format::of_encoding(&played.encoding), Some(Format::Ros2));
        assert_eq!((played.time, &*played.message), (7, &message[..]));
    }

    #[test]
    fn what_is_written_is_read_and_a_file_that_breaks_off_up_to_there() {
        let place = tempfile::tempdir().expect("a directory");
        let path = place.path().join("x.mcap");
        let mut writer = Writer::create(&path, Format::Ros1).expect("a new file");
        let text = writer.channel("/chatter", "std_msgs/String", b"string data");
        let text = text.expect("a channel");
        let same = writer.channel("/chatter", "std_msgs/String", b"string data");
        assert_eq!(same.expect("the same"), text);
        for time in 1..=3 {
            let message = format!("word {time}");
            writer
                .add(text, time, message.as_bytes())
                .expect("is written");
        }
        writer.flush().expect("is written");
        // What comes then, in no chunk that is complete, is not there if this is the end.
        for time in 4..1000 {
            writer.add(text, time, &[b'x'; 1000]).expect("is written");
        }
        let cut = place.path().join("cut.mcap");
        std::fs::copy(&path, &cut).expect("a copy");
        let summary = writer.finish().expect("an end");
        assert_eq!((summary.messages, summary.topics[0].messages), (999, 999));
        assert_eq!(summary.topics[0].bytes, 3 * 6 + 996 * 1000);

        let read = |path: &Path| {
            let mut reader = Reader::open(path).expect("it opens");
            let mut found = Vec::new();
            while let Some(played) = reader.next_message().expect("it is read") {
                assert_eq!(played.topic, "/chatter");
                assert_eq!(played.of, "std_msgs/String");
                found.push((played.time, played.message.to_vec()));
            }
            (found, reader.breaks_off())
        };
        let words: Vec<_> = (1..=3)
            .map(|time| (time, format!("word {time}").into_bytes()))
            .collect();
        assert_eq!(read(&cut), (words.clone(), true));
        let (all, breaks_off) = read(&path);
        assert_eq!((&all[..3], all.len(), breaks_off), (&words[..], 999, false));
        // Wherever it is cut, all that came before is read.
        let whole = std::fs::read(&path).expect("it is there");
        for end in (600..whole.len()).step_by(101) {
            std::fs::write(&cut, &whole[..end]).expect("is written");
            let (found, breaks_off) = read(&cut);
            assert!(breaks_off && all.starts_with(&found), "cut at {end}");
        }

        let error = Writer::create(&path, Format::Ros1)
            .err()
            .expect("it is there");
        assert!(error.to_string().contains("exists"), "{error}");
    }
}
