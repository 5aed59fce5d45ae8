//! Pipe between a writing and a reading thread.

use std::io::{self, Read, Write};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread;

/// Number of bytes passed at once.
const CHUNK: usize = 256 << 10;
/// Capacity of the queue, in chunks.
const WAITING: usize = 16;

/// Runs `fill` with a writer, and `consume` on another thread with a reader of what is written.
///
/// # Errors
/// The error of `fill`; or that of `consume`, if `fill` failed only because the reader was gone.
pub(crate) fn pipe<T, U: Send, E: Send>(
    fill: impl FnOnce(&mut dyn Write) -> Result<T, E>,
    consume: impl FnOnce(&mut dyn Read) -> Result<U, E> + Send,
) -> Result<(T, U), E> {
    let (chunks, received) = sync_channel(WAITING);
    thread::scope(|scope| {
        let consuming = scope.spawn(move || consume(&mut ChunkReader { received, chunk: Vec::new(), at: 0 }));
        let mut input = ChunkWriter { chunks, chunk: Vec::with_capacity(CHUNK), broken: false };
        let filled = fill(&mut input);
        if filled.is_ok() {
            // A reader that has gone reports its own error.
            let _ = input.flush();
        }
        let broken = input.broken;
        drop(input);
        let consumed = consuming.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        match (filled, consumed) {
            (Ok(filled), Ok(consumed)) => Ok((filled, consumed)),
            (Err(_), Err(error)) if broken => Err(error),
            (Err(error), _) | (Ok(_), Err(error)) => Err(error),
        }
    })
}

struct ChunkWriter {
    chunks: SyncSender<Vec<u8>>,
    chunk: Vec<u8>,
    broken: bool,
}

impl Write for ChunkWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let taken = bytes.len().min(CHUNK - self.chunk.len());
        self.chunk.extend_from_slice(&bytes[..taken]);
        if self.chunk.len() == CHUNK {
            self.flush()?;
        }
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        if self.chunk.is_empty() {
            return Ok(());
        }
        let chunk = std::mem::replace(&mut self.chunk, Vec::with_capacity(CHUNK));
        self.chunks.send(chunk).map_err(|_| {
            self.broken = true;
            io::ErrorKind::BrokenPipe.into()
        })
    }
}

struct ChunkReader {
    received: Receiver<Vec<u8>>,
    chunk: Vec<u8>,
    at: usize,
}

impl Read for ChunkReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        if self.at == self.chunk.len() {
            // The writer disconnects after the last chunk.
            let Ok(chunk) = self.received.recv() else {
                return Ok(0);
            };
            (self.chunk, self.at) = (chunk, 0);
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

    #[test]
    fn what_is_written_is_read() {
        let bytes: Vec<u8> = (0..3 * CHUNK + 17).map(|i| (i % 251) as u8).collect();
        let ((), read) = pipe(
            |output| output.write_all(&bytes),
            |input| {
                let mut read = Vec::new();
                input.read_to_end(&mut read).map(|_| read)
            },
        )
        .unwrap();
        assert!(read == bytes);
    }

    #[test]
    fn the_side_that_failed_is_blamed() {
        let endless = |output: &mut dyn Write| -> io::Result<()> {
            loop {
                output.write_all(&[0; 4096])?;
            }
        };
        let error = pipe(endless, |_| Err::<(), _>(io::ErrorKind::StorageFull.into()));
        assert_eq!(error.unwrap_err().kind(), io::ErrorKind::StorageFull);
        let error = pipe(
            |output| {
                output.write_all(b"some")?;
                Err::<(), io::Error>(io::ErrorKind::PermissionDenied.into())
            },
            |input| {
                let mut all = Vec::new();
                input.read_to_end(&mut all)?;
                Err::<(), _>(io::ErrorKind::UnexpectedEof.into())
            },
        );
        assert_eq!(error.unwrap_err().kind(), io::ErrorKind::PermissionDenied);
    }
}
