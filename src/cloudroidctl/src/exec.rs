//! `exec`: runs a program in a servant.

use std::convert::Infallible;
use std::fmt;
use std::io::IsTerminal;

use anyhow::{Context, bail};
use api::exec::{ExecFrame, MAX_CONTENT, PROTOCOL, TerminalSize};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;

use crate::client::{DaemonClient, percent_encode};
use crate::inside;

/// Bytes of standard input that are sent at once.
const BLOCK: usize = 16 << 10;

/// Run a program in a servant, as its user and within its limits; without COMMAND a shell. At a terminal it has a
/// terminal, otherwise separate streams. It and all that it has started are killed when the connection ends. The exit
/// status is the program's, or one of the table in `cloudroidctl --help` if it could not be run.
#[derive(Debug, clap::Args)]
pub struct ExecArgs {
    /// Id of a servant, or name of a service that has one servant.
    servant: String,
    /// Use separate streams even at a terminal.
    #[arg(short = 'T', long)]
    no_terminal: bool,
    /// Program and its arguments, after `--`.
    #[arg(last = true, value_name = "COMMAND")]
    command: Vec<String>,
}

/// The program ended with another exit status than 0.
#[derive(Debug)]
pub struct ProgramFailed {
    /// Exit status of the program.
    pub status: u8,
}

impl fmt::Display for ProgramFailed {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "the program ended with status {}", self.status)
    }
}

impl std::error::Error for ProgramFailed {}

/// Raw mode of this terminal: keys, Ctrl-C included, are passed on as they are. Ends when dropped.
struct RawMode;

impl RawMode {
    fn enter() -> anyhow::Result<RawMode> {
        crossterm::terminal::enable_raw_mode().context("cannot pass on keys of this terminal; try --no-terminal")?;
        Ok(RawMode)
    }
}

impl Drop for RawMode {
    fn drop(&mut self) {
        // Nothing is left to do if the terminal is gone.
        let _ = crossterm::terminal::disable_raw_mode();
    }
}

impl ExecArgs {
    /// Runs the program and returns when it has ended.
    pub async fn run(self, client: &DaemonClient) -> anyhow::Result<()> {
        let servant = inside::resolve_servant(client, &self.servant).await?;
        let is_terminal = !self.no_terminal && std::io::stdin().is_terminal() && std::io::stdout().is_terminal();
        let terminal = is_terminal.then(terminal_size).transpose()?;
        let path = format!("/api/v1/servants/{}/exec?{}", percent_encode(&servant), query(&self.command, terminal));
        let resized = terminal.map(|_| signal(SignalKind::window_change())).transpose()?;
        let socket = client.connect_websocket(&path, PROTOCOL).await?;
        let raw = terminal.map(|_| RawMode::enter()).transpose()?;
        let (sink, stream) = socket.split();
        let status = tokio::select! {
            status = receive_output(stream) => status,
            never = send_input(sink, resized) => match never {},
        };
        drop(raw);
        match u8::try_from(status?).unwrap_or(u8::MAX) {
            0 => Ok(()),
            status => Err(ProgramFailed { status }.into()),
        }
    }
}

fn terminal_size() -> anyhow::Result<TerminalSize> {
    let (columns, rows) = crossterm::terminal::size().context("cannot read the size of this terminal")?;
    Ok(TerminalSize { columns, rows })
}

/// Returns the query of a request.
fn query(command: &[String], terminal: Option<TerminalSize>) -> String {
    let mut query: Vec<String> =
        command.iter().map(|argument| format!("argument={}", percent_encode(argument))).collect();
    if let Some(TerminalSize { columns, rows }) = terminal {
        query.push(format!("terminal=true&columns={}&rows={}", columns.max(1), rows.max(1)));
        if let Some(term) = std::env::var("TERM").ok().filter(|term| !term.is_empty()) {
            query.push(format!("term={}", percent_encode(&term)));
        }
    }
    query.join("&")
}

/// Sends standard input and new sizes of the terminal. Never returns: what keeps it from sending is told better by the
/// other direction.
async fn send_input<S: AsyncRead + AsyncWrite + Unpin>(
    mut sink: SplitSink<WebSocketStream<S>, Message>,
    mut resized: Option<Signal>,
) -> Infallible {
    let mut input = Some(tokio::io::stdin());
    let mut block = vec![0; BLOCK.min(MAX_CONTENT)];
    loop {
        let frame = tokio::select! {
            read = read_open(input.as_mut(), &mut block) => match read {
                Ok(length @ 1..) => ExecFrame::Input(&block[..length]),
                _ => {
                    input = None;
                    ExecFrame::Input(&[])
                }
            },
            () = wait_for_resize(resized.as_mut()) => match terminal_size() {
                Ok(size) => ExecFrame::Size(size),
                Err(_) => continue,
            },
        };
        if sink.send(Message::Binary(frame.encode().into())).await.is_err() {
            return std::future::pending().await;
        }
    }
}

/// Reads standard input; once that has ended, never returns.
async fn read_open(input: Option<&mut tokio::io::Stdin>, into: &mut [u8]) -> std::io::Result<usize> {
    match input {
        Some(input) => input.read(into).await,
        None => std::future::pending().await,
    }
}

async fn wait_for_resize(resized: Option<&mut Signal>) {
    let came = match resized {
        Some(resized) => resized.recv().await,
        None => None,
    };
    if came.is_none() {
        std::future::pending().await
    }
}

/// Prints the program's output; returns its exit status.
async fn receive_output<S: AsyncRead + AsyncWrite + Unpin>(
    mut stream: SplitStream<WebSocketStream<S>>,
) -> anyhow::Result<i32> {
    let (mut out, mut err) = (tokio::io::stdout(), tokio::io::stderr());
    while let Some(message) = stream.next().await {
        match message.context("the daemon broke the connection; the program was killed")? {
            Message::Binary(content) => match ExecFrame::decode(&content) {
                Some(ExecFrame::Output(printed)) => {
                    out.write_all(printed).await?;
                    out.flush().await?;
                }
                Some(ExecFrame::Error(printed)) => {
                    err.write_all(printed).await?;
                    err.flush().await?;
                }
                Some(ExecFrame::Exit(status)) => return Ok(status),
                _ => bail!("this version of cloudroidctl does not understand the daemon's message"),
            },
            Message::Close(close) => {
                let reason = close.map(|close| close.reason.to_string()).filter(|reason| !reason.is_empty());
                bail!("the program was killed: {}", reason.as_deref().unwrap_or("the daemon ended the session"));
            }
            _ => {}
        }
    }
    bail!("the daemon broke the connection; the program was killed")
}

#[cfg(test)]
mod tests {
    use tokio::io::DuplexStream;
    use tokio_tungstenite::tungstenite::protocol::{CloseFrame, Role, frame::coding::CloseCode};

    use super::*;

    #[test]
    fn a_command_is_passed_word_by_word() {
        let command = ["sh", "-c", "echo a&b"].map(str::to_owned);
        assert_eq!(query(&command, None), "argument=sh&argument=-c&argument=echo%20a%26b");
        let size = TerminalSize { columns: 0, rows: 50 };
        assert!(query(&[], Some(size)).starts_with("terminal=true&columns=1&rows=50"));
    }

    /// Returns what a client makes of these messages of the daemon.
    async fn receive(messages: Vec<Message>) -> anyhow::Result<i32> {
        let (ours, far) = tokio::io::duplex(1 << 12);
        let client: WebSocketStream<DuplexStream> = WebSocketStream::from_raw_socket(ours, Role::Client, None).await;
        let mut daemon = WebSocketStream::from_raw_socket(far, Role::Server, None).await;
        let breaks_off = messages.is_empty();
        for message in messages {
            daemon.send(message).await?;
        }
        let _daemon = (!breaks_off).then_some(daemon);
        receive_output(client.split().1).await
    }

    #[tokio::test]
    async fn the_status_of_the_program_is_told_from_an_end_without_one() {
        let exit = |status| Message::Binary(ExecFrame::Exit(status).encode().into());
        assert_eq!(receive(vec![Message::Ping(Default::default()), exit(3)]).await.expect("a status"), 3);
        let close = CloseFrame { code: CloseCode::Policy, reason: "this token was revoked".into() };
        let killed = receive(vec![Message::Close(Some(close))]).await.expect_err("no status").to_string();
        assert_eq!(killed, "the program was killed: this token was revoked");
        let broken = receive(Vec::new()).await.expect_err("no status").to_string();
        assert!(broken.contains("broke the connection"), "{broken}");
    }
}
