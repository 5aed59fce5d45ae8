//! Wire format of the datagrams.

use std::fmt;

/// Maximum length of a datagram in bytes; a command line with its environment must fit.
pub const MAX_MESSAGE: usize = 128 * 1024;

const START: u8 = 1;
const SIGNAL: u8 = 2;
const READY: u8 = 0x80;
const STARTED: u8 = 0x81;
const FAILED: u8 = 0x82;
const EXITED: u8 = 0x83;

/// A request from the shim to init.
#[derive(Debug, PartialEq)]
pub enum InitRequest<'a> {
    /// Fork and execute a program. Its standard streams are attached as file descriptors.
    Start(Start<'a>),
    /// Send a signal.
    Signal {
        /// Pid in the container; ignored for [`Scope::All`].
        pid: i32,
        /// Signal number.
        signal: i32,
        /// Processes that receive the signal.
        scope: Scope,
    },
}

/// Processes that receive a signal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// The process only.
    Process,
    /// The process group of the process.
    Group,
    /// Every process but init.
    All,
}

/// A request to start a program, as decoded by init.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Start<'a> {
    /// Id chosen by the shim, repeated in the reply.
    pub id: u32,
    /// Number of arguments that follow the directory.
    pub arguments: u16,
    /// Number of `NAME=value` strings that follow the arguments.
    pub variables: u16,
    /// Directory, arguments and variables, each terminated by a zero byte.
    pub strings: &'a [u8],
}

/// A request to start a program, as encoded by the shim.
#[derive(Debug, Clone, Copy)]
pub struct StartRequest<'a> {
    /// Id repeated in the reply.
    pub id: u32,
    /// Working directory; `/` when empty.
    pub directory: &'a str,
    /// Path of the program and its arguments.
    pub argv: &'a [String],
    /// Environment as `NAME=value` strings.
    pub environment: &'a [String],
}

/// Reason why a request cannot be encoded.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EncodeError {
    /// No program is given.
    Empty,
    /// A string contains a zero byte.
    ZeroByte(String),
    /// Arguments and environment together are longer than [`MAX_MESSAGE`] allows.
    TooLong(usize),
}

impl fmt::Display for EncodeError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Empty => write!(formatter, "no program is named: give its absolute path as the first argument"),
            Self::ZeroByte(text) => write!(formatter, "{text:?} holds a zero byte: remove it"),
            Self::TooLong(length) => write!(
                formatter,
                "arguments and environment take {length} bytes, more than the {MAX_MESSAGE} allowed: shorten them"
            ),
        }
    }
}

impl std::error::Error for EncodeError {}

/// A message from init to the shim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InitReply {
    /// Init is ready for requests.
    Ready,
    /// The program was executed; its pidfd is attached.
    Started {
        /// Id of the request.
        id: u32,
        /// Pid in the container.
        pid: i32,
    },
    /// The program could not be started.
    Failed {
        /// Id of the request.
        id: u32,
        /// Error number (errno).
        errno: i32,
        /// Step that failed.
        stage: StartStage,
    },
    /// A process exited: a started one, or an orphan that init had inherited.
    Exited {
        /// Pid in the container.
        pid: i32,
        /// Wait status, as from `waitpid`.
        status: i32,
    },
}

/// Step of a start that failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum StartStage {
    /// Decoding of the request.
    Request = 0,
    /// `fork`.
    Fork = 1,
    /// Setup of session, signals and standard streams.
    Prepare = 2,
    /// Change to the working directory.
    Directory = 3,
    /// `execve`.
    Execute = 4,
}

impl StartStage {
    /// Decodes the byte used on the wire.
    pub fn from_byte(byte: u8) -> Self {
        match byte {
            1 => Self::Fork,
            2 => Self::Prepare,
            3 => Self::Directory,
            4 => Self::Execute,
            _ => Self::Request,
        }
    }
}

impl StartRequest<'_> {
    /// Encodes the request as a datagram.
    pub fn encode(&self) -> Result<Vec<u8>, EncodeError> {
        if self.argv.first().is_none_or(|program| program.is_empty()) {
            return Err(EncodeError::Empty);
        }
        let directory = if self.directory.is_empty() { "/" } else { self.directory };
        let mut out = vec![START];
        out.extend(self.id.to_le_bytes());
        for count in [self.argv.len(), self.environment.len()] {
            out.extend(u16::try_from(count).map_err(|_| EncodeError::TooLong(count))?.to_le_bytes());
        }
        let strings = std::iter::once(directory)
            .chain(self.argv.iter().map(String::as_str))
            .chain(self.environment.iter().map(String::as_str));
        for text in strings {
            if text.contains('\0') {
                return Err(EncodeError::ZeroByte(text.to_owned()));
            }
            out.extend(text.as_bytes());
            out.push(0);
        }
        if out.len() > MAX_MESSAGE { Err(EncodeError::TooLong(out.len())) } else { Ok(out) }
    }
}

impl<'a> InitRequest<'a> {
    /// Decodes a datagram; `None` if it is malformed.
    pub fn decode(bytes: &'a [u8]) -> Option<Self> {
        let (&kind, rest) = bytes.split_first()?;
        match kind {
            START => {
                let (fixed, strings) = rest.split_at_checked(8)?;
                let arguments = u16::from_le_bytes([fixed[4], fixed[5]]);
                let variables = u16::from_le_bytes([fixed[6], fixed[7]]);
                let ended = strings.iter().filter(|byte| **byte == 0).count();
                let complete =
                    strings.last() == Some(&0) && ended == 1 + usize::from(arguments) + usize::from(variables);
                (complete && arguments > 0).then_some(Self::Start(Start {
                    id: read_u32(fixed, 0)?,
                    arguments,
                    variables,
                    strings,
                }))
            }
            SIGNAL => {
                let scope = match rest.get(8)? {
                    0 => Scope::Process,
                    1 => Scope::Group,
                    2 => Scope::All,
                    _ => return None,
                };
                Some(Self::Signal { pid: read_u32(rest, 0)? as i32, signal: read_u32(rest, 4)? as i32, scope })
            }
            _ => None,
        }
    }

    /// Encodes a signal request as a datagram.
    pub fn encode_signal(pid: i32, signal: i32, scope: Scope) -> [u8; 10] {
        let mut out = [0; 10];
        out[0] = SIGNAL;
        out[1..5].copy_from_slice(&pid.to_le_bytes());
        out[5..9].copy_from_slice(&signal.to_le_bytes());
        out[9] = match scope {
            Scope::Process => 0,
            Scope::Group => 1,
            Scope::All => 2,
        };
        out
    }
}

impl InitReply {
    /// Encodes the reply as a datagram.
    pub fn encode(self) -> [u8; 10] {
        let (kind, first, second, last) = match self {
            Self::Ready => (READY, 0, 0, 0),
            Self::Started { id, pid } => (STARTED, id, pid as u32, 0),
            Self::Failed { id, errno, stage } => (FAILED, id, errno as u32, stage as u8),
            Self::Exited { pid, status } => (EXITED, pid as u32, status as u32, 0),
        };
        let mut out = [0; 10];
        out[0] = kind;
        out[1..5].copy_from_slice(&first.to_le_bytes());
        out[5..9].copy_from_slice(&second.to_le_bytes());
        out[9] = last;
        out
    }

    /// Decodes a datagram; `None` if it is malformed.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (&kind, rest) = bytes.split_first()?;
        let (first, second, last) = (read_u32(rest, 0)?, read_u32(rest, 4)?, *rest.get(8)?);
        match kind {
            READY => Some(Self::Ready),
            STARTED => Some(Self::Started { id: first, pid: second as i32 }),
            FAILED => Some(Self::Failed { id: first, errno: second as i32, stage: StartStage::from_byte(last) }),
            EXITED => Some(Self::Exited { pid: first as i32, status: second as i32 }),
            _ => None,
        }
    }
}

fn read_u32(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn strings(list: &[&str]) -> Vec<String> {
        list.iter().map(|text| (*text).to_owned()).collect()
    }

    #[test]
    fn start_is_read_as_written() {
        let (argv, environment) = (strings(&["/bin/node", "", "x y"]), strings(&["A=1", "B="]));
        let request = StartRequest { id: 7, directory: "", argv: &argv, environment: &environment };
        let bytes = request.encode().unwrap();
        let Some(InitRequest::Start(start)) = InitRequest::decode(&bytes) else { panic!("not a start") };
        assert_eq!((start.id, start.arguments, start.variables), (7, 3, 2));
        assert_eq!(start.strings, b"/\0/bin/node\0\0x y\0A=1\0B=\0");
    }

    #[test]
    fn what_cannot_be_sent_is_refused_with_a_reason() {
        let encode =
            |argv: &[String]| StartRequest { id: 0, directory: "/", argv, environment: &[] }.encode().unwrap_err();
        assert_eq!(encode(&[]), EncodeError::Empty);
        assert!(matches!(encode(&strings(&["/a\0b"])), EncodeError::ZeroByte(_)));
        assert!(matches!(encode(&["x".repeat(MAX_MESSAGE)]), EncodeError::TooLong(_)));
    }

    #[test]
    fn truncated_and_foreign_datagrams_are_not_read() {
        let argv = strings(&["/bin/node"]);
        let bytes = StartRequest { id: 1, directory: "/", argv: &argv, environment: &[] }.encode().unwrap();
        for length in 0..bytes.len() {
            assert_eq!(InitRequest::decode(&bytes[..length]), None, "{length} bytes");
        }
        assert_eq!(InitRequest::decode(&[99; 32]), None);
        assert_eq!(InitReply::decode(&[1, 2, 3]), None);
    }

    #[test]
    fn replies_and_signals_are_read_as_written() {
        for reply in [
            InitReply::Ready,
            InitReply::Started { id: 3, pid: 12 },
            InitReply::Failed { id: 4, errno: 2, stage: StartStage::Execute },
            InitReply::Exited { pid: 5, status: 0x8b },
        ] {
            assert_eq!(InitReply::decode(&reply.encode()), Some(reply));
        }
        for scope in [Scope::Process, Scope::Group, Scope::All] {
            let bytes = InitRequest::encode_signal(9, 15, scope);
            assert_eq!(InitRequest::decode(&bytes), Some(InitRequest::Signal { pid: 9, signal: 15, scope }));
        }
    }
}
