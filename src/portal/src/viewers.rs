//! Viewers: `ws://host:9090/foxglove/ID` speaks Foxglove's WebSocket protocol beside the servant's robot, with the
//! same permissions as looking inside ([`crate::inside`]).

use std::sync::Arc;

use axum::Extension;
use axum::extract::{Path, Request, State};
use axum::http::HeaderMap;
use axum::response::Response;
use viewer::{DEPTH, PROTOCOLS, ViewerOptions};

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;
use crate::headers;
use crate::inside::InsideAccess;
use crate::query;

/// Returns the newest subprotocol that the viewer offers and this server supports.
fn choose_protocol(headers: &HeaderMap) -> Result<&'static str, Error> {
    let spoken = PROTOCOLS.into_iter().find(|protocol| headers::protocols(headers).any(|offered| offered == *protocol));
    spoken.ok_or_else(|| {
        Error::BadRequest(format!(
            "this address speaks {} to viewers, but the client offers none of these; Foxglove and Lichtblick do \
                (\"Open connection\")",
            PROTOCOLS.join(" and ")
        ))
    })
}

/// Parses the queue size per topic: `?depth=N`.
fn parse_depth(query: Option<&str>) -> Result<usize, Error> {
    let Some(said) = query::query_value(query, "depth") else {
        return Ok(*DEPTH.start());
    };
    let depth = said.parse().ok().filter(|depth| DEPTH.contains(depth));
    depth.ok_or_else(|| {
        let (least, most) = (DEPTH.start(), DEPTH.end());
        Error::BadRequest(format!("depth={said:?} is not a number of messages from {least} to {most}"))
    })
}

/// Upgrades to a WebSocket that serves a viewer inside the servant.
pub async fn viewer(
    State(app): State<Arc<App>>,
    Path(id): Path<String>,
    Extension(caller): Extension<Caller>,
    request: Request,
) -> Result<Response, Error> {
    let door = InsideAccess::authorise(&app, &id, caller)?;
    let protocol = choose_protocol(request.headers())?;
    let depth = parse_depth(request.uri().query())?;
    let unfinished = app.choreographer.bridge_options().unfinished;
    door.upgrade(request, Some(protocol), async move |looker, io, read_ahead| {
        let handle = &looker.handle;
        let options = ViewerOptions {
            name: format!("{} at {} ({id})", handle.robot, handle.service()),
            granted: looker.granted,
            budget: looker.budget,
            unfinished,
            depth,
        };
        let servant = async {
            let looked = looker.reach.open_inside().await;
            looked.map(|looked| viewer::ViewedServant {
                bus: looked.bus,
                registry: looked.registry,
                ended: looked.ended,
                held: looked.held,
            })
        };
        viewer::serve(io, read_ahead, servant, options).await;
        tracing::debug!("a viewer left servant {id}");
    })
}
