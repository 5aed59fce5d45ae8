//! A viewer of a servant of ROS 2.

use std::sync::Arc;
use std::time::Duration;

use bridge::Granted;
use budget::Budget;
use bytes::Bytes;
use ros::bus::{Bus, ParamValue, Qos, RosVersion, WireType, reaches};
use ros::schema::Registry;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream};
use tokio::sync::watch;
use tokio::time::timeout;

use crate::memory_bus::MemorySystem;
use crate::{Servant, ViewerOptions, serve};

/// Only bounds how long a failing test takes.
const LONG: Duration = Duration::from_secs(30);

/// The other end of a WebSocket, without its upgrade.
struct Viewer(DuplexStream);

impl Viewer {
    /// A frame of less than 126 bytes, with a mask of nothing.
    async fn sends(&mut self, opcode: u8, payload: &[u8]) {
        let length = u8::try_from(payload.len()).expect("a short frame");
        assert!(length < 126, "a short frame");
        let head = [0x80 | opcode, 0x80 | length, 0, 0, 0, 0];
        let frame = [&head, payload].concat();
        self.0.write_all(&frame).await.expect("taken");
    }

    async fn frame(&mut self) -> (u8, Vec<u8>) {
        let opcode = self.0.read_u8().await.expect("a frame") & 0x0f;
        let length = match self.0.read_u8().await.expect("a length") {
            126 => usize::from(self.0.read_u16().await.expect("a length")),
            short => usize::from(short),
        };
        let mut payload = vec![0; length];
        self.0.read_exact(&mut payload).await.expect("the payload");
        (opcode, payload)
    }

    /// The next text with this operation.
    async fn told(&mut self, op: &str) -> Value {
        let told = async {
            loop {
                let (opcode, payload) = self.frame().await;
                if opcode != 1 {
                    continue;
                }
                let told: Value = serde_json::from_slice(&payload).expect("JSON");
                assert_ne!(told["op"], "status", "{told}");
                if told["op"] == op {
                    return told;
                }
            }
        };
        timeout(LONG, told).await.expect("it is told")
    }
}

#[tokio::test]
async fn messages_of_ros_2_are_told_as_cdr_with_their_definitions() {
    let definitions = [
        ("lab/msg/Seen", "Where[] at\n"),
        ("lab/msg/Where", "float64 x\n"),
    ];
    let definitions = definitions.map(|(key, text)| (key.to_owned(), text.to_owned()));
    let registry = Registry::of_definitions(RosVersion::Two, &definitions.into()).expect("valid");
    let registry = Arc::new(registry);
    let of = WireType::of(&registry.message("lab/msg/Seen").expect("defined"));
    let system = Arc::new(MemorySystem::default());
    let node = system.join("/see");
    let seen = node
        .advertise("/seen", of, Qos::keep_last(1))
        .await
        .expect("advertised");
    let parameters = node.node_parameters().expect("offered");
    let rate = vec![("camera.rate".to_owned(), Some(ParamValue::Double(2.5)))];
    parameters.set("/see", rate).await.expect("set");

    let (ours, theirs) = tokio::io::duplex(1 << 16);
    let (_ends, ended) = watch::channel(None);
    let bus: Arc<dyn Bus> = system.join("/cloudroid_inside");
    let servant = Servant {
        bus,
        registry,
        ended,
        held: Box::new(()),
    };
    let options = ViewerOptions {
        name: "lab".to_owned(),
        granted: Granted::always(access::Grants::everything()),
        budget: Budget::unlimited(),
        unfinished: LONG,
        depth: 2,
    };
    let serving = serve(ours, Bytes::new(), async { Ok(servant) }, options);
    let serving = tokio::spawn(serving);
    let mut viewer = Viewer(theirs);

    let info = viewer.told("serverInfo").await;
    assert_eq!(info["supportedEncodings"], json!(["cdr"]));
    let told = viewer.told("advertise").await;
    let channel = &told["channels"][0];
    assert_eq!(channel["topic"], "/seen");
    assert_eq!(channel["encoding"], "cdr");
    assert_eq!(channel["schemaName"], "lab/msg/Seen");
    assert_eq!(channel["schemaEncoding"], "ros2msg");
    let schema = channel["schema"].as_str().expect("a text");
    assert!(schema.starts_with("Where[] at\n"), "{schema}");
    assert!(schema.contains("MSG: lab/Where\nfloat64 x"), "{schema}");

    let id = channel["id"].clone();
    let wanted = json!({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": id}]});
    viewer.sends(1, wanted.to_string().as_bytes()).await;
    timeout(LONG, reaches(seen.matched(), 1))
        .await
        .expect("it subscribes");
    let message = [0, 1, 0, 0, 0, 0, 0, 0];
    seen.publish(Bytes::copy_from_slice(&message));
    let (opcode, frame) = timeout(LONG, viewer.frame()).await.expect("a message");
    // The operation, the subscription, the time, and the message as it is.
    assert_eq!((opcode, frame[0], &frame[1..5]), (2, 1, &[7, 0, 0, 0][..]));
    assert_eq!(&frame[13..], &message);

    let wanted = json!({"op": "getParameters", "parameterNames": [], "id": "x"});
    viewer.sends(1, wanted.to_string().as_bytes()).await;
    let told = viewer.told("parameterValues").await;
    let rate = &told["parameters"][0];
    assert_eq!(
        (&rate["name"], &rate["value"]),
        (&json!("/see.camera.rate"), &json!(2.5))
    );
    let wanted = json!({
        "op": "setParameters", "id": "y", "parameters": [{"name": "/see.camera.rate", "value": 4}],
    });
    viewer.sends(1, wanted.to_string().as_bytes()).await;
    let told = viewer.told("parameterValues").await;
    assert_eq!(told["parameters"][0]["value"], json!(4.0), "{told}");
    drop(viewer);
    serving.await.expect("it ends");
}
