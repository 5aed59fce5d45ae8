//! Connections: accepted from TCP, through TLS if the portal uses it, and from Unix sockets.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use access::{AccessAction, Principal};
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
use crate::caller::{Caller, ConnectionPeer, PortalConnection, User};
use crate::guard;
use crate::peer_groups;
use crate::principals::identity::Credential;
use crate::tls::{self, AcceptedConnection, Tls};

/// Delay after a failed accept, for example if no file descriptor is left.
const ACCEPT_AGAIN: Duration = Duration::from_millis(100);
/// Maximum size of a request's header in bytes. The header is parsed again with each part received.
const LONGEST_HEADER: usize = 64 << 10;
/// Bytes the kernel buffers for a connection beyond those in flight.
const UNSENT: u32 = 128 * 1024;

/// Accepts TCP connections until the daemon stops.
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
                let connection = PortalConnection {
                    stranger: Some(Arc::new(stranger)),
                    ..PortalConnection::without_tls(ConnectionPeer::Tcp(address))
                };
                connections.spawn(serve_tcp_connection(Arc::clone(&app), router.clone(), stream, connection));
            }
            Err(error) => {
                tracing::warn!("no connection can be accepted: {error}");
                // The cause may be a lack of descriptors.
                app.strangers.make_room();
                tokio::time::sleep(ACCEPT_AGAIN).await;
            }
        }
    }
    drain(&app, connections).await;
}

/// Answers only the authorities' challenges (RFC 8737), until the daemon stops.
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
                // Other clients are disconnected.
                _ = tokio::time::timeout(time, tls.accept(stream)) => {}
                () = stranger.wait_until_dropped() => {}
            }
        });
    }
    drain(&app, connections).await;
}

/// Tunes a connection for many small messages beside large ones. Failures are ignored.
fn tune(stream: &TcpStream) {
    // Small messages must not be delayed by Nagle's algorithm.
    let _ = stream.set_nodelay(true);
    // Otherwise the kernel would buffer megabytes for a slow client, and a reply would wait behind them.
    let _ = SockRef::from(stream).set_tcp_notsent_lowat(UNSENT);
}

/// Accepts connections on a Unix socket until the daemon stops. Members of `group` are admins there.
pub async fn serve_unix(app: Arc<App>, router: Router, listener: UnixListener, group: Option<u32>) {
    let connections = TaskTracker::new();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = app.ending.cancelled() => break,
        };
        match accepted.and_then(|(stream, _)| Ok((peer_user(&stream, group)?, stream))) {
            Ok((user, stream)) => {
                let connection = PortalConnection::without_tls(ConnectionPeer::Unix(user));
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

/// Returns the user at the other end.
fn peer_user(stream: &UnixStream, group: Option<u32>) -> std::io::Result<User> {
    let peer = stream.peer_cred()?;
    let is_member = match group {
        None => false,
        Some(group) => peer.gid() == group || peer_groups::peer_groups(stream)?.contains(&group),
    };
    Ok(User { uid: peer.uid(), is_member })
}

async fn drain(app: &App, connections: TaskTracker) {
    connections.close();
    let _ = tokio::time::timeout(app.options.drain, connections.wait()).await;
}

/// Serves a TCP connection, through TLS if the portal uses it, until it ends or is dropped in favour of newer ones.
async fn serve_tcp_connection(app: Arc<App>, router: Router, stream: TcpStream, connection: PortalConnection) {
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
        () = place.wait_until_dropped() => {
            tracing::debug!("dropped {peer}: it had not authenticated, and newer connections need its place");
        }
    }
}

async fn serve_tls(app: &Arc<App>, tls: &Tls, router: Router, stream: TcpStream, connection: PortalConnection) {
    let peer = connection.peer;
    let accepted = tokio::select! {
        accepted = tokio::time::timeout(app.options.handshake, tls.accept(stream)) => accepted,
        () = app.ending.cancelled() => return,
    };
    match accepted {
        Ok(Ok(AcceptedConnection::Tls(stream))) => {
            let connection =
                PortalConnection { secure: true, certificates: tls::peer_certificates(&stream), ..connection };
            let ended = wait_until_unpaired(app, &connection);
            tokio::select! {
                // A connection upgraded to a WebSocket continues in its session, which is notified as well.
                () = ended => {}
                () = serve(Arc::clone(app), router, *stream, connection) => {}
            }
        }
        Ok(Ok(AcceptedConnection::Plain(stream))) => {
            serve(Arc::clone(app), tls::plain_text_router(), stream, connection).await;
        }
        Ok(Ok(AcceptedConnection::Challenge)) => {
            tracing::debug!("answered an ACME challenge of {peer}");
        }
        Ok(Err(error)) => {
            tracing::debug!("TLS handshake with {peer} failed: {error}");
            if let Some(refused) = tls::refused_certificate(&error) {
                let nobody = Caller::new(&connection, Principal::nobody(), Credential::Nothing);
                let did = format!("presented a certificate that was refused: {refused}");
                let status = axum::http::StatusCode::UNAUTHORIZED.as_u16();
                app.audit.record_throttled(&nobody, AccessAction::Enter, &did, "the server", status);
            }
        }
        Err(_) => tracing::debug!("TLS handshake with {peer} failed: it did not finish in time"),
    }
}

/// Waits until the robot is unpaired whose certificate the connection presented.
fn wait_until_unpaired(app: &Arc<App>, connection: &PortalConnection) -> impl Future<Output = ()> + use<> {
    let who = app.principals.with_recogniser(|known| guard::recognise_certificate(app, connection, known));
    let app = Arc::clone(app);
    async move {
        match who {
            Some(Ok(who)) => {
                app.principals.wait_for_end(&who, "", false).await;
            }
            // Without a certificate, or with a refused one, requests are answered accordingly.
            _ => std::future::pending().await,
        }
    }
}

async fn serve(
    app: Arc<App>,
    router: Router,
    stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static,
    connection: PortalConnection,
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
