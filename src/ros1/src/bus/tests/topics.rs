use std::sync::atomic::AtomicUsize;

use bytes::BytesMut;

use super::*;
use crate::master::{Master, MasterOptions};
use crate::tcpros::Header;
use crate::testing::args;
use crate::xmlrpc::Value;

#[tokio::test]
async fn messages_go_from_bus_to_bus_with_their_type() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    // The subscription comes first: the publisher is connected when it registers.
    let mut subscription = subscribe_text(&two, "/chat").await;
    let publisher = advertise_text(&one, "/chat", false).await;
    wait_for_subscribers(&*publisher, 1).await;
    publisher.publish("a".into());
    publisher.publish(Bytes::from(vec![b'x'; 1_000_000]));
    publisher.publish("".into());
    let message = next(&mut subscription.messages).await;
    assert_eq!((&message.bytes[..], message.publisher.node()), (&b"a"[..], "/one"));
    assert_eq!(*message.wire_type, text_type("992c"));
    assert_eq!(next(&mut subscription.messages).await.bytes.len(), 1_000_000);
    assert_eq!(next(&mut subscription.messages).await.bytes.len(), 0);
    drop(publisher);
    master.wait_until(|graph| graph.topics["/chat"].publishers.is_empty()).await;
    drop(subscription);
    master.wait_until(|graph| graph.topics.is_empty() && graph.nodes.is_empty()).await;
}

#[tokio::test]
async fn what_is_queued_is_sent_before_a_publisher_ends() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let mut subscription = subscribe_text(&two, "/chat").await;
    let publisher = advertise_text(&one, "/chat", false).await;
    wait_for_subscribers(&*publisher, 1).await;
    for n in 0..100u8 {
        publisher.publish(Bytes::from(vec![n; 10_000]));
    }
    drop(publisher);
    for n in 0..100u8 {
        assert_eq!(next(&mut subscription.messages).await.bytes[0], n);
    }
}

#[tokio::test]
async fn a_bus_does_not_hear_itself() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let mut echo = subscribe_text(&one, "/chat").await;
    let ours = advertise_text(&one, "/chat", true).await;
    let theirs = advertise_text(&two, "/chat", true).await;
    let mut other = subscribe_text(&two, "/chat").await;
    ours.publish("mine".into());
    theirs.publish("yours".into());
    assert_eq!(next_text(&mut other.messages).await, "mine");
    assert_eq!(next_text(&mut echo.messages).await, "yours");
    assert!(echo.messages.is_empty() && other.messages.is_empty());
}

#[tokio::test]
async fn every_latching_publisher_is_replayed_to_every_newcomer() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    // Two publishers of one bus keep a message each, and so do two buses.
    let first = advertise_text(&one, "/tf_static", true).await;
    let second = advertise_text(&one, "/tf_static", true).await;
    let third = advertise_text(&two, "/tf_static", true).await;
    first.publish("old".into());
    first.publish("first".into());
    second.publish("second".into());
    third.publish("third".into());
    let three = join(&master, "/three").await;
    let hear = async || {
        let mut subscription = subscribe_text(&three, "/tf_static").await;
        let mut heard = Vec::new();
        for _ in 0..2 {
            let message = next(&mut subscription.messages).await;
            assert!(message.latching);
            heard.push(message.bytes);
        }
        heard.push(next(&mut subscription.messages).await.bytes);
        heard.sort();
        (subscription, heard)
    };
    let (_subscription, heard) = hear().await;
    assert_eq!(heard, ["first", "second", "third"]);
    // A later local subscription shares the connections; the last message of each publisher is kept for it.
    let mut later = subscribe_text(&three, "/tf_static").await;
    let mut again = [next(&mut later.messages).await, next(&mut later.messages).await];
    again.sort_by(|a, b| a.publisher.cmp(&b.publisher));
    assert_eq!(again[0].publisher.node(), "/one");
    assert_eq!(again[1].bytes, "third");
    // A publisher's latched message is dropped with the publisher.
    drop(third);
    wait_for_graph(&three, |graph| graph.topics["/tf_static"].publishers == ["/one"]).await;
    let released = async {
        while three.inner.subscriptions.lock()["/tf_static"].links().len() > 1 {
            tokio::task::yield_now().await;
        }
    };
    tokio::time::timeout(PATIENCE, released).await.unwrap();
    let mut last = subscribe_text(&three, "/tf_static").await;
    assert_eq!(next(&mut last.messages).await.publisher.node(), "/one");
    assert!(last.messages.is_empty());
}

#[tokio::test]
async fn a_publisher_says_whom_it_sends_to() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let publisher = advertise_text(&one, "/chat", false).await;
    wait_for_graph(&two, |graph| graph.topics.contains_key("/chat")).await;
    assert!(two.reported_connections("/chat").await.unwrap().is_empty());
    let first = subscribe_text(&two, "/chat").await;
    wait_for_subscribers(&*publisher, 1).await;
    let before = two.reported_connections("/chat").await.unwrap();
    assert_eq!(before.iter().map(PeerId::node).collect::<Vec<_>>(), ["/one"]);
    drop(first);
    wait_for_subscribers(&*publisher, 0).await;
    let _second = subscribe_text(&two, "/chat").await;
    wait_for_subscribers(&*publisher, 1).await;
    let after = two.reported_connections("/chat").await.unwrap();
    assert!(after.len() == 1 && after != before, "another connection: {after:?}");
}

/// Proxies a node's XML-RPC server and counts the connections to it.
async fn counting_proxy(to: std::net::SocketAddr) -> (String, Arc<AtomicUsize>) {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let uri = format!("http://{}/", listener.local_addr().unwrap());
    let count = Arc::new(AtomicUsize::new(0));
    let counter = count.clone();
    tokio::spawn(async move {
        while let Ok((mut near, _)) = listener.accept().await {
            counter.fetch_add(1, Ordering::Relaxed);
            tokio::spawn(async move {
                let mut far = tokio::net::TcpStream::connect(to).await?;
                tokio::io::copy_bidirectional(&mut near, &mut far).await
            });
        }
    });
    (uri, count)
}

#[tokio::test]
async fn a_publisher_is_asked_again_on_the_same_connection() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let _publisher = advertise_text(&one, "/chat", false).await;
    let address = one.uri().trim_start_matches("http://");
    let address = address.trim_end_matches('/').to_owned();
    let (uri, count) = counting_proxy(address.parse().unwrap()).await;
    let as_three = args(["/three", "/chat", "std_msgs/String", &uri]);
    master.call("registerPublisher", &as_three).await;
    wait_for_graph(&two, |graph| graph.nodes.contains_key("/three")).await;
    let before = count.load(Ordering::Relaxed);
    for _ in 0..50 {
        two.reported_connections("/chat").await.unwrap();
    }
    assert_eq!(count.load(Ordering::Relaxed) - before, 1);
}

#[tokio::test]
async fn local_subscriptions_share_one_connection() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let publisher = advertise_text(&one, "/chat", false).await;
    let mut first = subscribe_text(&two, "/chat").await;
    let mut second = subscribe_text(&two, "/chat").await;
    wait_for_subscribers(&*publisher, 1).await;
    publisher.publish("both".into());
    assert_eq!(next_text(&mut first.messages).await, "both");
    assert_eq!(next_text(&mut second.messages).await, "both");
    assert_eq!(publisher.matched_subscribers().borrow().connected_count(), 1);
    drop(first);
    publisher.publish("one".into());
    assert_eq!(next_text(&mut second.messages).await, "one");
    drop(second);
    wait_for_subscribers(&*publisher, 0).await;
    // And again at once, while the previous one may still be ending.
    let mut third = subscribe_text(&two, "/chat").await;
    wait_for_subscribers(&*publisher, 1).await;
    publisher.publish("back".into());
    assert_eq!(next_text(&mut third.messages).await, "back");
}

#[tokio::test]
async fn a_slow_receiver_loses_the_oldest_and_knows_how_many() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let publisher = advertise_text(&one, "/chat", false).await;
    let qos = QosProfile::keep_last(3);
    let mut slow = two.subscribe("/chat", WireType::any(), qos).await.unwrap();
    let mut quick = subscribe_text(&two, "/chat").await;
    wait_for_subscribers(&*publisher, 1).await;
    for n in 0..10u8 {
        publisher.publish(Bytes::from(vec![n]));
    }
    for n in 0..10u8 {
        assert_eq!(next(&mut quick.messages).await.bytes[0], n);
    }
    assert_eq!(slow.dropped.get(), 7);
    assert_eq!(next(&mut slow.messages).await.bytes[0], 7);
}

#[tokio::test]
async fn different_definitions_do_not_meet() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let publisher = advertise_text(&one, "/chat", false).await;
    let mut wrong = two.subscribe("/chat", text_type("0000"), QosProfile::keep_last(10)).await.unwrap();
    let direct = link::connect(&two.inner, "/chat", one.uri(), &text_type("0000")).await;
    let refusal = direct.err().unwrap().to_string();
    assert!(refusal.contains("992c") && refusal.contains("0000"), "{refusal}");
    // Next to a subscription to any type, it still gets nothing of the other type.
    let mut right = subscribe_text(&two, "/chat").await;
    wait_for_subscribers(&*publisher, 1).await;
    publisher.publish("text".into());
    assert_eq!(next_text(&mut right.messages).await, "text");
    assert!(wrong.messages.try_recv().is_none());
    // Nor may one bus advertise a topic with two types.
    let again = one.advertise("/chat", text_type("0000"), QosProfile::keep_last(1));
    let error = again.await.err().unwrap();
    assert!(matches!(error, BusError::TypeMismatch { .. }), "{error}");
}

#[tokio::test]
async fn types_are_asked_of_publishers_and_of_subscribers() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let error = two.topic_type("/chat").await.unwrap_err();
    assert!(matches!(error, BusError::NoTopic(_)), "{error}");
    let subscription = one.subscribe("/chat", text_type("992c"), QosProfile::keep_last(1)).await.unwrap();
    let asked = two.topic_type("/chat").await.unwrap();
    assert_eq!((asked.name.as_str(), asked.digest.as_str()), ("std_msgs/String", "992c"));
    // Nothing of the query remains.
    master.wait_until(|graph| graph.topics["/chat"].publishers.is_empty()).await;
    drop(subscription);
    let publisher = advertise_text(&one, "/chat", false).await;
    assert_eq!(two.topic_type("/chat").await.unwrap(), text_type("992c"));
    assert_eq!(one.topic_type("/chat").await.unwrap(), text_type("992c"));
    assert!(!two.topic_offer("/chat").await.unwrap().latching);
    drop(publisher);
    let latching = advertise_text(&one, "/map", true).await;
    assert!(two.topic_offer("/map").await.unwrap().latching, "its header says so");
    drop(latching);
    // A subscriber to any type can only say that.
    let _relay = subscribe_text(&one, "/any").await;
    assert_eq!(two.topic_type("/any").await.unwrap().digest, "*");
}

/// rospy does not connect again to a publisher to which it is still connected.
#[tokio::test]
async fn whoever_was_asked_for_its_type_stays_for_what_is_advertised_next() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let _subscription = two.subscribe("/chat", text_type("992c"), QosProfile::keep_last(1)).await.unwrap();
    let mut asking = publications::ask_subscribers(&one.inner, "/chat");
    let mut asked = tokio::net::TcpStream::connect(("127.0.0.1", one.inner.port)).await.unwrap();
    let header = [("topic", "/chat"), ("type", "std_msgs/String"), ("md5sum", "992c"), ("callerid", "/asked")];
    Header::new(header).write(&mut asked).await.unwrap();
    assert_eq!(asking.answers.recv().await.expect("asked").digest.as_str(), "992c");
    drop(asking);
    // Queried again, it answers again.
    let mut asking = publications::ask_subscribers(&one.inner, "/chat");
    let again = tokio::time::timeout(PATIENCE, asking.answers.recv()).await;
    assert_eq!(again.expect("soon").expect("asked").digest.as_str(), "992c");
    drop(asking);
    let publisher = advertise_text(&one, "/chat", false).await;
    let mut buffer = BytesMut::new();
    let answer = tokio::time::timeout(PATIENCE, Header::read(&mut asked, &mut buffer)).await;
    let answer = answer.expect("kept waiting").expect("not sent away");
    assert_eq!(answer.get("callerid"), Some("/one"), "{answer:?}");
    let mut matched = publisher.matched_subscribers();
    let hears = matched.wait_for(|matched| matched.has_node("/asked"));
    assert!(tokio::time::timeout(PATIENCE, hears).await.is_ok());
}

#[tokio::test]
async fn a_master_that_forgot_is_told_again() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let publisher = advertise_text(&one, "/chat", false).await;
    let mut subscription = subscribe_text(&two, "/chat").await;
    wait_for_subscribers(&*publisher, 1).await;
    let address = master.stop().await;
    let master = TestMaster::start_at(Master::new(MasterOptions::default()), Some(address)).await;
    master
        .wait_until(|graph| {
            graph.topics.get("/chat").is_some_and(|topic| topic.publishers == ["/one"] && topic.subscribers == ["/two"])
        })
        .await;
    publisher.publish("still here".into());
    assert_eq!(next_text(&mut subscription.messages).await, "still here");
    // New nodes find each other as before.
    let three = join(&master, "/three").await;
    let mut late = subscribe_text(&three, "/chat").await;
    wait_for_subscribers(&*publisher, 2).await;
    publisher.publish("welcome".into());
    assert_eq!(next_text(&mut late.messages).await, "welcome");
}

#[tokio::test]
async fn what_the_master_has_too_much_is_taken_back() {
    let master = TestMaster::start().await;
    let one = join(&master, "/one").await;
    let list = ["/one", "/ghost", "a/B", one.uri()].map(Value::from);
    master.call("registerPublisher", &list).await;
    master.wait_until(|graph| !graph.topics.contains_key("/ghost")).await;
}

#[tokio::test]
async fn the_graph_follows_and_close_takes_everything_back() {
    let master = TestMaster::start().await;
    let (one, two) = (join(&master, "/one").await, join(&master, "/two").await);
    let publisher = advertise_text(&one, "/chat", true).await;
    publisher.publish("last words".into());
    let mut own = subscribe_text(&one, "/other").await;
    let mut subscription = subscribe_text(&two, "/chat").await;
    wait_for_graph(&two, |graph| graph.topics.contains_key("/other")).await;
    one.set("/p", ParamValue::Int(1)).await.unwrap();
    wait_for_graph(&two, |graph| graph.parameters.contains_key("/p")).await;
    wait_for_subscribers(&*publisher, 1).await;
    one.close().await;
    assert_eq!(next_text(&mut subscription.messages).await, "last words");
    wait_for_graph(&two, |graph| !graph.nodes.contains_key("/one")).await;
    assert!(own.messages.recv().await.is_none());
    publisher.publish("into the void".into());
    let late = one.subscribe("/chat", WireType::any(), QosProfile::keep_last(100)).await;
    assert!(matches!(late, Err(BusError::Closed)));
}

#[tokio::test]
async fn parameters_are_read_and_written() {
    let master = TestMaster::start().await;
    let bus = join(&master, "/one").await;
    let map = ParamValue::Map(
        [("a".to_owned(), ParamValue::Double(0.5)), ("b".to_owned(), ParamValue::List(vec![ParamValue::Bool(true)]))]
            .into(),
    );
    bus.set("/ns", map.clone()).await.unwrap();
    assert_eq!(bus.get("/ns").await.unwrap(), map);
    assert!(bus.has("/ns/a").await.unwrap());
    let found = bus.search("/ns/deeper", "a").await.unwrap();
    assert_eq!(found.as_deref(), Some("/ns/a"));
    assert_eq!(bus.search("/", "a").await.unwrap(), None);
    assert!(bus.names().await.unwrap().contains(&"/ns/b".to_owned()));
    bus.delete("/ns").await.unwrap();
    for gone in [bus.get("/ns/a").await.err(), bus.delete("/ns").await.err()] {
        assert!(matches!(gone, Some(BusError::NoParam(_))));
    }
    let wide = ParamValue::Map([("w".to_owned(), ParamValue::Int(1 << 40))].into());
    let error = bus.set("/ns", wide).await.unwrap_err().to_string();
    assert!(error.contains("/ns") && error.contains("w: "), "{error}");
}

#[tokio::test]
async fn only_absolute_names_are_taken() {
    let master = TestMaster::start().await;
    let bus = join(&master, "/one").await;
    for name in ["", "relative", "/a b", "~private", "/a//b"] {
        let error = bus.subscribe(name, WireType::any(), QosProfile::keep_last(100)).await.err().unwrap();
        assert!(matches!(error, BusError::BadName(_)), "{name}: {error}");
    }
    let sockets = Arc::new(HostSockets);
    let nameless = Ros1Bus::connect(sockets, master.address, "one").await;
    assert!(matches!(nameless, Err(BusError::BadName(_))));
}
