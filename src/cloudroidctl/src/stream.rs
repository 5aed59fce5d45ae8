//! The daemon's live state: merges the updates of `GET /api/v1/stream`.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::Context;
use api::explain::Served;
use api::stream::{Machine, Update};
use bytes::BytesMut;
use http_body_util::BodyExt;
use hyper::Method;
use hyper::body::Incoming;

use crate::client::{DaemonClient, empty_body};

/// Current state of the machine and its servants.
#[derive(Debug, Default)]
pub struct LiveState {
    /// State of the machine, if the caller may see it.
    pub machine: Option<Arc<Machine>>,
    /// Servants by id.
    pub servants: BTreeMap<String, Arc<Served>>,
}

impl LiveState {
    /// Applies a snapshot (`is_all`) or a change.
    fn apply(&mut self, is_all: bool, update: Update) {
        if is_all {
            *self = LiveState::default();
        }
        if let Some(machine) = update.machine {
            self.machine = Some(machine);
        }
        for id in &update.servants_gone {
            self.servants.remove(id);
        }
        for served in update.servants {
            self.servants.insert(served.servant.id.clone(), served);
        }
    }
}

/// Reader of server-sent events (WHATWG HTML, section 9.2.6), of which the daemon uses `event`, one-line `data`, and
/// comments.
pub struct LiveStream {
    body: Incoming,
    pending: BytesMut,
    event: String,
    /// Current state.
    pub live: LiveState,
}

impl LiveStream {
    /// Opens the stream.
    pub async fn open(client: &DaemonClient) -> anyhow::Result<LiveStream> {
        let answer = client.send(Method::GET, "/api/v1/stream", empty_body()).await?;
        Ok(LiveStream {
            body: answer.into_body(),
            pending: BytesMut::new(),
            event: String::new(),
            live: LiveState::default(),
        })
    }

    /// Waits for a change and applies it; false at the end of the stream. Cancel-safe: data received so far is kept.
    pub async fn next_change(&mut self) -> anyhow::Result<bool> {
        loop {
            while let Some(end) = self.pending.iter().position(|byte| *byte == b'\n') {
                let line = self.pending.split_to(end + 1);
                let line = std::str::from_utf8(&line).context("the stream is not valid UTF-8")?;
                if self.process_line(line.trim_end())? {
                    return Ok(true);
                }
            }
            let Some(frame) = self.body.frame().await else {
                return Ok(false);
            };
            let frame = frame.context("the daemon's response was cut off")?;
            if let Ok(data) = frame.into_data() {
                self.pending.extend_from_slice(&data);
            }
        }
    }

    /// Processes a line; returns whether it was a change.
    fn process_line(&mut self, line: &str) -> anyhow::Result<bool> {
        if let Some(event) = line.strip_prefix("event:") {
            event.trim_start().clone_into(&mut self.event);
        }
        let Some(data) = line.strip_prefix("data:") else {
            return Ok(false);
        };
        let update: Update = serde_json::from_str(data)
            .context("this version of cloudroidctl does not understand the daemon's response")?;
        self.live.apply(self.event == "snapshot", update);
        Ok(true)
    }
}
