//! A tap in front of a real Master's services: the listener receives calls unchanged, and nobody waits for it.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use budget::Budget;
use bytes::Bytes;
use reach::tap::{Tap, TapAnswer, TapEvent, TapEventKind, TapReceiver};
use ros::JoinOptions;
use ros::bus::{Bus, FailureReason, RosVersion, ServiceHandler, ServiceType};
use ros::net::HostSockets;
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use tokio::time::timeout;

/// Only limits the duration of a failing test.
const PATIENCE: Duration = Duration::from_secs(120);

/// Echoes requests; rejects the empty one and never answers `wait`.
struct TapEchoService;

#[async_trait]
impl ServiceHandler for TapEchoService {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        match &request[..] {
            b"" => Err(FailureReason::new("nothing to say")),
            b"wait" => std::future::pending().await,
            _ => Ok(request),
        }
    }
}

struct TapWorld {
    tap: Arc<Tap>,
    bus: Arc<dyn Bus>,
    _node: Arc<Ros1Bus>,
    _echo: Box<dyn Send + Sync>,
}

async fn world() -> TapWorld {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let master = Master::new(MasterOptions::default());
    tokio::spawn(async move { master.serve(listener, Arc::new(HostSockets)).await });
    let join = |name: &'static str| Ros1Bus::connect(Arc::new(HostSockets), address, name);
    let (bus, node) = (join("/bridge").await.unwrap(), join("/node").await.unwrap());
    let of = ServiceType::new("p/Echo", "0123456789abcdef0123456789abcdef");
    let echo = node.serve("/echo", of, Arc::new(TapEchoService)).await.unwrap();
    let tap = Arc::new(Tap::default());
    TapWorld { bus: tap.wrap(bus), tap, _node: node, _echo: echo }
}

async fn call_echo(bus: &Arc<dyn Bus>, request: &'static [u8]) -> Option<Bytes> {
    let request = Bytes::from_static(request);
    bus.call("/echo", request, PATIENCE).await.ok()
}

async fn next_event(tapping: &mut TapReceiver) -> TapEvent {
    let told = timeout(PATIENCE, tapping.told.recv()).await;
    told.expect("in time").expect("somebody tells")
}

/// Returns the number of a call with this request.
async fn expect_call(tapping: &mut TapReceiver, wanted: &'static [u8]) -> u64 {
    let TapEvent { number, what, .. } = next_event(tapping).await;
    match what {
        TapEventKind::Call { service, request } => {
            assert_eq!((&*service, &*request), ("/echo", wanted))
        }
        other => panic!("{other:?}"),
    }
    number
}

async fn expect_answer(tapping: &mut TapReceiver) -> (u64, TapAnswer) {
    let TapEvent { number, what, .. } = next_event(tapping).await;
    match what {
        TapEventKind::Answered { answer, .. } => (number, answer),
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn calls_are_told_with_what_was_answered_while_somebody_listens() {
    let TapWorld { tap, bus, .. } = &world().await;
    assert!(call_echo(bus, b"before").await.is_some());
    let mut tapping = tap.listen(&Budget::without_limit()).expect("nobody listens");
    assert!(tap.listen(&Budget::without_limit()).is_none(), "one does");

    assert_eq!(call_echo(bus, b"hello").await.as_deref(), Some(&b"hello"[..]));
    let number = expect_call(&mut tapping, b"hello").await;
    let given = TapAnswer::Given(None, Bytes::from_static(b"hello"));
    assert_eq!(expect_answer(&mut tapping).await, (number, given));

    assert_eq!(call_echo(bus, b"").await, None);
    let number = expect_call(&mut tapping, b"").await;
    let (refused, answer_of_it) = expect_answer(&mut tapping).await;
    assert_eq!(refused, number);
    assert!(matches!(&answer_of_it, TapAnswer::Refused(why) if why.contains("nothing to say")), "{answer_of_it:?}");

    // The caller no longer waits for it.
    let waiting = call_echo(bus, b"wait");
    let number = tokio::select! {
        _ = waiting => panic!("it is never answered"),
        number = expect_call(&mut tapping, b"wait") => number,
    };
    assert_eq!(expect_answer(&mut tapping).await, (number, TapAnswer::GivenUp));
    assert_eq!(tapping.omitted_count(), 0);

    drop(tapping);
    assert!(call_echo(bus, b"after").await.is_some());
    assert!(tap.listen(&Budget::without_limit()).is_some(), "nobody does");
}

#[tokio::test]
async fn who_does_not_keep_up_is_told_less_and_holds_up_nobody() {
    let TapWorld { tap, bus, .. } = &world().await;
    let mut tapping = tap.listen(&Budget::without_limit()).expect("nobody listens");
    for _ in 0..600 {
        assert!(call_echo(bus, b"hello").await.is_some());
    }
    // There is room for 1024 events: calls and responses of the first 512.
    assert_eq!(tapping.omitted_count(), 600 - 512);
    for _ in 0..512 {
        let number = expect_call(&mut tapping, b"hello").await;
        assert_eq!(expect_answer(&mut tapping).await.0, number);
    }
    assert!(tapping.told.try_recv().is_err());
    // There is room again.
    assert!(call_echo(bus, b"again").await.is_some());
    expect_call(&mut tapping, b"again").await;
}

#[tokio::test]
async fn what_may_not_be_held_is_left_out_and_what_is_read_is_given_back() {
    let TapWorld { tap, bus, .. } = &world().await;
    let budget = Budget::new("a comparison", 8);
    let mut tapping = tap.listen(&budget).expect("nobody listens");
    assert!(call_echo(bus, b"far too long").await.is_some());
    assert_eq!(tapping.omitted_count(), 1);
    // The request fits the budget, but no response does.
    assert!(call_echo(bus, b"hello").await.is_some());
    let number = expect_call(&mut tapping, b"hello").await;
    assert_eq!(expect_answer(&mut tapping).await, (number, TapAnswer::GivenUp));
    assert_eq!((tapping.omitted_count(), budget.used_bytes()), (2, 0));
}

#[tokio::test]
async fn what_only_one_ros_has_is_offered_behind_a_tap_too() {
    let options = JoinOptions::in_domain(93, "/bridge");
    let joined = ros::connect(RosVersion::Two, Arc::new(HostSockets), options).await;
    let bus = Arc::new(Tap::default()).wrap(joined.expect("a bus"));
    assert!(bus.node_parameters().is_ok());
    assert!(bus.parameters().is_err());
    bus.close().await;
}
