use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use async_trait::async_trait;
use ros_bus::{BusError, CallFate, Digest, FailureReason, ServiceHandler, ServiceType};
use ros_message::schema::{Registry, ServiceDef};
use tokio::sync::{Notify, mpsc};
use tokio::task::JoinSet;

use super::*;
use crate::Ros2Bus;

const SOON: Duration = Duration::from_millis(500);

fn definition(text: &str) -> Arc<ServiceDef> {
    let registry = Registry::for_version(RosVersion::Two);
    registry.insert("tests/srv/Echo", text).expect("a definition");
    registry.service("tests/srv/Echo").expect("a service")
}

fn echo() -> ServiceType {
    ServiceType::from_service(&definition("string data\n---\nstring data\n"))
}

/// Returns the request with the caller's name.
#[derive(Default)]
struct Echo {
    calls: AtomicUsize,
}

#[async_trait]
impl ServiceHandler for Echo {
    async fn call(&self, request: Bytes, caller: &str) -> Result<Bytes, FailureReason> {
        self.calls.fetch_add(1, Ordering::Relaxed);
        assert!(matches!(caller, "/client" | "/server"), "{caller}");
        Ok(request)
    }
}

/// Answers when told to.
struct Slow {
    asked: mpsc::UnboundedSender<()>,
    answer: Arc<Notify>,
}

#[async_trait]
impl ServiceHandler for Slow {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let _ = self.asked.send(());
        self.answer.notified().await;
        Ok(request)
    }
}

struct Refuses;

#[async_trait]
impl ServiceHandler for Refuses {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        Err(FailureReason::new("not today"))
    }
}

async fn pair(number: u16) -> (Arc<Ros2Bus>, Arc<Ros2Bus>) {
    (join(number, "/server").await, join(number, "/client").await)
}

async fn wait_until_served(bus: &Ros2Bus, service: &str) {
    let mut graph = bus.graph();
    let found = graph.wait_for(|graph| graph.services.contains_key(service));
    timeout(LONG, found).await.expect("in time").expect("the bus is open");
}

#[tokio::test]
async fn calls_are_answered_one_after_the_other_and_many_at_once() {
    let (server, client) = pair(53).await;
    let _guard = server.serve("/echo", echo(), Arc::new(Echo::default())).await.unwrap();
    wait_until_served(&client, "/echo").await;
    let answer = client.call("/echo", numbered_message(7), LONG).await.unwrap();
    assert_eq!(answer, numbered_message(7));
    let mut calls = JoinSet::new();
    for number in 0..200 {
        let client = Arc::clone(&client);
        calls.spawn(async move {
            let answer = client.call("/echo", numbered_message(number), LONG).await.unwrap();
            assert_eq!(answer, numbered_message(number));
        });
    }
    calls.join_all().await;
    assert_eq!(client.graph().borrow().services["/echo"], "/server");
}

#[tokio::test]
async fn the_type_of_a_service_is_what_its_server_says() {
    let (server, client) = pair(54).await;
    let _guard = server.serve("/echo", echo(), Arc::new(Echo::default())).await.unwrap();
    wait_until_served(&client, "/echo").await;
    let told = client.service_type("/echo").await.unwrap();
    let ours = echo();
    assert_eq!((&told.name, &told.request, &told.response), (&ours.name, &ours.request, &ours.response));
    assert!(told.digest.is_any() && told.is_compatible_with(&ours));
    let other = ServiceType::from_service(&definition("int32 data\n---\nstring data\n"));
    assert!(!told.is_compatible_with(&other));
    assert_eq!(server.service_type("/echo").await.unwrap(), ours);
    // A server on this bus knows the digest of the whole service.
    let wrong = Digest::from("RIHS01_00");
    let refused = server.call_typed("/echo", &wrong, numbered_message(1), LONG).await;
    assert!(matches!(refused, Err(BusError::TypeMismatch { .. })));
}

#[tokio::test]
async fn what_this_bus_serves_it_can_call() {
    let server = join(55, "/server").await;
    let handler = Arc::new(Echo::default());
    let guard = server.serve("/echo", echo(), handler.clone()).await.unwrap();
    let again = server.serve("/echo", echo(), handler.clone()).await;
    assert!(matches!(again, Err(BusError::AlreadyServed(_))));
    let answer = server.call("/echo", numbered_message(3), LONG).await.unwrap();
    assert_eq!((answer, handler.calls.load(Ordering::Relaxed)), (numbered_message(3), 1));
    drop(guard);
    let gone = server.call("/echo", numbered_message(3), LONG).await;
    assert!(matches!(gone, Err(BusError::NoService(_))), "{gone:?}");
    let _again = server.serve("/echo", echo(), handler).await.unwrap();
}

#[tokio::test]
async fn nobody_serves_and_nobody_answers() {
    let (server, client) = pair(56).await;
    let begun = Instant::now();
    let nobody = client.call("/none", numbered_message(1), LONG).await;
    assert!(matches!(nobody, Err(BusError::NoService(_))), "{nobody:?}");
    assert!(begun.elapsed() < LONG / 2);
    let _guard = server.serve("/refuses", echo(), Arc::new(Refuses)).await.unwrap();
    wait_until_served(&client, "/refuses").await;
    let unanswered = client.call("/refuses", numbered_message(1), SOON).await;
    assert!(matches!(unanswered, Err(BusError::Timeout { .. })), "{unanswered:?}");
    let own = server.call("/refuses", numbered_message(1), SOON).await;
    assert!(matches!(own, Err(BusError::CallFailed { fate: CallFate::Answered, .. })));
}

#[tokio::test]
async fn a_server_that_goes_is_noticed_at_once() {
    let (server, client) = pair(57).await;
    let (asked, mut asks) = mpsc::unbounded_channel();
    let slow = Slow { asked, answer: Arc::default() };
    let _guard = server.serve("/slow", echo(), Arc::new(slow)).await.unwrap();
    wait_until_served(&client, "/slow").await;
    let calling = Arc::clone(&client);
    let call = tokio::spawn(async move { calling.call("/slow", numbered_message(1), LONG).await });
    timeout(LONG, asks.recv()).await.expect("it is asked");
    let begun = Instant::now();
    server.close().await;
    let failed = call.await.unwrap();
    assert!(matches!(failed, Err(BusError::CallFailed { fate: CallFate::Unknown, .. })), "{failed:?}");
    assert!(begun.elapsed() < LONG / 2);
}

#[tokio::test]
async fn what_was_asked_before_a_service_ended_is_answered() {
    let (server, client) = pair(58).await;
    let (asked, mut asks) = mpsc::unbounded_channel();
    let answer = Arc::new(Notify::new());
    let slow = Slow { asked, answer: Arc::clone(&answer) };
    let guard = server.serve("/slow", echo(), Arc::new(slow)).await.unwrap();
    wait_until_served(&client, "/slow").await;
    let calling = Arc::clone(&client);
    let call = tokio::spawn(async move { calling.call("/slow", numbered_message(1), LONG).await });
    timeout(LONG, asks.recv()).await.expect("it is asked");
    answer.notify_one();
    let answered = call.await.unwrap();
    assert_eq!(answered.unwrap(), numbered_message(1));
    drop(guard);
}

#[tokio::test]
async fn a_bus_that_is_closed_ends_its_calls() {
    let (server, client) = pair(59).await;
    let (asked, mut asks) = mpsc::unbounded_channel();
    let slow = Slow { asked, answer: Arc::default() };
    let _guard = server.serve("/slow", echo(), Arc::new(slow)).await.unwrap();
    wait_until_served(&client, "/slow").await;
    let calling = Arc::clone(&client);
    let call = tokio::spawn(async move { calling.call("/slow", numbered_message(1), LONG).await });
    timeout(LONG, asks.recv()).await.expect("it is asked");
    client.close().await;
    let ended = call.await.unwrap();
    assert!(matches!(ended, Err(BusError::Closed)), "{ended:?}");
}
