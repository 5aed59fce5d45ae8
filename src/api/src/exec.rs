//! Exec sessions (`GET /api/v1/servants/ID/exec`): a WebSocket whose binary messages are frames. The first byte of a
//! frame is its channel, the rest its content.
//!
//! | channel | from | content |
//! |---|---|---|
//! | 0 | client | standard input; without content, its end |
//! | 1 | daemon | standard output, or all that a terminal shows |
//! | 2 | daemon | standard error |
//! | 3 | client | new size of the terminal: columns, rows (two bytes each, big-endian) |
//! | 4 | daemon | exit status (four bytes, big-endian); the last frame. 128 more than the number of a signal |

/// WebSocket subprotocol of an exec session.
pub const PROTOCOL: &str = "exec.v1.cloudroid";

/// Maximum length of a frame's content in bytes.
pub const MAX_CONTENT: usize = 64 << 10;

const INPUT: u8 = 0;
const OUTPUT: u8 = 1;
const ERROR: u8 = 2;
const SIZE: u8 = 3;
const EXIT: u8 = 4;

/// Size of a terminal in characters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TerminalSize {
    /// Number of columns.
    pub columns: u16,
    /// Number of rows.
    pub rows: u16,
}

/// A frame of an exec session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExecFrame<'a> {
    /// Standard input; empty at its end.
    Input(&'a [u8]),
    /// Standard output.
    Output(&'a [u8]),
    /// Standard error.
    Error(&'a [u8]),
    /// New size of the terminal.
    Size(TerminalSize),
    /// Exit status of the program, with which the session ends.
    Exit(i32),
}

impl<'a> ExecFrame<'a> {
    /// Decodes a binary message; `None` if it is malformed or too long.
    pub fn decode(message: &'a [u8]) -> Option<ExecFrame<'a>> {
        let (channel, content) = message.split_first()?;
        if content.len() > MAX_CONTENT {
            return None;
        }
        match *channel {
            INPUT => Some(ExecFrame::Input(content)),
            OUTPUT => Some(ExecFrame::Output(content)),
            ERROR => Some(ExecFrame::Error(content)),
            SIZE => {
                let [c0, c1, r0, r1] = *<&[u8; 4]>::try_from(content).ok()?;
                let (columns, rows) = (u16::from_be_bytes([c0, c1]), u16::from_be_bytes([r0, r1]));
                Some(ExecFrame::Size(TerminalSize { columns, rows }))
            }
            EXIT => Some(ExecFrame::Exit(i32::from_be_bytes(content.try_into().ok()?))),
            _ => None,
        }
    }

    /// Encodes the frame as a binary message.
    pub fn encode(self) -> Vec<u8> {
        let with_content = |channel, content: &[u8]| [&[channel][..], content].concat();
        match self {
            ExecFrame::Input(content) => with_content(INPUT, content),
            ExecFrame::Output(content) => with_content(OUTPUT, content),
            ExecFrame::Error(content) => with_content(ERROR, content),
            ExecFrame::Size(TerminalSize { columns, rows }) => {
                with_content(SIZE, &[columns.to_be_bytes(), rows.to_be_bytes()].concat())
            }
            ExecFrame::Exit(status) => with_content(EXIT, &status.to_be_bytes()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_read_as_they_are_written() {
        let size = TerminalSize { columns: 211, rows: 300 };
        for frame in [
            ExecFrame::Input(b"ls\n"),
            ExecFrame::Input(b""),
            ExecFrame::Output(b"\0\xff"),
            ExecFrame::Error(b"no"),
            ExecFrame::Size(size),
            ExecFrame::Exit(137),
            ExecFrame::Exit(-1),
        ] {
            assert_eq!(ExecFrame::decode(&frame.encode()), Some(frame));
        }
        assert_eq!(ExecFrame::Size(size).encode(), [3, 0, 211, 1, 44]);
    }

    #[test]
    fn what_is_no_frame_is_not_read() {
        for message in [&[][..], &[5, 1], &[3, 0, 80, 0], &[3, 0, 80, 0, 24, 0], &[4], &[4, 0, 0, 0, 0, 0]] {
            assert_eq!(ExecFrame::decode(message), None, "{message:?}");
        }
        let longest = vec![INPUT; 1 + MAX_CONTENT];
        assert!(ExecFrame::decode(&longest).is_some());
        assert_eq!(ExecFrame::decode(&[&longest[..], &[0]].concat()), None);
    }
}
