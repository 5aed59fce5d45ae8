//! A rosbridge server for a ROS 1 system that is already there, without containers:
//! `cargo run --release -p bridge --example serve [-- LISTEN [MASTER [SHARE…]]]`, 127.0.0.1:9090, 127.0.0.1:11311 and
//! `/usr/share` by default; definitions are read from the packages below SHARE. A line on standard input prints the
//! counters.

use std::fs;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;

use bridge::{Bridge, BridgeOptions, SessionOptions};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::schema::Registry;
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::net::{TcpListener, TcpStream};
use tokio_tungstenite::tungstenite::handshake::server::{Request, Response};

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let listen = arguments.next().unwrap_or("127.0.0.1:9090".to_owned());
    let master: SocketAddr = arguments
        .next()
        .unwrap_or("127.0.0.1:11311".to_owned())
        .parse()?;
    let registry = Arc::new(Registry::new());
    let mut shares: Vec<String> = arguments.collect();
    if shares.is_empty() {
        shares.push("/usr/share".to_owned());
    }
    for share in shares {
        read_definitions(Path::new(&share), &registry)?;
    }
    println!("{} definitions", registry.keys().len());
    let bus = Ros1Bus::connect(Arc::new(HostSockets), master, "/cloudroid_bridge").await?;
    let bridge = Bridge::new(bus, registry, BridgeOptions::default());
    tokio::spawn(report(bridge.clone()));
    let listener = TcpListener::bind(listen).await?;
    println!("listening on ws://{}", listener.local_addr()?);
    loop {
        let (stream, peer) = listener.accept().await?;
        let bridge = bridge.clone();
        tokio::spawn(async move {
            match serve(&bridge, stream, peer).await {
                Ok(end) => println!("{peer}: {end:?}"),
                Err(error) => println!("{peer}: {error}"),
            }
        });
    }
}

#[expect(
    clippy::result_large_err,
    reason = "tungstenite's callback has this signature"
)]
async fn serve(
    bridge: &Arc<Bridge>,
    stream: TcpStream,
    peer: SocketAddr,
) -> Result<bridge::SessionEnd, Box<dyn std::error::Error + Send + Sync>> {
    stream.set_nodelay(true)?;
    let mut options = SessionOptions {
        client: peer.to_string(),
        ..SessionOptions::default()
    };
    let read_query = |request: &Request, response: Response| {
        let query = request.uri().query().unwrap_or_default();
        options.resume = query
            .split('&')
            .find_map(|pair| pair.strip_prefix("resume="))
            .map(str::to_owned);
        Ok(response)
    };
    let socket = tokio_tungstenite::accept_hdr_async(stream, read_query).await?;
    Ok(bridge.serve(socket.into_inner(), options).await)
}

async fn report(bridge: Arc<Bridge>) {
    let mut lines = BufReader::new(tokio::io::stdin()).lines();
    while let Ok(Some(_)) = lines.next_line().await {
        let mut text = String::new();
        bridge.metrics().prometheus(&mut text, "");
        println!("{text}");
    }
}

/// Reads all `.msg`, `.srv` and `.action` files of the packages below a folder.
fn read_definitions(share: &Path, registry: &Registry) -> std::io::Result<()> {
    for package in fs::read_dir(share)? {
        let package = package?.path();
        for kind in ["msg", "srv", "action"] {
            let Ok(files) = fs::read_dir(package.join(kind)) else {
                continue;
            };
            for file in files {
                let file = file?.path();
                if file.extension().is_none_or(|extension| extension != kind) {
                    continue;
                }
                let name = |path: &Path| {
                    path.file_stem()
                        .unwrap_or_default()
                        .to_string_lossy()
                        .into_owned()
                };
                let key = format!("{}/{kind}/{}", name(&package), name(&file));
                if let Err(error) = registry.insert(&key, &fs::read_to_string(&file)?) {
                    println!("{key}: {error}");
                }
            }
        }
    }
    Ok(())
}
