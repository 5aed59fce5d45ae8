//! Parallel gzip compression, and decompression (gzip, zstd) on a thread of its own.
//!
//! The stream is split into pieces of a fixed size, each a gzip member of its own (RFC 1952, 2.2: members may be
//! concatenated; all readers of image layers support that). So the output does not depend on the number of threads.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Mutex, PoisonError};
use std::thread;

use flate2::bufread::MultiGzDecoder;
use flate2::{Compression, GzBuilder};

/// Size of the content of a gzip member in bytes; large enough to cost less than 0.5 % of compression.
const PIECE: usize = 4 << 20;

/// Number of bytes passed at once from the decompressing thread.
const CHUNK: usize = 256 << 10;

/// More threads would only wait for the one that reads the files and hashes.
const MAX_WORKERS: usize = 8;

/// A piece to compress, and the channel for the result.
type Job = (Vec<u8>, SyncSender<Vec<u8>>);

/// Runs `fill` with a writer that compresses into `output`. Returns `output` and the result of `fill`.
pub(crate) fn compress<W, T, E>(
    output: W,
    level: u32,
    fill: impl FnOnce(&mut (dyn Write + Send)) -> Result<T, E>,
) -> Result<(W, T), CompressError<E>>
where
    W: Write + Send,
{
    let workers = thread::available_parallelism().map_or(1, |count| count.get().min(MAX_WORKERS));
    let (jobs, waiting) = sync_channel::<Job>(workers);
    let (order, results) = sync_channel::<Receiver<Vec<u8>>>(workers);
    let waiting = Mutex::new(waiting);
    thread::scope(|scope| {
        for _ in 0..workers {
            scope.spawn(|| compress_jobs(&waiting, level));
        }
        let writing = scope.spawn(move || write_in_order(output, &results));
        let mut pieces = PieceWriter { buffer: Vec::with_capacity(PIECE), jobs, order };
        let filled = fill(&mut pieces);
        let closed = pieces.close();
        let written = writing.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        // If the output failed, the error of `fill` is only a broken pipe.
        let output = written.map_err(CompressError::Output)?;
        let filled = filled.map_err(CompressError::Fill)?;
        closed.map_err(CompressError::Output)?;
        Ok((output, filled))
    })
}

/// Side of [`compress`] that failed.
pub(crate) enum CompressError<E> {
    Output(io::Error),
    Fill(E),
}

fn compress_jobs(waiting: &Mutex<Receiver<Job>>, level: u32) {
    loop {
        let job = waiting.lock().unwrap_or_else(PoisonError::into_inner).recv();
        let Ok((piece, result)) = job else { return };
        // If the output has failed, the receiver is gone and nobody needs the piece.
        let _ = result.send(compress_member(&piece, level));
    }
}

/// Compresses a gzip member without name, time or operating system.
fn compress_member(piece: &[u8], level: u32) -> Vec<u8> {
    let output = Vec::with_capacity(piece.len() / 2);
    let mut encoder =
        GzBuilder::new().mtime(0).operating_system(255).write(output, Compression::new(level.clamp(1, 9)));
    encoder.write_all(piece).and_then(|()| encoder.finish()).expect("writing to memory does not fail")
}

fn write_in_order<W: Write>(mut output: W, results: &Receiver<Receiver<Vec<u8>>>) -> io::Result<W> {
    for result in results {
        let member = result.recv().map_err(|_| io::Error::from(io::ErrorKind::BrokenPipe))?;
        output.write_all(&member)?;
    }
    Ok(output)
}

/// Writer that splits its input into pieces.
struct PieceWriter {
    buffer: Vec<u8>,
    jobs: SyncSender<Job>,
    order: SyncSender<Receiver<Vec<u8>>>,
}

impl PieceWriter {
    fn send(&mut self) -> io::Result<()> {
        let piece = std::mem::replace(&mut self.buffer, Vec::with_capacity(PIECE));
        let (result, awaited) = sync_channel(1);
        let broken = |_| io::Error::from(io::ErrorKind::BrokenPipe);
        self.order.send(awaited).map_err(broken)?;
        self.jobs.send((piece, result)).map_err(|_| io::Error::from(io::ErrorKind::BrokenPipe))
    }

    fn close(mut self) -> io::Result<()> {
        if self.buffer.is_empty() { Ok(()) } else { self.send() }
    }
}

impl Write for PieceWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let taken = bytes.len().min(PIECE - self.buffer.len());
        self.buffer.extend_from_slice(&bytes[..taken]);
        if self.buffer.len() == PIECE {
            self.send()?;
        }
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Format of a stream, detected by its magic number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Format {
    Gzip,
    Zstd,
    /// Assumed to be tar, whose reader reports errors.
    Plain,
}

/// Detects the format without consuming input.
pub(crate) fn detect_format(input: &mut impl BufRead) -> io::Result<Format> {
    let start = input.fill_buf()?;
    Ok(match start {
        [0x1f, 0x8b, ..] => Format::Gzip,
        [0x28, 0xb5, 0x2f, 0xfd, ..] => Format::Zstd,
        _ => Format::Plain,
    })
}

/// Returns a reader of the decompressed content of a stream: gzip, zstd (RFC 8878) or plain. A zstd stream whose window
/// exceeds 128 MiB is an error, which bounds the memory that a sender can have taken.
pub(crate) fn decoder<'a>(input: impl Read + Send + 'a) -> io::Result<Box<dyn Read + Send + 'a>> {
    let mut input = BufReader::with_capacity(CHUNK, input);
    match detect_format(&mut input)? {
        Format::Gzip => Ok(Box::new(MultiGzDecoder::new(input))),
        Format::Plain => Ok(Box::new(input)),
        Format::Zstd => Ok(Box::new(zstd::stream::read::Decoder::with_buffer(input)?)),
    }
}

/// Runs `consume` with a reader that is filled by another thread from `input`. That thread has no other privileges than
/// reading, because it decompresses untrusted data.
pub(crate) fn read_ahead<R: Read + Send, T>(mut input: R, consume: impl FnOnce(&mut dyn Read) -> T) -> T {
    let (chunks, received) = sync_channel::<io::Result<Vec<u8>>>(8);
    thread::scope(|scope| {
        privilege::spawn_reader(scope, move || {
            loop {
                let mut chunk = vec![0; CHUNK];
                let read = read_full(&mut input, &mut chunk);
                let last = !matches!(read, Ok(CHUNK));
                let sent = chunks.send(read.map(|read| {
                    chunk.truncate(read);
                    chunk
                }));
                if last || sent.is_err() {
                    return;
                }
            }
        });
        consume(&mut ReadAhead { received, chunk: Vec::new(), at: 0 })
    })
}

/// Reads until the buffer is full or the input ends.
fn read_full(input: &mut impl Read, buffer: &mut [u8]) -> io::Result<usize> {
    let mut filled = 0;
    while filled < buffer.len() {
        match input.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(read) => filled += read,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(filled)
}

struct ReadAhead {
    received: Receiver<io::Result<Vec<u8>>>,
    chunk: Vec<u8>,
    at: usize,
}

impl Read for ReadAhead {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.at == self.chunk.len() {
            // The sender disconnects after the last chunk.
            let Ok(chunk) = self.received.recv() else {
                return Ok(0);
            };
            (self.chunk, self.at) = (chunk?, 0);
        }
        let taken = buffer.len().min(self.chunk.len() - self.at);
        buffer[..taken].copy_from_slice(&self.chunk[self.at..self.at + taken]);
        self.at += taken;
        Ok(taken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(length: usize) -> Vec<u8> {
        (0..length).map(|i| (i * i / 7 % 251) as u8).collect()
    }

    fn compress_to_vec(bytes: &[u8]) -> Vec<u8> {
        match compress(Vec::new(), 6, |out| out.write_all(bytes)) {
            Ok((packed, ())) => packed,
            Err(_) => panic!("compressing to memory failed"),
        }
    }

    #[test]
    fn several_pieces_come_back_as_one_stream() {
        let bytes = pattern(2 * PIECE + 12_345);
        let packed = compress_to_vec(&bytes);
        assert!(packed.len() < bytes.len());
        let decoder = decoder(&packed[..]).unwrap();
        let mut back = Vec::new();
        read_ahead(decoder, |input| input.read_to_end(&mut back)).unwrap();
        assert!(back == bytes);
    }

    /// Reader that records the user id of the thread that reads from it.
    struct UserIdReader(Option<u32>);

    impl Read for UserIdReader {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            self.0 = Some(rustix::process::geteuid().as_raw());
            Ok(0)
        }
    }

    #[test]
    fn what_is_read_ahead_is_read_without_roots_rights() {
        let told = crate::run_as_engine(|| {
            let mut asked = UserIdReader(None);
            read_ahead(&mut asked, |content| io::copy(content, &mut io::sink())).expect("read");
            (asked.0, rustix::process::geteuid().as_raw())
        });
        assert_eq!(told, (Some(privilege::DEFAULT_USER), 0));
    }

    #[test]
    fn the_same_bytes_give_the_same_gzip() {
        let bytes = pattern(PIECE + 1);
        assert!(compress_to_vec(&bytes) == compress_to_vec(&bytes));
        // No time, no name, "unknown" operating system.
        assert_eq!(compress_to_vec(&bytes)[..8], [0x1f, 0x8b, 8, 0, 0, 0, 0, 0]);
        assert_eq!(compress_to_vec(&bytes)[9], 255);
    }

    #[test]
    fn a_full_disk_is_reported_as_such_and_ends_the_work() {
        let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
        let bytes = pattern(40 * PIECE);
        match compress(full, 1, |out| out.write_all(&bytes)) {
            Err(CompressError::Output(error)) => {
                assert_eq!(error.kind(), io::ErrorKind::StorageFull)
            }
            Err(CompressError::Fill(error)) => panic!("the wrong side is blamed: {error}"),
            Ok(_) => panic!("a full disk took everything"),
        }
    }

    #[test]
    fn a_cut_stream_is_an_error() {
        let packed = compress_to_vec(&pattern(100_000));
        let mut back = Vec::new();
        let error = decoder(&packed[..packed.len() - 5]).unwrap().read_to_end(&mut back).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::UnexpectedEof);
    }

    #[test]
    fn zstd_is_read_like_gzip() {
        let bytes = pattern(100_000);
        let packed = zstd::stream::encode_all(&bytes[..], 1).unwrap();
        let mut back = Vec::new();
        decoder(&packed[..]).unwrap().read_to_end(&mut back).unwrap();
        assert!(back == bytes);
        let cut = decoder(&packed[..packed.len() / 2]).unwrap().read_to_end(&mut back).unwrap_err();
        assert_eq!(cut.kind(), io::ErrorKind::UnexpectedEof);
    }
}
