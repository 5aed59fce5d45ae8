//! Helpers for the tests of this module: a Master on its own port, hand-made nodes.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use ros_bus::net::HostSockets;
use tokio::net::TcpListener;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use crate::master::{Master, MasterOptions};
use crate::xmlrpc::{Fault, ServerLimits, Value, XmlRpcClient, XmlRpcHandler, serve};

/// Longer than anything here takes.
pub(crate) const PATIENCE: Duration = Duration::from_secs(120);

/// A Master that serves until dropped.
pub(crate) struct TestMaster {
    pub(crate) master: Master,
    pub(crate) address: SocketAddr,
    task: JoinHandle<()>,
}

impl TestMaster {
    pub(crate) async fn start() -> Self {
        Self::start_at(Master::new(MasterOptions::default()), None).await
    }

    /// Serves `master`, optionally at an address that another one used before.
    pub(crate) async fn start_at(master: Master, address: Option<SocketAddr>) -> Self {
        let address = address.unwrap_or(([127, 0, 0, 1], 0).into());
        let listener = TcpListener::bind(address).await.unwrap();
        let address = listener.local_addr().unwrap();
        let serving = master.clone();
        let task = tokio::spawn(async move { serving.serve(listener, Arc::new(HostSockets)).await });
        Self { master, address, task }
    }

    /// Calls a method; returns its `[code, message, value]`.
    pub(crate) async fn call(&self, method: &str, args: &[Value]) -> (i32, String, Value) {
        let client = XmlRpcClient::new(Arc::new(HostSockets), &format!("http://{}/", self.address));
        let answer = client.unwrap().call(method, args, PATIENCE).await.unwrap();
        match answer {
            Value::Array(parts) => match <[Value; 3]>::try_from(parts).unwrap() {
                [Value::Int(code), Value::String(message), value] => (code, message, value),
                other => panic!("{other:?}"),
            },
            other => panic!("{other:?}"),
        }
    }

    /// Waits until the graph satisfies `wanted`.
    pub(crate) async fn wait_until(&self, wanted: impl Fn(&ros_bus::Graph) -> bool) {
        let mut generation = self.master.generation();
        let waiting = generation.wait_for(|_| wanted(&self.master.graph()));
        let found = tokio::time::timeout(PATIENCE, waiting).await.is_ok();
        assert!(found, "{:#?}", self.master.graph());
    }

    /// Stops it with all its connections, and frees its port.
    pub(crate) async fn stop(mut self) -> SocketAddr {
        self.task.abort();
        let _ = (&mut self.task).await;
        self.address
    }
}

impl Drop for TestMaster {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// A node that consists of an XML-RPC server only, and reports the calls it receives.
pub(crate) struct TestNode {
    pub(crate) uri: String,
    pub(crate) calls: mpsc::UnboundedReceiver<(String, Vec<Value>)>,
    task: JoinHandle<()>,
}

struct Reporter {
    calls: mpsc::UnboundedSender<(String, Vec<Value>)>,
    answer: Value,
}

#[async_trait]
impl XmlRpcHandler for Reporter {
    async fn call(&self, method: &str, params: Vec<Value>) -> Result<Value, Fault> {
        let _ = self.calls.send((method.to_owned(), params));
        Ok(Value::Array(vec![1.into(), "".into(), self.answer.clone()]))
    }
}

impl TestNode {
    /// Starts a node that answers every call with success and 0.
    pub(crate) async fn start() -> Self {
        Self::start_answering(Value::Int(0)).await
    }

    /// Starts a node that answers every call with success and this value.
    pub(crate) async fn start_answering(answer: Value) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let uri = format!("http://{}/", listener.local_addr().unwrap());
        let (sender, calls) = mpsc::unbounded_channel();
        let reporter = Arc::new(Reporter { calls: sender, answer });
        let task = tokio::spawn(serve(listener, reporter, ServerLimits::default()));
        Self { uri, calls, task }
    }

    /// Returns the next call received.
    pub(crate) async fn next(&mut self) -> (String, Vec<Value>) {
        let call = tokio::time::timeout(PATIENCE, self.calls.recv()).await;
        call.expect("a call should come").unwrap()
    }

    /// Dies as by SIGKILL.
    pub(crate) async fn die(mut self) {
        self.task.abort();
        let _ = (&mut self.task).await;
    }
}

impl Drop for TestNode {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Creates a call's arguments.
pub(crate) fn args<const N: usize>(texts: [&str; N]) -> [Value; N] {
    texts.map(Value::from)
}
