//! What the daemon shows, as it changes: `GET /api/v1/stream`, taken together.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::Context;
use api::explain::Served;
use api::stream::{Machine, Update};
use bytes::BytesMut;
use http_body_util::BodyExt;
use hyper::Method;
use hyper::body::Incoming;

use crate::client::{Client, empty};

/// All there is now.
#[derive(Debug, Default)]
pub struct Live {
    /// The machine, for those who are told of it.
    pub machine: Option<Arc<Machine>>,
    /// Servants by id.
    pub servants: BTreeMap<String, Arc<Served>>,
}

impl Live {
    /// Takes in what is so, or what has changed.
    fn take(&mut self, is_all: bool, update: Update) {
        if is_all {
            *self = Live::default();
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

/// Server-sent events (WHATWG HTML, section 9.2.6), of which the daemon uses `event`, `data` of one line, and comments.
pub struct Stream {
    body: Incoming,
    pending: BytesMut,
    event: String,
    /// All there is now.
    pub live: Live,
}

impl Stream {
    /// Begins to listen.
    pub async fn begin(client: &Client) -> anyhow::Result<Stream> {
        let answer = client.send(Method::GET, "/api/v1/stream", empty()).await?;
        Ok(Stream {
            body: answer.into_body(),
            pending: BytesMut::new(),
            event: String::new(),
            live: Live::default(),
        })
    }

    /// Waits for a change and takes it in; false when there will be none any more. What came is kept where this is dropped.
    pub async fn changed(&mut self) -> anyhow::Result<bool> {
        loop {
            while let Some(end) = self.pending.iter().position(|byte| *byte == b'\n') {
                let line = self.pending.split_to(end + 1);
                let line = std::str::from_utf8(&line).context("the stream is no text")?;
                if self.line(line.trim_end())? {
                    return Ok(true);
                }
            }
            let Some(frame) = self.body.frame().await else {
                return Ok(false);
            };
            let frame = frame.context("the daemon broke off its answer")?;
            if let Ok(data) = frame.into_data() {
                self.pending.extend_from_slice(&data);
            }
        }
    }

    /// Whether this line was a change.
    fn line(&mut self, line: &str) -> anyhow::Result<bool> {
        if let Some(event) = line.strip_prefix("event:") {
            event.trim_start().clone_into(&mut self.event);
        }
        let Some(data) = line.strip_prefix("data:") else {
            return Ok(false);
        };
        let update: Update = serde_json::from_str(data)
            .context("the daemon's answer is not what this version of cloudroidctl understands")?;
        self.live.take(self.event == "snapshot", update);
        Ok(true)
    }
}
