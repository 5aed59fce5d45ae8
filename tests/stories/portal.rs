//! The portal's port, as used by clients of rosbridge and HTTP.

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::robot::Robot;
use support::world::{ADDER, GREETER, world};
use tokio_tungstenite::tungstenite::{Bytes, Message};

pub fn topics_and_services_cross_both_ways() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let mut robot = daemon.robot("greeter_cpp?robot=crossing")?;
    robot.send(json!({"op": "advertise", "id": "a1", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    robot.send(json!({"op": "subscribe", "id": "s1", "topic": "/greeter/greeting", "type": "greeter_cpp/Greeting"}))?;
    robot.wait_for_subscriber("/greeter/name")?;
    robot.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "Ada"}}))?;
    ensure!(robot.next_message_on("/greeter/greeting")?["text"] == "hi Ada");
    let answer = robot.call("/greeter/count", json!([false]))?;
    ensure!(answer["values"]["count"] == 1, "arguments may be a list: {answer}");
    // A second subscriber of the same robot gets the latched greeting.
    let mut viewer = daemon.robot("greeter_cpp?robot=crossing")?;
    viewer.subscribe("/greeter/greeting")?;
    ensure!(viewer.next_message_on("/greeter/greeting")?["text"] == "hi Ada", "latched");
    // After unsubscribing nothing more arrives.
    robot.send(json!({"op": "unsubscribe", "id": "s1", "topic": "/greeter/greeting"}))?;
    robot.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "Bob"}}))?;
    // roscpp may deliver the latched message twice to a late subscriber.
    viewer.wait_for("hi Bob", |value| value["msg"]["text"] == "hi Bob")?;
    ensure!(robot.has_not_heard(|value| value["msg"]["text"] == "hi Bob")?);
    robot.send(json!({"op": "unadvertise", "topic": "/greeter/name"}))?;
    let failed = robot.call("/greeter/no_such_service", json!({}))?;
    ensure!(failed["result"] == false && failed["values"].to_string().contains("no_such_service"), "{failed}");
    Ok(())
}

pub fn cbor_is_spoken_too() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let mut robot = daemon.robot("greeter_cpp?robot=binary")?;
    robot.send(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    robot.send(json!({"op": "subscribe", "topic": "/greeter/greeting", "compression": "cbor"}))?;
    robot.wait_for_subscriber("/greeter/name")?;
    let mut frame = Vec::new();
    let publish = json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "Ada"}});
    ciborium::into_writer(&publish, &mut frame)?;
    robot.send_frame(Message::Binary(Bytes::from(frame)))?;
    loop {
        if let Message::Binary(bytes) = robot.next_frame()? {
            let value: Value = ciborium::from_reader(bytes.as_ref())?;
            ensure!(value["op"] == "publish" && value["msg"]["text"] == "hi Ada", "{value}");
            return Ok(());
        }
    }
}

pub fn a_robot_serves_and_a_node_side_caller_is_answered() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let mut server = daemon.robot("greeter_cpp?robot=server")?;
    server.send(json!({"op": "advertise_service", "service": "/lamp", "type": "std_srvs/SetBool"}))?;
    // A second connection of the same robot calls through the servant's own ROS graph.
    let mut caller = daemon.robot("greeter_cpp?robot=server")?;
    support::wait_until("the service's type", || {
        let answer = caller.call("/rosapi/service_type", json!({"service": "/lamp"}))?;
        let is_known = answer["values"]["type"] == "std_srvs/SetBool";
        Ok(is_known.then_some(()).ok_or_else(|| answer.to_string()))
    })?;
    caller.send(json!({"op": "call_service", "id": "q", "service": "/lamp", "args": {"data": true}}))?;
    let heard = server.wait_for("the call", |value| value["op"] == "call_service" && value["service"] == "/lamp");
    let request = match heard {
        Ok(request) => request,
        Err(error) => {
            let answer = caller.wait_for("its answer", |value| value["id"] == "q");
            return Err(error.context(format!("the caller heard {answer:?}")));
        }
    };
    ensure!(request["args"]["data"] == true, "{request}");
    server.send(json!({
        "op": "service_response", "id": request["id"], "service": "/lamp", "result": true,
        "values": {"success": true, "message": "lit"}
    }))?;
    let answer = caller.wait_for("the answer", |value| value["op"] == "service_response" && value["id"] == "q")?;
    ensure!(answer["result"] == true && answer["values"]["message"] == "lit", "{answer}");
    Ok(())
}

pub fn bad_frames_are_answered_by_status() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let mut robot = daemon.robot("greeter_cpp?robot=clumsy")?;
    robot.send_frame(Message::text("{\"op\": \"publish\", "))?;
    robot.wait_for_status("JSON")?;
    robot.send(json!({"op": "dance"}))?;
    robot.wait_for_status("dance")?;
    robot.send(json!({"op": "subscribe"}))?;
    robot.wait_for_status("topic")?;
    robot.send(json!({"op": "advertise", "topic": "/nowhere", "type": "no_such_msgs/Thing"}))?;
    robot.wait_for_status("no_such_msgs/Thing")?;
    robot.send(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    robot.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": 7}}))?;
    robot.wait_for_status("data")?;
    robot.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "x", "colour": "red"}}))?;
    robot.wait_for_status("colour")?;
    // The level is respected, and the connection survives all of it.
    robot.send(json!({"op": "set_level", "level": "none"}))?;
    robot.send(json!({"op": "dance again"}))?;
    ensure!(robot.has_not_heard(|value| value["op"] == "status")?);
    Ok(())
}

pub fn a_frame_over_the_limit_closes_with_1009() -> Verdict {
    let daemon =
        world().setup("small-frames").config("[portal]\nmax_message = \"64K\"\nmax_frame = \"64K\"\n").start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let mut robot = daemon.robot("adder_py")?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 1}))?["values"]["sum"] == 2);
    let huge = "x".repeat(100_000);
    robot.send(json!({"op": "publish", "topic": "/x", "msg": {"data": huge}}))?;
    let close = robot.wait_for_close()?;
    ensure!(u16::from(close.code) == 1009, "{close:?}");
    ensure!(close.reason.contains("65536") || close.reason.contains("64"), "the limit is named: {close:?}");
    Ok(())
}

pub fn unknown_services_are_404_and_name_what_exists() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let Err(refusal) = Robot::try_connect(&daemon.url("no_such_service")) else {
        anyhow::bail!("an unknown service accepted a robot")
    };
    ensure!(refusal.status == 404, "{refusal}");
    ensure!(refusal.body.contains("no_such_service") && refusal.body.contains("adder_py"), "{refusal}");
    Ok(())
}

pub fn beyond_loopback_only_with_a_token() -> Verdict {
    let said = world().setup("open").listen("0.0.0.0:0").expect_refusal()?;
    ensure!(said.contains("token"), "{said}");
    let daemon = world()
        .setup("guarded")
        .config("tokens = [\"open sesame\"]\n[tls]\nserve = \"plain-text-beyond-loopback\"\n")
        .listen("0.0.0.0:0")
        .start()?;
    let port = daemon.address.rsplit(':').next().context("a port")?.to_owned();
    let ask = |headers: &[(&str, &str)]| -> anyhow::Result<u16> {
        let local = format!("127.0.0.1:{port}");
        let mut all = vec![("Host", local.as_str())];
        all.extend_from_slice(headers);
        Ok(daemon.request("GET", "/api/v1/services", &all)?.0)
    };
    ensure!(ask(&[])? == 401);
    ensure!(ask(&[("Authorization", "Bearer wrong")])? == 401);
    ensure!(ask(&[("Authorization", "Bearer open sesame")])? == 200);
    Ok(())
}

pub fn health_and_metrics_are_told() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    ensure!(daemon.get("/healthz")?.0 == 200);
    let mut robot = daemon.robot("adder_py?robot=measured")?;
    robot.subscribe("/sums")?;
    // As in any ROS graph, nothing arrives until the subscription is connected.
    support::wait_until("its sums", || {
        let hears_nothing = robot.has_not_heard(|value| value["topic"] == "/sums")?;
        robot.call("/add_two", json!({"a": 1, "b": 1}))?;
        Ok((!hears_nothing).then_some(()).ok_or_else(|| "none".to_owned()))
    })?;
    let (status, metrics) = daemon.get("/metrics")?;
    ensure!(status == 200);
    for name in ["cloudroid_servants", "cloudroid_connections", "cloudroid_messages", "cloudroid_dropped"] {
        ensure!(metrics.contains(name), "{name} in:\n{metrics}");
    }
    Ok(())
}

pub fn a_slash_behind_a_service_leads_to_the_same_service() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let mut robot = daemon.robot("adder_py/?robot=slashed")?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    let mut other = daemon.robot("adder_py?robot=slashed")?;
    ensure!(other.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    let servants = daemon.servants_of("adder_py")?;
    let of_both = servants.iter();
    let of_both = of_both.filter(|servant| servant["robot"] == "slashed");
    ensure!(of_both.count() == 1, "{servants:?}");
    let (status, body) = daemon.get("/adder_py/")?;
    ensure!(status == 426 && body.contains("rosbridge"), "{status} {body}");
    for path in ["/adder_py//", "/adder_py/x", "/metrics/", "/stubs/"] {
        let (status, body) = daemon.get(path)?;
        ensure!(status == 404, "{path}: {status} {body}");
    }
    Ok(())
}

pub fn a_handshake_that_cannot_be_taken_is_refused_by_what_is_wrong() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let shake = |version, key| {
        let headers = [
            ("Host", "127.0.0.1"),
            ("Connection", "Upgrade"),
            ("Upgrade", "websocket"),
            ("Sec-WebSocket-Version", version),
            ("Sec-WebSocket-Key", key),
        ];
        daemon.request("GET", "/adder_py", &headers)
    };
    let (status, body) = shake("8", "dGhlIHNhbXBsZSBub25jZQ==")?;
    ensure!(status == 426 && body.contains("Sec-WebSocket-Version is not 13"), "{status} {body}");
    let (status, body) = shake("13", "c2hvcnQ=")?;
    ensure!(status == 400 && body.contains("Sec-WebSocket-Key is not 16 bytes"), "{status} {body}");
    Ok(())
}
