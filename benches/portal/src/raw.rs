//! Raw TCPROS: connections to the node that are negotiated like those of any ROS node and then used as bare sockets.

use std::collections::HashMap;
use std::net::{SocketAddr, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, Result, ensure};
use async_trait::async_trait;
use bytes::BytesMut;
use reach::ServantSockets;
use ros::net::Sockets;
use ros::ros1::process::MASTER;
use ros::ros1::tcpros::Header;
use ros::ros1::xmlrpc::{self, Fault, ServerLimits, Value, XmlRpcClient, XmlRpcHandler};
use tokio::time::timeout;

use crate::node::{PATIENCE, TypeDescription};

/// Port of each topic that this node publishes.
type Ports = Arc<Mutex<HashMap<String, u16>>>;

/// Name of this node.
const NAME: &str = "/bench_direct";

/// A minimal ROS node, which serves as long as its runtime.
pub(crate) struct RawNode {
    inside: ServantSockets,
    master: XmlRpcClient,
    /// The node with which it exchanges messages.
    pub(crate) other: XmlRpcClient,
    uri: String,
    ports: Ports,
}

struct Slave(Ports);

#[async_trait]
impl XmlRpcHandler for Slave {
    async fn call(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault> {
        let topic = params.get(1).and_then(Value::as_str).unwrap_or_default();
        let ports = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let value = match (method, ports.get(topic)) {
            ("requestTopic", Some(port)) => {
                Value::Array(vec!["TCPROS".into(), "127.0.0.1".into(), Value::Int(i32::from(*port))])
            }
            _ => Value::Int(0),
        };
        Ok(Value::Array(vec![Value::Int(1), "".into(), value]))
    }
}

impl RawNode {
    /// Starts the node inside the servant, beside the node `other`.
    pub(crate) async fn start(inside: ServantSockets, other: &str) -> Result<Self> {
        let listener = inside.listen("127.0.0.1:0".parse()?).await?;
        let (uri, ports) = (format!("http://{}/", listener.local_addr()?), Ports::default());
        tokio::spawn(xmlrpc::serve(listener, Arc::new(Slave(ports.clone())), ServerLimits::default()));
        let client = |uri: &str| XmlRpcClient::new(Arc::new(inside.clone()), uri);
        let master = client(&format!("http://{MASTER}/"))?;
        let found = call(&master, "lookupNode", &[other.into()]).await?;
        let other = client(found.as_str().context("an address")?)?;
        Ok(Self { inside, master, other, uri, ports })
    }

    /// Opens a connection that receives messages of a topic of the other node.
    pub(crate) async fn subscribe(&self, topic: &str, kind: TypeDescription) -> Result<TcpStream> {
        let protocols = Value::Array(vec![Value::strings(["TCPROS"])]);
        let answer = call(&self.other, "requestTopic", &[topic.into(), protocols]).await?;
        let port = answer.as_array().and_then(|place| place.get(2)?.as_int());
        let port = port.with_context(|| format!("{topic} in {answer:?}"))?;
        let header = Header::new([
            ("callerid", NAME),
            ("topic", topic),
            ("type", kind.name),
            ("md5sum", kind.md5),
            ("tcp_nodelay", "1"),
        ]);
        self.connect(port.try_into()?, &header).await
    }

    /// Opens a connection for calls of a service of the node.
    pub(crate) async fn connect_service(&self, service: &str) -> Result<TcpStream> {
        let answer = call(&self.master, "lookupService", &[service.into()]).await?;
        let uri = answer.as_str().context("an address")?;
        let port = uri.trim_end_matches('/').rsplit(':').next().context("a port")?;
        let header = Header::new([("callerid", NAME), ("service", service), ("md5sum", "*"), ("persistent", "1")]);
        self.connect(port.parse()?, &header).await
    }

    async fn connect(&self, port: u16, header: &Header) -> Result<TcpStream> {
        let mut stream = self.inside.connect(SocketAddr::from(([127, 0, 0, 1], port))).await?;
        let mut buffer = BytesMut::new();
        header.exchange(&mut stream, &mut buffer).await?;
        ensure!(buffer.is_empty(), "nothing was asked for yet");
        into_blocking(stream)
    }

    /// Advertises a topic and returns the connection on which the node receives its messages.
    pub(crate) async fn publish(&self, topic: &str, kind: TypeDescription) -> Result<TcpStream> {
        let listener = self.inside.listen("127.0.0.1:0".parse()?).await?;
        let port = listener.local_addr()?.port();
        self.ports.lock().unwrap_or_else(PoisonError::into_inner).insert(topic.to_owned(), port);
        let registration = [topic.into(), kind.name.into(), self.uri.as_str().into()];
        call(&self.master, "registerPublisher", &registration).await?;
        let (mut stream, _) = timeout(PATIENCE, listener.accept()).await??;
        stream.set_nodelay(true)?;
        Header::read(&mut stream, &mut BytesMut::new()).await?;
        let answer = Header::new([
            ("callerid", NAME),
            ("topic", topic),
            ("type", kind.name),
            ("md5sum", kind.md5),
            ("message_definition", kind.definition),
            ("latching", "0"),
        ]);
        answer.write(&mut stream).await?;
        into_blocking(stream)
    }

    /// Unregisters a topic from the Master.
    pub(crate) async fn unpublish(&self, topic: &str) -> Result<()> {
        let arguments = [topic.into(), self.uri.as_str().into()];
        call(&self.master, "unregisterPublisher", &arguments).await?;
        Ok(())
    }
}

/// Calls a method and returns its value.
async fn call(of: &XmlRpcClient, method: &str, arguments: &[Value]) -> Result<Value> {
    let answer = of.call(method, &[&[NAME.into()], arguments].concat(), PATIENCE).await?;
    let answer = answer.as_array().context("an answer")?;
    ensure!(answer.first().and_then(Value::as_int) == Some(1), "{method}: {answer:?}");
    Ok(answer.get(2).cloned().unwrap_or(Value::Int(0)))
}

fn into_blocking(stream: tokio::net::TcpStream) -> Result<TcpStream> {
    let stream = stream.into_std()?;
    stream.set_nonblocking(false)?;
    Ok(stream)
}
