//! A robot: a WebSocket client of the rosbridge protocol that uses none of our code.

use std::net::TcpStream;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use serde_json::{Value, json};
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

/// Maximum time to wait for an answer.
const PATIENCE: Duration = Duration::from_secs(60);

/// One connection.
pub(crate) struct BenchRobot(WebSocket<TcpStream>);

impl BenchRobot {
    /// Connects to `ws://ADDRESS/PATH`.
    pub(crate) fn connect(address: &str, path: &str) -> Result<Self> {
        let stream = TcpStream::connect(address)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        match tungstenite::client(format!("ws://{address}/{path}"), stream) {
            Ok((socket, _)) => Ok(Self(socket)),
            Err(tungstenite::HandshakeError::Failure(error)) => Err(error).context(path.to_owned()),
            Err(tungstenite::HandshakeError::Interrupted(_)) => {
                bail!("{path}: no answer within {PATIENCE:?}")
            }
        }
    }

    /// Returns the nodes that rosapi reports; the call is answered once the servant is ready.
    pub(crate) fn nodes(&mut self) -> Result<Vec<String>> {
        let call =
            json!({"op": "call_service", "id": "nodes", "service": "/rosapi/nodes", "args": {}});
        self.0.send(Message::text(call.to_string()))?;
        loop {
            let text = match self.0.read()? {
                Message::Text(text) => text,
                Message::Close(frame) => bail!("the connection was closed: {frame:?}"),
                _ => continue,
            };
            let said: Value = serde_json::from_str(text.as_str())?;
            if said["id"] != "nodes" {
                continue;
            }
            let nodes = said["values"]["nodes"]
                .as_array()
                .with_context(|| format!("nodes in {said}"))?;
            return Ok(nodes
                .iter()
                .filter_map(|node| Some(node.as_str()?.to_owned()))
                .collect());
        }
    }

    /// Closes the connection and waits for the close frame.
    pub(crate) fn leave(mut self) -> Result<()> {
        self.0.close(None)?;
        while self.0.read().is_ok() {}
        Ok(())
    }
}
