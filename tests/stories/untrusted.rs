//! Connections that stall, deceive or are slow, and their effect on others.

use std::io::{Read, Write};
use std::net::TcpStream;

use anyhow::{Context, ensure};
use nix::sys::resource::{Resource, getrlimit, setrlimit};
use serde_json::json;
use support::Verdict;
use support::patience::{Deadline, connect};
use support::robot::Robot;
use support::world::{ADDER, GREETER, world};
use tokio_tungstenite::tungstenite::Message;

pub fn who_dribbles_an_upgrade_is_let_go() -> Verdict {
    let daemon = world().setup("dribbled").config("[portal]\nhandshake = \"1s\"\n").start()?;
    // Some send nothing, some start a request and send another byte of it from time to time.
    let mut dribblers: Vec<TcpStream> =
        (0..200).map(|_| TcpStream::connect(&daemon.address)).collect::<Result<_, _>>()?;
    let request = b"GET /adder_py HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nX-Padding: ";
    for dribbler in dribblers.iter_mut().step_by(2) {
        dribbler.write_all(request)?;
    }
    ensure!(daemon.get("/healthz")?.0 == 200, "others are answered meanwhile");
    // All are disconnected, after an error response if they had started a request.
    for (index, mut dribbler) in dribblers.into_iter().enumerate() {
        dribbler.set_nonblocking(true)?;
        let begun = index % 2 == 0;
        let mut heard = Vec::new();
        let deadline = Deadline::begin();
        loop {
            deadline.check(|| format!("connection {index} is still open"))?;
            // Further bytes do not extend the time limit, which applies to the whole header.
            if begun {
                let _ = dribbler.write(b"x");
            }
            let mut buffer = [0; 1024];
            match dribbler.read(&mut buffer) {
                Ok(0) => break,
                Ok(length) => heard.extend_from_slice(&buffer[..length]),
                Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => {
                    std::thread::sleep(std::time::Duration::from_millis(10));
                }
                // The kernel has refused data written after the end.
                Err(_) => break,
            }
        }
    }
    ensure!(daemon.get("/healthz")?.0 == 200);
    Ok(())
}

pub fn connections_that_say_nothing_keep_nobody_out() -> Verdict {
    let daemon = world().setup("crowded").start()?;
    // As many descriptors as permitted, whatever the shell's limit.
    let limits = std::fs::read_to_string(format!("/proc/{}/limits", daemon.pid()))?;
    let line = limits.lines().find(|line| line.starts_with("Max open files"));
    let mut numbers = line.context("a limit")?.split_whitespace().skip(3);
    let (soft, hard) = (numbers.next(), numbers.next());
    ensure!(soft == hard || soft == Some("524288"), "{soft:?} of {hard:?}");
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE)?;
    setrlimit(Resource::RLIMIT_NOFILE, most, most)?;
    let silent: Vec<TcpStream> = (0..1_100).map(|_| TcpStream::connect(&daemon.address)).collect::<Result<_, _>>()?;
    ensure!(daemon.get("/healthz")?.0 == 200, "others are answered");
    let (_, told) = daemon.get("/metrics")?;
    let value = |name: &str| {
        let mut rows = told.lines().filter_map(|row| row.strip_prefix(name));
        rows.find_map(|row| row.trim().parse::<f64>().ok()).context(name.to_owned())
    };
    let (dropped, kept) = (value("cloudroid_dropped_strangers_total")?, value("cloudroid_strangers")?);
    ensure!(dropped >= 70.0 && kept <= 1024.0, "{dropped} dropped, {kept} kept");
    drop(silent);
    // A header is parsed again with each further part.
    for (length, status) in [(60_000, "HTTP/1.1 200"), (70_000, "HTTP/1.1 431")] {
        let mut connection = connect(&daemon.address)?;
        connection.write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nX: ")?;
        // After the refusal the rest is not read.
        let _ = connection.write_all(&vec![b'x'; length]);
        let _ = connection.write_all(b"\r\n\r\n");
        let mut answer = String::new();
        let _ = connection.read_to_string(&mut answer);
        ensure!(answer.starts_with(status), "{length} bytes: {answer:?}");
    }
    Ok(())
}

pub fn rubbish_instead_of_an_upgrade_is_refused() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let mut connection = connect(&daemon.address)?;
    connection.write_all(&[0x16, 3, 1, 2, 0, 1, 0, 1, 0xfc, 3, 3, b'\r', b'\n', b'\r', b'\n'])?;
    let mut answer = String::new();
    // A reset after the response does not affect it.
    let _ = connection.read_to_string(&mut answer);
    ensure!(answer.starts_with("HTTP/1.1 400"), "{answer:?}");
    // A handshake with an unsupported version is refused with that reason.
    let (status, body) = daemon.request(
        "GET",
        "/adder_py",
        &[("Host", "127.0.0.1"), ("Upgrade", "websocket"), ("Sec-WebSocket-Version", "8")],
    )?;
    ensure!(status == 400 && body.contains("handshake"), "{status} {body}");
    Ok(())
}

pub fn two_sockets_of_one_robot_share_its_servant() -> Verdict {
    let daemon = world().daemon_with(GREETER)?;
    let mut stub = daemon.robot("greeter_cpp?robot=shared")?;
    let mut viewer = daemon.robot("greeter_cpp?robot=shared")?;
    for socket in [&mut stub, &mut viewer] {
        socket.call("/rosapi/get_time", json!({}))?;
    }
    let servants = daemon.servants_of("greeter_cpp")?;
    let of_both = servants.iter().filter(|servant| servant["robot"] == "shared");
    ensure!(of_both.count() == 1, "{servants:?}");
    // Registrations of one connection are removed when it ends; those of the other remain.
    viewer.send(json!({"op": "subscribe", "topic": "/greeter/greeting", "type": "greeter_cpp/Greeting"}))?;
    stub.send(json!({"op": "subscribe", "topic": "/greeter/greeting", "type": "greeter_cpp/Greeting"}))?;
    stub.leave()?;
    viewer.send(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    viewer.wait_for_subscriber("/greeter/name")?;
    viewer.send(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "Eve"}}))?;
    ensure!(viewer.next_message_on("/greeter/greeting")?["text"] == "hi Eve");
    Ok(())
}

pub fn nobody_takes_over_anothers_robot() -> Verdict {
    let daemon = world().setup("owned").config("tokens = [\"open sesame\", \"rosebuds\"]\n").start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let asks = |token: &str| Robot::try_connect(&daemon.url(&format!("adder_py?robot=r1{token}")));
    let mut owner = asks("&token=open%20sesame").map_err(|refusal| anyhow::anyhow!("{refusal}"))?;
    ensure!(owner.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    for token in ["&token=rosebuds", "&token=guess"] {
        let Err(refusal) = asks(token) else { anyhow::bail!("{token:?} took over r1") };
        let known = token != "&token=guess";
        ensure!(refusal.status == if known { 403 } else { 401 }, "{token:?}: {refusal}");
        if known {
            ensure!(refusal.body.contains("r1"), "{token:?}: {refusal}");
        }
    }
    // Showing the other token later does not help either.
    let mut silent = asks("").map_err(|refusal| anyhow::anyhow!("{refusal}"))?;
    silent.send(json!({"op": "auth", "mac": "rosebuds"}))?;
    let close = silent.wait_for_close()?;
    ensure!(close.reason.contains("r1"), "{close:?}");
    // Not even after the owner has left.
    owner.leave()?;
    ensure!(asks("&token=rosebuds").is_err(), "the name stays its owner's");
    asks("&token=open%20sesame").map_err(|refusal| anyhow::anyhow!("{refusal}"))?;
    Ok(())
}

/// A client on a slow connection has images queued; answers to its calls are sent after one of them, not after all.
pub fn an_answer_waits_for_one_big_message_at_most() -> Verdict {
    const SIZE: usize = 900_000;
    let daemon = world().daemon_with(GREETER)?;
    let mut speaker = daemon.robot("greeter_cpp?robot=backlog")?;
    let mut slow = Robot::connect_with_small_buffer(&daemon.url("greeter_cpp?robot=backlog"), &[])?;
    let topic = json!({"op": "subscribe", "topic": "/big", "type": "std_msgs/String", "compression": "cbor-raw"});
    slow.send(topic)?;
    slow.call("/rosapi/get_time", json!({}))?;
    speaker.send(json!({"op": "advertise", "topic": "/big", "type": "std_msgs/String"}))?;
    let text = "x".repeat(SIZE);
    for _ in 0..8 {
        speaker.send(json!({"op": "publish", "topic": "/big", "msg": {"data": text}}))?;
    }
    // All messages have been queued before the call.
    speaker.call("/rosapi/get_time", json!({}))?;
    slow.send(json!({"op": "call_service", "id": "urgent", "service": "/rosapi/get_ros_version"}))?;
    // Its answer is in the queue once three answers have been queued.
    let answered = || -> anyhow::Result<u64> {
        let metrics = daemon.get("/metrics")?.1;
        let counts = metrics
            .lines()
            .filter(|line| line.starts_with("cloudroid_bridge_answers_total{") && line.contains("backlog"));
        counts.map(|line| Ok(line.rsplit(' ').next().context("a value")?.parse::<u64>()?)).sum()
    };
    support::wait_until("three answers in the queue", || {
        let count = answered()?;
        Ok(if count < 3 { Err(count.to_string()) } else { Ok(()) })
    })?;
    let mut ahead = 0;
    loop {
        match slow.next_frame()? {
            Message::Binary(bytes) if bytes.len() > SIZE => ahead += 1,
            Message::Text(text) if text.contains("urgent") => break,
            other => anyhow::bail!("{other:?}"),
        }
    }
    ensure!(ahead <= 1, "{ahead} big messages came before the answer");
    Ok(())
}
