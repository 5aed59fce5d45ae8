//! Tests with a viewer of a ROS 2 servant.

use std::sync::Arc;
use std::time::Duration;

use async_trait::async_trait;
use bridge::ClientGrants;
use budget::Budget;
use bytes::Bytes;
use ros::bus::{
    Bus, FailureReason, ParamValue, QosProfile, RosVersion, ServiceHandler, ServiceType, WireType, wait_for_connected,
};
use ros::schema::Registry;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use crate::memory_bus::MemorySystem;
use crate::{ViewedServant, ViewerOptions, serve};

/// Only limits how long a failing test takes.
const PATIENCE: Duration = Duration::from_secs(30);

/// Client end of a WebSocket, without the upgrade.
struct Viewer(DuplexStream);

impl Viewer {
    /// Sends a frame of less than 64 KiB with a zero mask.
    async fn send(&mut self, opcode: u8, payload: &[u8]) {
        let length = u16::try_from(payload.len()).expect("a short frame");
        let length = length.to_be_bytes();
        let head = [0x80 | opcode, 0x80 | 126, length[0], length[1], 0, 0, 0, 0];
        let frame = [&head, payload].concat();
        self.0.write_all(&frame).await.expect("taken");
    }

    async fn next_frame(&mut self) -> (u8, Vec<u8>) {
        let opcode = self.0.read_u8().await.expect("a frame") & 0x0f;
        let length = match self.0.read_u8().await.expect("a length") {
            126 => usize::from(self.0.read_u16().await.expect("a length")),
            127 => self.0.read_u64().await.expect("a length") as usize,
            short => usize::from(short),
        };
        let mut payload = vec![0; length];
        self.0.read_exact(&mut payload).await.expect("the payload");
        (opcode, payload)
    }

    /// Returns the next text message with this operation.
    async fn next_text(&mut self, op: &str) -> Value {
        let told = async {
            loop {
                let (opcode, payload) = self.next_frame().await;
                if opcode != 1 {
                    continue;
                }
                let told: Value = serde_json::from_slice(&payload).expect("JSON");
                assert!(told["op"] == op || told["op"] != "status", "{told}");
                if told["op"] == op {
                    return told;
                }
            }
        };
        timeout(PATIENCE, told).await.expect("it is told")
    }
}

/// Connects a viewer to the system with this budget; also returns the task that serves it.
fn open_viewer(system: &Arc<MemorySystem>, registry: Arc<Registry>, budget: &Budget) -> (Viewer, JoinHandle<()>) {
    let (ours, theirs) = tokio::io::duplex(1 << 16);
    let bus: Arc<dyn Bus> = system.join("/cloudroid_inside");
    let (ends, ended) = watch::channel(None);
    let servant = ViewedServant { bus, registry, ended, held: Box::new(ends) };
    let options = ViewerOptions {
        name: "lab".to_owned(),
        granted: ClientGrants::from_fixed(access::Grants::everything()),
        budget: budget.clone(),
        unfinished: PATIENCE,
        depth: 2,
    };
    let serving = serve(ours, Bytes::new(), async { Ok(servant) }, options);
    (Viewer(theirs), tokio::spawn(serving))
}

/// Service handler that responds with an image of one megabyte.
struct Pictures;

#[async_trait]
impl ServiceHandler for Pictures {
    async fn call(&self, _: Bytes, _: &str) -> Result<Bytes, FailureReason> {
        let length = PICTURE as u32;
        let head = [&[0, 1, 0, 0], &length.to_le_bytes()[..]].concat();
        Ok([head, vec![7; PICTURE]].concat().into())
    }
}

/// Size of these images in bytes.
const PICTURE: usize = 1 << 20;

/// A servant with this service.
struct Camera {
    system: Arc<MemorySystem>,
    registry: Arc<Registry>,
    // Kept as long as it is viewed.
    _node: Arc<dyn Bus>,
    _serving: Box<dyn Send + Sync>,
}

impl Camera {
    async fn new() -> Self {
        let definitions = [("lab/srv/Shoot", "---\nuint8[] data\n")];
        let definitions = definitions.map(|(key, text)| (key.to_owned(), text.to_owned()));
        let registry = Registry::with_definitions(RosVersion::Two, &definitions.into()).expect("valid");
        let of = ServiceType::from_service(&registry.service("lab/Shoot").expect("defined"));
        let system = Arc::new(MemorySystem::default());
        let node: Arc<dyn Bus> = system.join("/see");
        let serving = node.serve("/shoot", of, Arc::new(Pictures)).await.expect("served");
        Self { system, registry: Arc::new(registry), _node: node, _serving: serving }
    }

    /// Connects a viewer with this budget, which calls the service; also returns the task that serves it.
    async fn open_calling_viewer(&self, budget: &Budget) -> (Viewer, JoinHandle<()>) {
        let (mut viewer, serving) = open_viewer(&self.system, Arc::clone(&self.registry), budget);
        let told = viewer.next_text("advertiseServices").await;
        let id = told["services"][0]["id"].as_u64().expect("a number") as u32;
        let mut call = vec![2];
        for number in [id, 9, 3] {
            call.extend_from_slice(&number.to_le_bytes());
        }
        call.extend_from_slice(b"cdr\0\x01\0\0\0");
        viewer.send(2, &call).await;
        (viewer, serving)
    }
}

/// Waits until a number of bytes is in use.
async fn wait_for_use(budget: &Budget, is_so: impl Fn(usize) -> bool) {
    let changes = async {
        while !is_so(budget.used_bytes()) {
            tokio::task::yield_now().await;
        }
    };
    timeout(PATIENCE, changes).await.unwrap_or_else(|_| panic!("{} bytes are in use", budget.used_bytes()));
}

#[tokio::test]
async fn answers_to_calls_count_as_the_viewers() {
    let camera = Camera::new().await;
    for (limit, is_answered) in [(4 << 20, true), (1 << 20, false)] {
        let budget = Budget::new("viewer x", limit);
        let (mut viewer, serving) = camera.open_calling_viewer(&budget).await;
        if is_answered {
            let (opcode, answer) = timeout(PATIENCE, viewer.next_frame()).await.expect("an answer");
            assert_eq!((opcode, answer[0]), (2, 3));
            assert!(answer.len() > PICTURE);
        } else {
            let failure = viewer.next_text("serviceCallFailure").await;
            let words = failure["message"].as_str().expect("a text");
            assert!(words.contains("the memory for viewer x"), "{words}");
        }
        assert!(budget.refusal_count() == u64::from(!is_answered));
        drop(viewer);
        serving.await.expect("it ends");
        assert_eq!(budget.used_bytes(), 0);
    }
}

#[tokio::test]
async fn an_answer_counts_until_the_viewer_has_read_it() {
    let camera = Camera::new().await;
    let budget = Budget::new("viewer x", 4 << 20);
    let (mut viewer, _serving) = camera.open_calling_viewer(&budget).await;
    // Nothing else of this size counts: the request is short, and the viewer reads nothing.
    wait_for_use(&budget, |bytes| bytes > PICTURE).await;
    for _ in 0..100 {
        tokio::task::yield_now().await;
    }
    assert!(budget.used_bytes() > PICTURE, "it waits, and is not counted");
    let (_, answer) = timeout(PATIENCE, viewer.next_frame()).await.expect("an answer");
    assert!(answer.len() > PICTURE);
    wait_for_use(&budget, |bytes| bytes < PICTURE).await;
}

#[tokio::test]
async fn what_would_take_too_much_is_not_read() {
    let system = Arc::new(MemorySystem::default());
    let budget = Budget::new("viewer x", 16 << 20);
    let (mut viewer, _serving) = open_viewer(&system, Arc::default(), &budget);
    // Deserializing this would copy all the ones once for each enclosing list.
    let value = format!("{}{}1{}", "[".repeat(100), "1,".repeat(8000), "]".repeat(100));
    let set = format!(r#"{{"op":"setParameters","parameters":[{{"name":"/see.a","value":{value}}}]}}"#);
    viewer.send(1, set.as_bytes()).await;
    let status = viewer.next_text("status").await;
    let words = status["message"].as_str().expect("a text");
    assert!(words.contains("this message is not read"), "{words}");
    assert!(words.contains("the memory for viewer x"), "{words}");
}

#[tokio::test]
async fn messages_of_ros_2_are_told_as_cdr_with_their_definitions() {
    let definitions = [("lab/msg/Seen", "Where[] at\n"), ("lab/msg/Where", "float64 x\n")];
    let definitions = definitions.map(|(key, text)| (key.to_owned(), text.to_owned()));
    let registry = Registry::with_definitions(RosVersion::Two, &definitions.into()).expect("valid");
    let registry = Arc::new(registry);
    let of = WireType::from_message(&registry.message("lab/msg/Seen").expect("defined"));
    let system = Arc::new(MemorySystem::default());
    let node = system.join("/see");
    let seen = node.advertise("/seen", of, QosProfile::keep_last(1)).await.expect("advertised");
    let parameters = node.node_parameters().expect("offered");
    let rate = vec![("camera.rate".to_owned(), Some(ParamValue::Double(2.5)))];
    parameters.set("/see", rate).await.expect("set");

    let (mut viewer, serving) = open_viewer(&system, registry, &Budget::without_limit());
    let info = viewer.next_text("serverInfo").await;
    assert_eq!(info["supportedEncodings"], json!(["cdr"]));
    let told = viewer.next_text("advertise").await;
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
    viewer.send(1, wanted.to_string().as_bytes()).await;
    timeout(PATIENCE, wait_for_connected(seen.matched_subscribers(), 1)).await.expect("it subscribes");
    let message = [0, 1, 0, 0, 0, 0, 0, 0];
    seen.publish(Bytes::copy_from_slice(&message));
    let (opcode, frame) = timeout(PATIENCE, viewer.next_frame()).await.expect("a message");
    // Opcode, subscription id, time, then the unchanged message.
    assert_eq!((opcode, frame[0], &frame[1..5]), (2, 1, &[7, 0, 0, 0][..]));
    assert_eq!(&frame[13..], &message);

    let wanted = json!({"op": "getParameters", "parameterNames": [], "id": "x"});
    viewer.send(1, wanted.to_string().as_bytes()).await;
    let told = viewer.next_text("parameterValues").await;
    let rate = &told["parameters"][0];
    assert_eq!((&rate["name"], &rate["value"]), (&json!("/see.camera.rate"), &json!(2.5)));
    let wanted = json!({
        "op": "setParameters", "id": "y", "parameters": [{"name": "/see.camera.rate", "value": 4}],
    });
    viewer.send(1, wanted.to_string().as_bytes()).await;
    let told = viewer.next_text("parameterValues").await;
    assert_eq!(told["parameters"][0]["value"], json!(4.0), "{told}");
    drop(viewer);
    serving.await.expect("it ends");
}
