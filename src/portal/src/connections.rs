//! Connections: accepted from TCP, through TLS where the portal speaks it, and from Unix sockets.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use access::{Action, Principal};
use axum::Router;
use hyper::Request;
use hyper::body::Incoming;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use socket2::SockRef;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::{TcpListener, TcpStream, UnixListener, UnixStream};
use tokio_util::task::TaskTracker;

use crate::app::App;
use crate::guard::{self, Caller, Connection, Peer, User};
use crate::peer_groups;
use crate::principals::Shown;
use crate::tls::{self, Accepted, Tls};

/// When no connection can be accepted (no file descriptor is left, say), the next attempt waits.
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
/// Bytes of a request's header. What has come of it is read again with each part that comes.
const LONGEST_HEADER: usize = 64 << 10;
/// Bytes that the kernel takes for a connection beyond those that are on their way.
const UNSENT: u32 = 128 * 1024;

/// Accepts TCP connections until the daemon ends.
pub async fn serve_tcp(app: Arc<App>, router: Router, listener: TcpListener) {
    let connections = TaskTracker::new();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = app.ending.cancelled() => break,
        };
        match accepted {
            Ok((stream, address)) => {
                tune(&stream);
                let stranger = app.strangers.enter(&app.options.proxies, address.ip());
                let connection = Connection {
                    stranger: Some(Arc::new(stranger)),
                    ..Connection::plain(Peer::Tcp(address))
                };
                connections.spawn(secured(
                    Arc::clone(&app),
                    router.clone(),
                    stream,
                    connection,
                ));
            }
            Err(error) => {
                tracing::warn!("no connection can be accepted: {error}");
                // It may be for want of a descriptor.
                app.strangers.make_room();
                tokio::time::sleep(ACCEPT_AGAIN).await;
            }
        }
    }
    drain(&app, connections).await;
}

/// Answers challenges of authorities (RFC 8737), and nothing else, until the daemon ends.
pub async fn serve_challenges(app: Arc<App>, listener: TcpListener) {
    let Some(tls) = &app.tls else { return };
    let connections = TaskTracker::new();
    while let Some(accepted) = app.ending.run_until_cancelled(listener.accept()).await {
        let Ok((stream, address)) = accepted else {
            tokio::time::sleep(ACCEPT_AGAIN).await;
            continue;
        };
        let stranger = app.strangers.enter(&app.options.proxies, address.ip());
        let (tls, time) = (Arc::clone(tls), app.options.handshake);
        connections.spawn(async move {
            tokio::select! {
                // Whoever did not come for it is let go.
                _ = tokio::time::timeout(time, tls.accept(stream)) => {}
                () = stranger.dropped() => {}
            }
        });
    }
    drain(&app, connections).await;
}

/// Makes a connection fit for many small messages beside big ones. What cannot be set is not needed to go on.
fn tune(stream: &TcpStream) {
    // None of them waits for the next.
    let _ = stream.set_nodelay(true);
    // The kernel would take megabytes for a client that reads slowly, and an answer would wait behind all of them.
    let _ = SockRef::from(stream).set_tcp_notsent_lowat(UNSENT);
}

/// Accepts connections on a Unix socket until the daemon ends. Members of `group` are admins there.
pub async fn serve_unix(app: Arc<App>, router: Router, listener: UnixListener, group: Option<u32>) {
    let connections = TaskTracker::new();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = app.ending.cancelled() => break,
        };
        match accepted.and_then(|(stream, _)| Ok((user(&stream, group)?, stream))) {
            Ok((user, stream)) => {
                let connection = Connection::plain(Peer::Unix(user));
                connections.spawn(serve(Arc::clone(&app), router.clone(), stream, connection));
            }
            Err(error) => {
                tracing::warn!("no connection can be accepted on the socket: {error}");
                tokio::time::sleep(ACCEPT_AGAIN).await;
            }
        }
    }
    drain(&app, connections).await;
}

/// Who is at the other end.
fn user(stream: &UnixStream, group: Option<u32>) -> std::io::Result<User> {
    let peer = stream.peer_cred()?;
    let is_member = match group {
        None => false,
        Some(group) => peer.gid() == group || peer_groups::of(stream)?.contains(&group),
    };
    Ok(User {
        uid: peer.uid(),
        is_member,
    })
}

async fn drain(app: &App, connections: TaskTracker) {
    connections.close();
    let _ = tokio::time::timeout(app.options.drain, connections.wait()).await;
}

/// Serves a TCP connection, through TLS where the portal speaks it, until it ends or newer ones need its place.
async fn secured(app: Arc<App>, router: Router, stream: TcpStream, connection: Connection) {
    let peer = connection.peer;
    let place = connection.clone();
    let served = async {
        match &app.tls {
            Some(tls) => serve_tls(&app, tls, router, stream, connection).await,
            None => serve(Arc::clone(&app), router, stream, connection).await,
        }
    };
    tokio::select! {
        () = served => {}
        () = place.dropped() => {
            tracing::debug!("dropped {peer}: it has not shown who asks, and newer ones need its place");
        }
    }
}

async fn serve_tls(
    app: &Arc<App>,
    tls: &Tls,
    router: Router,
    stream: TcpStream,
    connection: Connection,
) {
    let peer = connection.peer;
    let accepted = tokio::select! {
        accepted = tokio::time::timeout(app.options.handshake, tls.accept(stream)) => accepted,
        () = app.ending.cancelled() => return,
    };
    match accepted {
        Ok(Ok(Accepted::Tls(stream))) => {
            let connection = Connection {
                secure: true,
                certificates: tls::certificates(&stream),
                ..connection
            };
            let ended = unpaired(app, &connection);
            tokio::select! {
                // A connection that became a WebSocket goes on in its session, which is told the same.
                () = ended => {}
                () = serve(Arc::clone(app), router, *stream, connection) => {}
            }
        }
        Ok(Ok(Accepted::Plain(stream))) => {
            serve(Arc::clone(app), tls::refusing(), stream, connection).await;
        }
        Ok(Ok(Accepted::Challenge)) => {
            tracing::debug!("{peer} has seen the answer to a challenge");
        }
        Ok(Err(error)) => {
            tracing::debug!("no TLS with {peer}: {error}");
            if let Some(refused) = tls::refused_certificate(&error) {
                let nobody = Caller::new(&connection, Principal::nobody(), Shown::Nothing);
                let did = format!("showed a certificate that was refused: {refused}");
                let status = axum::http::StatusCode::UNAUTHORIZED.as_u16();
                app.audit
                    .record_sparingly(&nobody, Action::Enter, &did, "the server", status);
            }
        }
        Err(_) => tracing::debug!("no TLS with {peer}: its handshake did not end in time"),
    }
}

/// Comes back when the pairing ends of the robot whose certificate a connection has shown.
fn unpaired(app: &Arc<App>, connection: &Connection) -> impl Future<Output = ()> + use<> {
    let who = app
        .principals
        .with(|known| guard::certified(app, connection, known));
    let app = Arc::clone(app);
    async move {
        match who {
            Some(Ok(who)) => {
                app.principals.ended(&who, "", false).await;
            }
            // Who shows none, or one that is refused, is answered so.
            _ => std::future::pending().await,
        }
    }
}

async fn serve(
    app: Arc<App>,
    router: Router,
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    connection: Connection,
) {
    let peer = connection.peer;
    let router = TowerToHyperService::new(router);
    let service = service_fn(move |mut request: Request<Incoming>| {
        request.extensions_mut().insert(connection.clone());
        let answer = hyper::service::Service::call(&router, request);
        async move { Ok::<_, Infallible>(answer.await.unwrap_or_else(|never| match never {})) }
    });
    let served = hyper::server::conn::http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(app.options.handshake)
        .max_header_size(LONGEST_HEADER)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    tokio::pin!(served);
    let outcome = tokio::select! {
        outcome = served.as_mut() => outcome,
        () = app.ending.cancelled() => {
            served.as_mut().graceful_shutdown();
            served.await
        }
    };
    if let Err(error) = outcome {
        tracing::debug!("a connection from {peer:?} ended: {error}");
    }
}
