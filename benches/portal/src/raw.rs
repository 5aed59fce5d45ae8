//! Raw TCPROS: connections to the node, negotiated as any ROS node does, then bare sockets.

use std::collections::HashMap;
use std::net::{SocketAddr, TcpStream};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context, Result, ensure};
use async_trait::async_trait;
use bytes::BytesMut;
use ros::net::Sockets;
use ros::ros1::tcpros::Header;
use ros::ros1::xmlrpc::{self, Client, Fault, Handler, Limits, Value};
use tokio::task::JoinHandle;
use tokio::time::timeout;

use crate::node::{Inside, MASTER, PATIENCE, Type, address_of};

/// Where each of our topics is served.
type Ports = Arc<Mutex<HashMap<String, u16>>>;

/// A node with as little in it as will do.
pub(crate) struct Raw {
    inside: Inside,
    name: String,
    uri: String,
    ports: Ports,
    serving: JoinHandle<()>,
}

struct Slave(Ports);

#[async_trait]
impl Handler for Slave {
    async fn call(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault> {
        let topic = params.get(1).and_then(Value::as_str).unwrap_or_default();
        let ports = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let value = match (method, ports.get(topic)) {
            ("requestTopic", Some(port)) => Value::Array(vec![
                "TCPROS".into(),
                "127.0.0.1".into(),
                Value::Int(i32::from(*port)),
            ]),
            _ => Value::Int(0),
        };
        Ok(Value::Array(vec![Value::Int(1), "".into(), value]))
    }
}

impl Raw {
    /// A node of this name inside the servant.
    pub(crate) async fn start(inside: Inside, name: &str) -> Result<Self> {
        let listener = inside.listen("127.0.0.1:0".parse()?).await?;
        let uri = format!("http://{}/", listener.local_addr()?);
        let ports = Ports::default();
        let handler = Arc::new(Slave(ports.clone()));
        Ok(Self {
            inside,
            name: name.to_owned(),
            uri,
            ports,
            serving: tokio::spawn(xmlrpc::serve(listener, handler, Limits::default())),
        })
    }

    /// A connection on which the node's messages come.
    pub(crate) async fn subscribe(&self, topic: &str, kind: Type) -> Result<TcpStream> {
        let node = topic.rsplit_once('/').context("NODE/TOPIC")?.0;
        let slave = address_of(&self.inside, node).await?;
        let slave = Client::new(Arc::new(self.inside.clone()), &slave)?;
        let protocols = Value::Array(vec![Value::strings(["TCPROS"])]);
        let arguments = [self.name.as_str().into(), topic.into(), protocols];
        let answer = slave.call("requestTopic", &arguments, PATIENCE).await?;
        let place = answer
            .as_array()
            .and_then(|answer| answer.get(2)?.as_array());
        let port = place
            .and_then(|place| place.get(2)?.as_int())
            .with_context(|| format!("{topic} in {answer:?}"))?;
        let header = Header::new([
            ("callerid", self.name.as_str()),
            ("topic", topic),
            ("type", kind.name),
            ("md5sum", kind.md5),
            ("tcp_nodelay", "1"),
        ]);
        self.connect(port.try_into()?, &header).await
    }

    /// A connection for calls of one of the node's services.
    pub(crate) async fn service(&self, service: &str) -> Result<TcpStream> {
        let answer = self.master("lookupService", &[service.into()]).await?;
        let uri = answer.as_str().context("an address")?;
        let port = uri
            .trim_end_matches('/')
            .rsplit(':')
            .next()
            .context("a port")?;
        let header = Header::new([
            ("callerid", self.name.as_str()),
            ("service", service),
            ("md5sum", "*"),
            ("persistent", "1"),
        ]);
        self.connect(port.parse()?, &header).await
    }

    async fn connect(&self, port: u16, header: &Header) -> Result<TcpStream> {
        let mut stream = self
            .inside
            .connect(SocketAddr::from(([127, 0, 0, 1], port)))
            .await?;
        let mut buffer = BytesMut::new();
        header.exchange(&mut stream, &mut buffer).await?;
        ensure!(buffer.is_empty(), "nothing was asked for yet");
        blocking(stream)
    }

    /// A connection on which the node waits for messages.
    pub(crate) async fn publish(&self, topic: &str, kind: Type) -> Result<TcpStream> {
        let listener = self.inside.listen("127.0.0.1:0".parse()?).await?;
        let port = listener.local_addr()?.port();
        self.ports
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .insert(topic.to_owned(), port);
        let registration = [topic.into(), kind.name.into(), self.uri.as_str().into()];
        self.master("registerPublisher", &registration).await?;
        let (mut stream, _) = timeout(PATIENCE, listener.accept()).await??;
        stream.set_nodelay(true)?;
        Header::read(&mut stream, &mut BytesMut::new()).await?;
        let answer = Header::new([
            ("callerid", self.name.as_str()),
            ("topic", topic),
            ("type", kind.name),
            ("md5sum", kind.md5),
            ("message_definition", kind.definition),
            ("latching", "0"),
        ]);
        answer.write(&mut stream).await?;
        blocking(stream)
    }

    /// Takes a topic back from the Master.
    pub(crate) async fn unpublish(&self, topic: &str) -> Result<()> {
        let arguments = [topic.into(), self.uri.as_str().into()];
        self.master("unregisterPublisher", &arguments).await?;
        Ok(())
    }

    async fn master(&self, method: &str, arguments: &[Value]) -> Result<Value> {
        let master = Client::new(Arc::new(self.inside.clone()), &format!("http://{MASTER}/"))?;
        let arguments = [&[self.name.as_str().into()], arguments].concat();
        let answer = master.call(method, &arguments, PATIENCE).await?;
        let answer = answer.as_array().context("an answer")?;
        ensure!(
            answer.first().and_then(Value::as_int) == Some(1),
            "{method}: {answer:?}"
        );
        Ok(answer.get(2).cloned().unwrap_or(Value::Int(0)))
    }
}

impl Drop for Raw {
    fn drop(&mut self) {
        self.serving.abort();
    }
}

fn blocking(stream: tokio::net::TcpStream) -> Result<TcpStream> {
    let stream = stream.into_std()?;
    stream.set_nonblocking(false)?;
    Ok(stream)
}
