//! One exec session: frames of a WebSocket to and from a program's streams. Nothing is queued here: who does not read
//! is waited for, and the other direction goes on meanwhile.

use std::io;
use std::pin::pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use api::exec::{ExecFrame, MAX_CONTENT};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use servant::exec::{ExecEnd, ExecSession, ExecStream};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::{Instant, MissedTickBehavior};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Bytes, Message};

/// Interval between pings, and number of them without any message of the client after which it is lost.
const PING: Duration = Duration::from_secs(20);
const MAX_UNANSWERED_PINGS: u32 = 3;
/// Time for the rest of the output once the program has ended: a node may have been given the other end and keep it.
const DRAIN: Duration = Duration::from_secs(10);
/// Time for the last message to a client that does not read.
const FAREWELL: Duration = Duration::from_secs(5);
/// Bytes of output that are read at once.
const BLOCK: usize = 16 << 10;

/// End of a session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ExecOutcome {
    /// The program ended with this exit status.
    Exited(i32),
    /// The servant ended.
    ServantEnded,
    /// The client closed the connection, or it broke.
    Left,
    /// The daemon ended it for this reason.
    Stopped(String),
}

impl ExecOutcome {
    /// Describes the end for the audit log and the client.
    pub fn describe(&self) -> String {
        match self {
            ExecOutcome::Exited(status) => format!("exit status {status}"),
            ExecOutcome::ServantEnded => "the servant ended".to_owned(),
            ExecOutcome::Left => "killed: the connection ended".to_owned(),
            ExecOutcome::Stopped(reason) => format!("killed: {reason}"),
        }
    }
}

/// Signs of life of a client.
#[derive(Debug, Default)]
struct Liveness {
    /// A message has come since the last ping.
    is_heard: AtomicBool,
    /// The client's messages are not read, because the program does not read its input.
    is_held: AtomicBool,
}

/// Returns the settings of the WebSocket: messages are frames of a session.
pub fn socket_config() -> WebSocketConfig {
    let longest = Some(1 + MAX_CONTENT);
    WebSocketConfig::default().max_message_size(longest).max_frame_size(longest)
}

/// Serves a session until it ends; `ending` completes with a reason why it must.
pub async fn serve<S: AsyncRead + AsyncWrite + Unpin>(
    socket: WebSocketStream<S>,
    session: ExecSession,
    ending: impl Future<Output = String>,
) -> ExecOutcome {
    let ExecSession { input, output, error, mut end } = session;
    let (mut sink, mut stream) = socket.split();
    let liveness = Liveness::default();
    let outcome = tokio::select! {
        outcome = send_output(&mut sink, &output, error.as_ref(), &mut end, &liveness) => outcome,
        () = receive_input(&mut stream, input, &output, &liveness) => ExecOutcome::Left,
        reason = ending => ExecOutcome::Stopped(reason),
    };
    let (code, reason) = match &outcome {
        ExecOutcome::Exited(_) => (CloseCode::Normal, String::new()),
        ExecOutcome::Stopped(reason) => (CloseCode::Policy, reason.chars().take(30).collect()),
        outcome => (CloseCode::Away, outcome.describe()),
    };
    let close = Message::Close(Some(CloseFrame { code, reason: reason.into() }));
    // On an error the client is gone.
    let told = tokio::time::timeout(FAREWELL, sink.send(close)).await;
    if matches!(told, Ok(Ok(()))) && outcome != ExecOutcome::Left {
        // A connection that is closed with unread input is reset, and with it goes what the client has not read yet.
        let left = async { while let Some(Ok(_)) = stream.next().await {} };
        let _ = tokio::time::timeout(FAREWELL, left).await;
    }
    outcome
}

/// Passes on what the client sends; returns when it has left.
async fn receive_input<S: AsyncRead + AsyncWrite + Unpin>(
    stream: &mut SplitStream<WebSocketStream<S>>,
    input: ExecStream,
    terminal: &ExecStream,
    liveness: &Liveness,
) {
    let mut input = Some(input);
    while let Some(Ok(message)) = stream.next().await {
        liveness.is_heard.store(true, Ordering::Relaxed);
        let frame = match &message {
            Message::Binary(content) => ExecFrame::decode(content),
            Message::Close(_) => return,
            _ => continue,
        };
        match frame {
            Some(ExecFrame::Input([])) => input = None,
            Some(ExecFrame::Input(content)) => {
                liveness.is_held.store(true, Ordering::Relaxed);
                if let Some(open) = &input
                    && open.write_all(content).await.is_err()
                {
                    // The program has closed it: what is still sent goes nowhere, as in a pipeline.
                    input = None;
                }
                liveness.is_held.store(false, Ordering::Relaxed);
            }
            Some(ExecFrame::Size(size)) => {
                if let Err(error) = terminal.resize(size) {
                    tracing::debug!("the terminal of an exec session has kept its size: {error}");
                }
            }
            // Not a client's, or no frame at all.
            _ => return,
        }
    }
}

/// Reads a stream if there is one; without, it never ends.
async fn read_open(stream: Option<&ExecStream>, into: &mut [u8]) -> io::Result<usize> {
    match stream {
        Some(stream) => stream.read(into).await,
        None => std::future::pending().await,
    }
}

/// Sends the program's output and finally its exit status.
async fn send_output<S: AsyncRead + AsyncWrite + Unpin>(
    sink: &mut SplitSink<WebSocketStream<S>, Message>,
    output: &ExecStream,
    error: Option<&ExecStream>,
    end: &mut ExecEnd,
    liveness: &Liveness,
) -> ExecOutcome {
    let (mut printed, mut complained) = (vec![0; BLOCK], vec![0; BLOCK]);
    let (mut output, mut error) = (Some(output), error);
    let mut ended = pin!(end.wait());
    let mut status = None;
    let mut drained = Instant::now();
    let mut unanswered = 0;
    let mut ping = tokio::time::interval(PING);
    ping.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        if let (Some(status), None, None) = (status, output, error) {
            let _ = tokio::time::timeout(FAREWELL, sink.send(message(ExecFrame::Exit(status)))).await;
            return ExecOutcome::Exited(status);
        }
        let sent = tokio::select! {
            read = read_open(output, &mut printed), if output.is_some() => match read {
                Ok(length @ 1..) => sink.send(message(ExecFrame::Output(&printed[..length]))).await,
                _ => {
                    output = None;
                    Ok(())
                }
            },
            read = read_open(error, &mut complained), if error.is_some() => match read {
                Ok(length @ 1..) => sink.send(message(ExecFrame::Error(&complained[..length]))).await,
                _ => {
                    error = None;
                    Ok(())
                }
            },
            told = &mut ended, if status.is_none() => {
                let Some(told) = told else {
                    return ExecOutcome::ServantEnded;
                };
                status = Some(told);
                drained = Instant::now() + DRAIN;
                Ok(())
            }
            () = tokio::time::sleep_until(drained), if status.is_some() => {
                (output, error) = (None, None);
                Ok(())
            }
            _ = ping.tick() => {
                let is_alive = liveness.is_heard.swap(false, Ordering::Relaxed)
                    || liveness.is_held.load(Ordering::Relaxed);
                unanswered = if is_alive { 0 } else { unanswered + 1 };
                if unanswered > MAX_UNANSWERED_PINGS {
                    return ExecOutcome::Left;
                }
                sink.send(Message::Ping(Bytes::new())).await
            }
        };
        if sent.is_err() {
            return ExecOutcome::Left;
        }
    }
}

fn message(frame: ExecFrame<'_>) -> Message {
    Message::Binary(frame.encode().into())
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::{Read, Write};
    use std::os::fd::OwnedFd;

    use servant::exec::ExecEnds;
    use tokio::io::DuplexStream;
    use tokio::task::JoinHandle;
    use tokio_tungstenite::tungstenite::protocol::Role;

    use super::*;

    type Client = WebSocketStream<DuplexStream>;

    /// A session with a client at one end and, in place of a program, the other ends of its streams.
    struct Scene {
        client: Client,
        serving: JoinHandle<ExecOutcome>,
        socket: File,
        input: File,
        output: File,
        error: File,
    }

    impl Scene {
        async fn open(ending: impl Future<Output = String> + Send + 'static) -> Scene {
            let user = nix::unistd::geteuid().as_raw();
            let (ends, theirs) = ExecEnds::create(None, user).expect("descriptors");
            let session = ends.register().expect("registered");
            let [socket, input, output, error] = <[OwnedFd; 4]>::try_from(theirs).expect("four").map(File::from);
            let (ours, far) = tokio::io::duplex(1 << 16);
            let server = WebSocketStream::from_raw_socket(far, Role::Server, Some(socket_config())).await;
            let client = WebSocketStream::from_raw_socket(ours, Role::Client, None).await;
            let serving = tokio::spawn(serve(server, session, ending));
            Scene { client, serving, socket, input, output, error }
        }
    }

    /// Returns the next message that is no ping.
    async fn next_message(client: &mut Client) -> Message {
        loop {
            match client.next().await.expect("open").expect("a message") {
                Message::Ping(_) => {}
                message => return message,
            }
        }
    }

    #[tokio::test]
    async fn streams_are_told_apart_and_the_exit_status_comes_last() {
        let Scene { mut client, serving, mut socket, mut input, mut output, mut error } =
            Scene::open(std::future::pending()).await;
        client.send(message(ExecFrame::Input(b"typed"))).await.expect("sent");
        client.send(message(ExecFrame::Input(b""))).await.expect("sent");
        let read = tokio::task::spawn_blocking(move || {
            let mut text = String::new();
            input.read_to_string(&mut text).map(|_| text)
        });
        assert_eq!(read.await.expect("read").expect("text"), "typed", "and then its end");
        output.write_all(b"printed").expect("written");
        assert_eq!(next_message(&mut client).await, message(ExecFrame::Output(b"printed")));
        error.write_all(b"complained").expect("written");
        assert_eq!(next_message(&mut client).await, message(ExecFrame::Error(b"complained")));
        // The status is there before the last of the output.
        socket.write_all(&3_i32.to_le_bytes()).expect("written");
        output.write_all(b"last").expect("written");
        drop((output, error));
        assert_eq!(next_message(&mut client).await, message(ExecFrame::Output(b"last")));
        assert_eq!(next_message(&mut client).await, message(ExecFrame::Exit(3)));
        assert_eq!(serving.await.expect("served"), ExecOutcome::Exited(3));
    }

    #[tokio::test]
    async fn a_program_that_does_not_read_is_heard_nevertheless() {
        let Scene { client, serving, socket: _socket, input: _input, mut output, error: _error } =
            Scene::open(std::future::pending()).await;
        let (mut sink, mut stream) = client.split();
        let sending = tokio::spawn(async move {
            let block = vec![b'x'; MAX_CONTENT];
            while sink.send(message(ExecFrame::Input(&block))).await.is_ok() {}
        });
        output.write_all(b"printed").expect("written");
        let heard = async {
            loop {
                let came = stream.next().await.expect("open").expect("a message");
                if came == message(ExecFrame::Output(b"printed")) {
                    return;
                }
            }
        };
        heard.await;
        sending.abort();
        serving.abort();
    }

    #[tokio::test]
    async fn who_leaves_ends_the_session_and_so_does_the_daemon() {
        let Scene { client, serving, mut socket, .. } = Scene::open(std::future::pending()).await;
        drop(client);
        assert_eq!(serving.await.expect("served"), ExecOutcome::Left);
        let told = tokio::task::spawn_blocking(move || socket.read(&mut [0; 4]));
        assert_eq!(told.await.expect("read").expect("read"), 0, "the shim is told");
        let Scene { mut client, serving, socket: _socket, .. } =
            Scene::open(std::future::ready("this token was revoked".to_owned())).await;
        match next_message(&mut client).await {
            Message::Close(Some(close)) => {
                assert_eq!((close.code, close.reason.as_str()), (CloseCode::Policy, "this token was revoked"));
            }
            other => panic!("{other:?}"),
        }
        let outcome = serving.await.expect("served");
        assert_eq!(outcome.describe(), "killed: this token was revoked");
    }

    #[tokio::test]
    async fn the_end_of_the_servant_is_no_exit_status() {
        let Scene { serving, socket, client: _client, .. } = Scene::open(std::future::pending()).await;
        drop(socket);
        assert_eq!(serving.await.expect("served"), ExecOutcome::ServantEnded);
    }
}
