//! The datagrams, as data.

use std::fmt;

/// The longest datagram; a command line with its environment must fit.
pub const MAX_MESSAGE: usize = 128 * 1024;

const START: u8 = 1;
const SIGNAL: u8 = 2;
const READY: u8 = 0x80;
const STARTED: u8 = 0x81;
const FAILED: u8 = 0x82;
const EXITED: u8 = 0x83;

/// What the shim asks of init.
#[derive(Debug, PartialEq)]
pub enum Request<'a> {
    /// Fork and execute. Standard output and error come beside it as file descriptors.
    Start(Start<'a>),
    /// Send a signal.
    Signal {
        /// Pid inside; ignored for [`Scope::All`].
        pid: i32,
        /// Signal number.
        signal: i32,
        /// Whom it reaches.
        scope: Scope,
    },
}

/// Whom a signal reaches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scope {
    /// The process only.
    Process,
    /// Its process group.
    Group,
    /// Every process but init.
    All,
}

/// A request to start a program, as init reads it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Start<'a> {
    /// Chosen by the shim, returned in the answer.
    pub id: u32,
    /// How many arguments follow the directory.
    pub arguments: u16,
    /// How many `NAME=value` follow the arguments.
    pub variables: u16,
    /// Directory, arguments and variables, each ended by a zero byte.
    pub strings: &'a [u8],
}

/// A request to start a program, as the shim writes it.
#[derive(Debug, Clone, Copy)]
pub struct StartRequest<'a> {
    /// Returned in the answer.
    pub id: u32,
    /// Working directory; `/` when empty.
    pub directory: &'a str,
    /// Path of the program and its arguments.
    pub argv: &'a [String],
    /// Environment as `NAME=value`.
    pub environment: &'a [String],
}

/// Why a request cannot be sent.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EncodeError {
    /// No program is named.
    Empty,
    /// A string holds a zero byte.
    ZeroByte(String),
    /// Arguments and environment together are longer than [`MAX_MESSAGE`] allows.
    TooLong(usize),
}

impl fmt::Display for EncodeError {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Empty => write!(
                formatter,
                "no program is named: give its absolute path as the first argument"
            ),
            Self::ZeroByte(text) => write!(formatter, "{text:?} holds a zero byte: remove it"),
            Self::TooLong(length) => write!(
                formatter,
                "arguments and environment take {length} bytes, more than the {MAX_MESSAGE} allowed: shorten them"
            ),
        }
    }
}

impl std::error::Error for EncodeError {}

/// What init tells the shim.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reply {
    /// It listens.
    Ready,
    /// The program was executed; its pidfd comes beside this.
    Started {
        /// From the request.
        id: u32,
        /// Pid inside.
        pid: i32,
    },
    /// The command was not carried out.
    Failed {
        /// From the request.
        id: u32,
        /// Error number.
        errno: i32,
        /// What was being done.
        stage: Stage,
    },
    /// A process ended: a started one, or an orphan that init had inherited.
    Exited {
        /// Pid inside.
        pid: i32,
        /// Status as `waitpid` gives it.
        status: i32,
    },
}

/// Which step of a start failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Stage {
    /// The request could not be read.
    Request = 0,
    /// `fork`.
    Fork = 1,
    /// Sessions, signals, standard streams.
    Prepare = 2,
    /// Changing to the working directory.
    Directory = 3,
    /// `execve`.
    Execute = 4,
}

impl Stage {
    /// From the byte on the wire.
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
    /// The datagram.
    pub fn encode(&self) -> Result<Vec<u8>, EncodeError> {
        if self.argv.first().is_none_or(|program| program.is_empty()) {
            return Err(EncodeError::Empty);
        }
        let directory = if self.directory.is_empty() {
            "/"
        } else {
            self.directory
        };
        let mut out = vec![START];
        out.extend(self.id.to_le_bytes());
        for count in [self.argv.len(), self.environment.len()] {
            out.extend(
                u16::try_from(count)
                    .map_err(|_| EncodeError::TooLong(count))?
                    .to_le_bytes(),
            );
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
        if out.len() > MAX_MESSAGE {
            Err(EncodeError::TooLong(out.len()))
        } else {
            Ok(out)
        }
    }
}

impl<'a> Request<'a> {
    /// Reads a datagram; none when it is not one of ours.
    pub fn decode(bytes: &'a [u8]) -> Option<Self> {
        let (&kind, rest) = bytes.split_first()?;
        match kind {
            START => {
                let (fixed, strings) = rest.split_at_checked(8)?;
                let arguments = u16::from_le_bytes([fixed[4], fixed[5]]);
                let variables = u16::from_le_bytes([fixed[6], fixed[7]]);
                let ended = strings.iter().filter(|byte| **byte == 0).count();
                let complete = strings.last() == Some(&0)
                    && ended == 1 + usize::from(arguments) + usize::from(variables);
                (complete && arguments > 0).then_some(Self::Start(Start {
                    id: word(fixed, 0)?,
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
                Some(Self::Signal {
                    pid: word(rest, 0)? as i32,
                    signal: word(rest, 4)? as i32,
                    scope,
                })
            }
            _ => None,
        }
    }

    /// The datagram that sends a signal.
    pub fn signal(pid: i32, signal: i32, scope: Scope) -> [u8; 10] {
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

impl Reply {
    /// The datagram.
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

    /// Reads a datagram; none when it is not one of ours.
    pub fn decode(bytes: &[u8]) -> Option<Self> {
        let (&kind, rest) = bytes.split_first()?;
        let (first, second, last) = (word(rest, 0)?, word(rest, 4)?, *rest.get(8)?);
        match kind {
            READY => Some(Self::Ready),
            STARTED => Some(Self::Started {
                id: first,
                pid: second as i32,
            }),
            FAILED => Some(Self::Failed {
                id: first,
                errno: second as i32,
                stage: Stage::from_byte(last),
            }),
            EXITED => Some(Self::Exited {
                pid: first as i32,
                status: second as i32,
            }),
            _ => None,
        }
    }
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
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
        let request = StartRequest {
            id: 7,
            directory: "",
            argv: &argv,
            environment: &environment,
        };
        let bytes = request.encode().unwrap();
        let Some(Request::Start(start)) = Request::decode(&bytes) else {
            panic!("not a start")
        };
        assert_eq!((start.id, start.arguments, start.variables), (7, 3, 2));
        assert_eq!(start.strings, b"/\0/bin/node\0\0x y\0A=1\0B=\0");
    }

    #[test]
    fn what_cannot_be_sent_is_refused_with_a_reason() {
        let encode = |argv: &[String]| {
            StartRequest {
                id: 0,
                directory: "/",
                argv,
                environment: &[],
            }
            .encode()
            .unwrap_err()
        };
        assert_eq!(encode(&[]), EncodeError::Empty);
        assert!(matches!(
            encode(&strings(&["/a\0b"])),
            EncodeError::ZeroByte(_)
        ));
        assert!(matches!(
            encode(&["x".repeat(MAX_MESSAGE)]),
            EncodeError::TooLong(_)
        ));
    }

    #[test]
    fn truncated_and_foreign_datagrams_are_not_read() {
        let argv = strings(&["/bin/node"]);
        let bytes = StartRequest {
            id: 1,
            directory: "/",
            argv: &argv,
            environment: &[],
        }
        .encode()
        .unwrap();
        for length in 0..bytes.len() {
            assert_eq!(Request::decode(&bytes[..length]), None, "{length} bytes");
        }
        assert_eq!(Request::decode(&[99; 32]), None);
        assert_eq!(Reply::decode(&[1, 2, 3]), None);
    }

    #[test]
    fn replies_and_signals_are_read_as_written() {
        for reply in [
            Reply::Ready,
            Reply::Started { id: 3, pid: 12 },
            Reply::Failed {
                id: 4,
                errno: 2,
                stage: Stage::Execute,
            },
            Reply::Exited {
                pid: 5,
                status: 0x8b,
            },
        ] {
            assert_eq!(Reply::decode(&reply.encode()), Some(reply));
        }
        for scope in [Scope::Process, Scope::Group, Scope::All] {
            let bytes = Request::signal(9, 15, scope);
            assert_eq!(
                Request::decode(&bytes),
                Some(Request::Signal {
                    pid: 9,
                    signal: 15,
                    scope
                })
            );
        }
    }
}
