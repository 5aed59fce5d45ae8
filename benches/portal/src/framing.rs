//! WebSocket framing on the server side alone: `ws` compared with tokio-tungstenite, fastwebsockets and a bare socket.
//! Each figure is the processor time of the server's thread per message, with system calls: the best of [`ROUNDS`]
//! alternating rounds. The peer is a thread that writes prepared frames, or reads and discards.

use std::future::poll_fn;
use std::io::{self, BufReader, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use bench_report::{BenchReport, Target, thread_processor_time};
use bytes::Bytes;
use fastwebsockets::{FragmentCollector, Frame, OpCode, Payload, Role};
use futures_util::{SinkExt, StreamExt};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::frame::{self, Frame as RawFrame};
use tokio_tungstenite::tungstenite::protocol::{self, WebSocketConfig};

/// Number of counted rounds; one warm-up round comes before them.
const ROUNDS: usize = 7;

/// Name, size in bytes and number of messages of a round: a state, a scan, and a 640x480 RGB image.
const SIZES: [(&str, usize, usize); 3] = [("64 B", 64, 40_000), ("4 KiB", 4096, 10_000), ("0.9 MB", 921_600, 100)];

/// Bytes that are collected before a write; tokio-tungstenite's default buffer size.
const BATCH: usize = 128 * 1024;

/// Maximum length of a frame and of a message, in bytes.
const LIMIT: usize = 16 << 20;

/// A mask that changes the payload.
const MASK: [u8; 4] = [0x5a, 0xc3, 0x17, 0x99];

#[derive(Clone, Copy)]
enum WebSocketLibrary {
    Ours,
    Tungstenite,
    Fast,
    /// A bare socket with the same bytes, without parsing.
    Socket,
}

const FRAMINGS: [WebSocketLibrary; 4] =
    [WebSocketLibrary::Ours, WebSocketLibrary::Tungstenite, WebSocketLibrary::Fast, WebSocketLibrary::Socket];

/// Messages of one size, from the client to the server (`inward`) or the other way.
#[derive(Clone, Copy)]
struct FramingLoad {
    inward: bool,
    bytes: usize,
    count: usize,
}

/// Reports a figure for each direction and size.
pub fn measure(report: &mut BenchReport, only: &str) -> Result<()> {
    for inward in [true, false] {
        for (size, bytes, count) in SIZES {
            let way = if inward { "in" } else { "out" };
            let name = format!("framing of {size} {way}, processor time of a message");
            if !name.contains(only) {
                continue;
            }
            let load = FramingLoad { inward, bytes, count };
            let mut best = [Duration::MAX; FRAMINGS.len()];
            for number in 0..=ROUNDS {
                for (framing, best) in FRAMINGS.into_iter().zip(&mut best) {
                    let took = measure_round(framing, load)?;
                    *best = if number == 0 { *best } else { took.min(*best) };
                }
            }
            let [ours, tungstenite, fast, socket] = best.map(|best| best.as_secs_f64() * 1e6 / count as f64);
            let figure = report.figure(name, "µs", ours);
            figure.relative_to("tokio-tungstenite", tungstenite).require(Target::RatioAtMost(1.0));
            let (beside_fast, beside_socket) = (ours / fast, ours / socket);
            figure.note(format!(
                "fastwebsockets {fast:.2} µs (ratio {beside_fast:.2}); the socket alone {socket:.2} µs (ratio \
                 {beside_socket:.2})"
            ));
        }
    }
    Ok(())
}

/// Returns the processor time of the server's thread for one load.
fn measure_round(framing: WebSocketLibrary, load: FramingLoad) -> Result<Duration> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
    let client = TcpStream::connect(listener.local_addr()?)?;
    let (server, _) = listener.accept()?;
    server.set_nodelay(true)?;
    server.set_nonblocking(true)?;
    let other = thread::spawn(move || run_client(client, load));
    let total = (load.count * frame_message(load)?.len()) as u64;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
    let start = thread_processor_time();
    runtime.block_on(async {
        let server = tokio::net::TcpStream::from_std(server)?;
        match (framing, load.inward) {
            (WebSocketLibrary::Ours, true) => read_with_ws(server, load).await,
            (WebSocketLibrary::Ours, false) => write_with_ws(server, load).await,
            (WebSocketLibrary::Tungstenite, true) => read_with_tungstenite(server, load).await,
            (WebSocketLibrary::Tungstenite, false) => write_with_tungstenite(server, load).await,
            (WebSocketLibrary::Fast, true) => read_with_fastwebsockets(server, load).await,
            (WebSocketLibrary::Fast, false) => write_with_fastwebsockets(server, load).await,
            (WebSocketLibrary::Socket, true) => read_from_socket(server, total).await,
            (WebSocketLibrary::Socket, false) => write_to_socket(server, total).await,
        }
    })?;
    let took = thread_processor_time() - start;
    let transferred = other.join().ok().context("the client's thread panicked")??;
    ensure!(transferred == total, "{transferred} bytes passed, not {total}");
    Ok(took)
}

fn payload(load: FramingLoad) -> Vec<u8> {
    (0..load.bytes).map(|index| (index * 7) as u8).collect()
}

/// Returns a message as it is sent; frames of clients are masked.
fn frame_message(load: FramingLoad) -> Result<Vec<u8>> {
    let mut frame = RawFrame::message(payload(load), frame::coding::OpCode::Data(frame::coding::Data::Binary), true);
    frame.header_mut().mask = load.inward.then_some(MASK);
    let mut bytes = Vec::new();
    frame.format(&mut bytes)?;
    Ok(bytes)
}

/// Writes the frames for the server, or reads those from it; returns the number of bytes.
fn run_client(mut client: TcpStream, load: FramingLoad) -> Result<u64> {
    if !load.inward {
        return Ok(io::copy(&mut BufReader::with_capacity(1 << 20, client), &mut io::sink())?);
    }
    let frame = frame_message(load)?;
    let (total, batch) = (load.count * frame.len(), frame.repeat((BATCH / frame.len()).clamp(1, load.count)));
    for at in (0..total).step_by(batch.len()) {
        client.write_all(&batch[..batch.len().min(total - at)])?;
    }
    Ok(total as u64)
}

async fn read_with_ws(server: tokio::net::TcpStream, load: FramingLoad) -> Result<()> {
    let mut socket = ws::WebSocket::new(server, &[], LIMIT, LIMIT);
    for _ in 0..load.count {
        match poll_fn(|cx| socket.poll_next(cx)).await? {
            ws::WsMessage::Binary(payload) if payload.len() == load.bytes => {}
            other => bail!("not the message that was sent: {other:?}"),
        }
    }
    Ok(())
}

async fn write_with_ws(server: tokio::net::TcpStream, load: FramingLoad) -> Result<()> {
    let mut socket = ws::WebSocket::new(server, &[], LIMIT, LIMIT);
    let payload = Bytes::from(payload(load));
    for _ in 0..load.count {
        socket.queue(ws::frame::BINARY, payload.clone());
        if socket.bytes_queued() >= BATCH {
            poll_fn(|cx| socket.poll_flush(cx)).await?;
        }
    }
    poll_fn(|cx| socket.poll_flush(cx)).await?;
    Ok(())
}

async fn tungstenite_socket(server: tokio::net::TcpStream) -> WebSocketStream<tokio::net::TcpStream> {
    let config = WebSocketConfig::default()
        .read_buffer_size(BATCH)
        .write_buffer_size(BATCH)
        .max_frame_size(Some(LIMIT))
        .max_message_size(Some(LIMIT));
    WebSocketStream::from_raw_socket(server, protocol::Role::Server, Some(config)).await
}

async fn read_with_tungstenite(server: tokio::net::TcpStream, load: FramingLoad) -> Result<()> {
    let mut socket = tungstenite_socket(server).await;
    for _ in 0..load.count {
        match socket.next().await.context("the connection ended")?? {
            Message::Binary(payload) if payload.len() == load.bytes => {}
            other => bail!("not the message that was sent: {other:?}"),
        }
    }
    Ok(())
}

async fn write_with_tungstenite(server: tokio::net::TcpStream, load: FramingLoad) -> Result<()> {
    let mut socket = tungstenite_socket(server).await;
    let payload = Bytes::from(payload(load));
    for _ in 0..load.count {
        socket.feed(Message::Binary(payload.clone())).await?;
    }
    socket.flush().await?;
    Ok(())
}

async fn read_with_fastwebsockets(server: tokio::net::TcpStream, load: FramingLoad) -> Result<()> {
    let mut socket = fastwebsockets::WebSocket::after_handshake(server, Role::Server);
    socket.set_max_message_size(LIMIT);
    let mut socket = FragmentCollector::new(socket);
    for _ in 0..load.count {
        let frame = socket.read_frame().await?;
        ensure!(frame.opcode == OpCode::Binary && frame.payload.len() == load.bytes, "not the message that was sent");
    }
    Ok(())
}

async fn write_with_fastwebsockets(server: tokio::net::TcpStream, load: FramingLoad) -> Result<()> {
    let mut socket = fastwebsockets::WebSocket::after_handshake(server, Role::Server);
    socket.set_writev(true);
    let payload = payload(load);
    for _ in 0..load.count {
        socket.write_frame(Frame::binary(Payload::Borrowed(&payload))).await?;
    }
    socket.flush().await?;
    Ok(())
}

async fn read_from_socket(server: tokio::net::TcpStream, total: u64) -> Result<()> {
    let mut reader = tokio::io::BufReader::with_capacity(BATCH, server.take(total));
    let read = tokio::io::copy_buf(&mut reader, &mut tokio::io::sink()).await?;
    ensure!(read == total, "the connection ended after {read} bytes");
    Ok(())
}

async fn write_to_socket(mut server: tokio::net::TcpStream, total: u64) -> Result<()> {
    let (total, buffer) = (total as usize, vec![0; BATCH]);
    for at in (0..total).step_by(BATCH) {
        server.write_all(&buffer[..BATCH.min(total - at)]).await?;
    }
    Ok(())
}
