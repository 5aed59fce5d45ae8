//! Connections that stall, pretend or take their time, and those that must not suffer from them.

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
    let daemon = world()
        .own("dribbled")
        .config("[portal]\nhandshake = \"1s\"\n")
        .start()?;
    // Some say nothing, some begin a request and send another byte of it from time to time.
    let mut dribblers: Vec<TcpStream> = (0..200)
        .map(|_| TcpStream::connect(&daemon.address))
        .collect::<Result<_, _>>()?;
    let request = b"GET /adder_py HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nX-Padding: ";
    for dribbler in dribblers.iter_mut().step_by(2) {
        dribbler.write_all(request)?;
    }
    ensure!(
        daemon.get("/healthz")?.0 == 200,
        "others are answered meanwhile"
    );
    // All are let go, and not before they were told why where there was something to answer.
    for (index, mut dribbler) in dribblers.into_iter().enumerate() {
        dribbler.set_nonblocking(true)?;
        let begun = index % 2 == 0;
        let mut heard = Vec::new();
        let deadline = Deadline::begin();
        loop {
            deadline.check(|| format!("connection {index} is still open"))?;
            // One byte more keeps nobody in: the time is for the whole header.
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
                // What was written after the end was refused by the kernel.
                Err(_) => break,
            }
        }
    }
    ensure!(daemon.get("/healthz")?.0 == 200);
    Ok(())
}

pub fn connections_that_say_nothing_keep_nobody_out() -> Verdict {
    let daemon = world().own("crowded").start()?;
    // As many descriptors as may be, whatever the shell gave.
    let limits = std::fs::read_to_string(format!("/proc/{}/limits", daemon.pid()))?;
    let line = limits
        .lines()
        .find(|line| line.starts_with("Max open files"));
    let mut numbers = line.context("a limit")?.split_whitespace().skip(3);
    let (soft, hard) = (numbers.next(), numbers.next());
    ensure!(
        soft == hard || soft == Some("524288"),
        "{soft:?} of {hard:?}"
    );
    let (_, most) = getrlimit(Resource::RLIMIT_NOFILE)?;
    setrlimit(Resource::RLIMIT_NOFILE, most, most)?;
    let silent: Vec<TcpStream> = (0..1_100)
        .map(|_| TcpStream::connect(&daemon.address))
        .collect::<Result<_, _>>()?;
    ensure!(daemon.get("/healthz")?.0 == 200, "others are answered");
    let (_, told) = daemon.get("/metrics")?;
    let value = |name: &str| {
        let mut rows = told.lines().filter_map(|row| row.strip_prefix(name));
        rows.find_map(|row| row.trim().parse::<f64>().ok())
            .context(name.to_owned())
    };
    let (dropped, kept) = (
        value("cloudroid_dropped_strangers_total")?,
        value("cloudroid_strangers")?,
    );
    ensure!(
        dropped >= 70.0 && kept <= 1024.0,
        "{dropped} dropped, {kept} kept"
    );
    drop(silent);
    // A header is read again with each part of it that comes.
    for (length, status) in [(60_000, "HTTP/1.1 200"), (70_000, "HTTP/1.1 431")] {
        let mut connection = connect(&daemon.address)?;
        connection
            .write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nX: ")?;
        // Who is refused before the end is read no further.
        let _ = connection.write_all(&vec![b'x'; length]);
        let _ = connection.write_all(b"\r\n\r\n");
        let mut answer = String::new();
        let _ = connection.read_to_string(&mut answer);
        ensure!(answer.starts_with(status), "{length} bytes: {answer:?}");
    }
    Ok(())
}

pub fn rubbish_instead_of_an_upgrade_is_refused() -> Verdict {
    let daemon = world().with(ADDER)?;
    let mut connection = connect(&daemon.address)?;
    connection.write_all(&[
        0x16, 3, 1, 2, 0, 1, 0, 1, 0xfc, 3, 3, b'\r', b'\n', b'\r', b'\n',
    ])?;
    let mut answer = String::new();
    // A reset behind the answer takes nothing from it.
    let _ = connection.read_to_string(&mut answer);
    ensure!(answer.starts_with("HTTP/1.1 400"), "{answer:?}");
    // A handshake of another version is refused by what is wrong with it.
    let (status, body) = daemon.request(
        "GET",
        "/adder_py",
        &[
            ("Host", "127.0.0.1"),
            ("Upgrade", "websocket"),
            ("Sec-WebSocket-Version", "8"),
        ],
    )?;
    ensure!(
        status == 400 && body.contains("handshake"),
        "{status} {body}"
    );
    Ok(())
}

pub fn two_sockets_of_one_robot_share_its_servant() -> Verdict {
    let daemon = world().with(GREETER)?;
    let mut stub = daemon.robot("greeter_cpp?robot=shared")?;
    let mut viewer = daemon.robot("greeter_cpp?robot=shared")?;
    for socket in [&mut stub, &mut viewer] {
        socket.calls("/rosapi/get_time", json!({}))?;
    }
    let servants = daemon.servants_of("greeter_cpp")?;
    let of_both = servants
        .iter()
        .filter(|servant| servant["robot"] == "shared");
    ensure!(of_both.count() == 1, "{servants:?}");
    // What one leaves behind when it goes is its own; the other's stays.
    viewer.says(
        json!({"op": "subscribe", "topic": "/greeter/greeting", "type": "greeter_cpp/Greeting"}),
    )?;
    stub.says(
        json!({"op": "subscribe", "topic": "/greeter/greeting", "type": "greeter_cpp/Greeting"}),
    )?;
    stub.leaves()?;
    viewer.says(json!({"op": "advertise", "topic": "/greeter/name", "type": "std_msgs/String"}))?;
    viewer.awaits_subscriber("/greeter/name")?;
    viewer.says(json!({"op": "publish", "topic": "/greeter/name", "msg": {"data": "Eve"}}))?;
    ensure!(viewer.hears_on("/greeter/greeting")?["text"] == "hi Eve");
    Ok(())
}

pub fn nobody_takes_over_anothers_robot() -> Verdict {
    let daemon = world()
        .own("owned")
        .config("tokens = [\"open sesame\", \"rosebuds\"]\n")
        .start()?;
    daemon
        .deployer()
        .pushes("adder_py", &["--node", "adder.py"])?
        .succeeded()?;
    let asks = |token: &str| Robot::try_connect(&daemon.url(&format!("adder_py?robot=r1{token}")));
    let mut owner = asks("&token=open%20sesame").map_err(|refusal| anyhow::anyhow!("{refusal}"))?;
    ensure!(owner.calls("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    for token in ["&token=rosebuds", "&token=guess"] {
        let Err(refusal) = asks(token) else {
            anyhow::bail!("{token:?} took over r1")
        };
        let known = token != "&token=guess";
        ensure!(
            refusal.status == if known { 403 } else { 401 },
            "{token:?}: {refusal}"
        );
        if known {
            ensure!(refusal.body.contains("r1"), "{token:?}: {refusal}");
        }
    }
    // Who shows the other token later gets no further.
    let mut silent = asks("").map_err(|refusal| anyhow::anyhow!("{refusal}"))?;
    silent.says(json!({"op": "auth", "mac": "rosebuds"}))?;
    let close = silent.hears_close()?;
    ensure!(close.reason.contains("r1"), "{close:?}");
    // Not after the owner has gone, either.
    owner.leaves()?;
    ensure!(
        asks("&token=rosebuds").is_err(),
        "the name stays its owner's"
    );
    asks("&token=open%20sesame").map_err(|refusal| anyhow::anyhow!("{refusal}"))?;
    Ok(())
}

/// A client on a slow line has pictures waiting; what it asks is answered behind one of them, not behind all.
pub fn an_answer_waits_for_one_big_message_at_most() -> Verdict {
    const SIZE: usize = 900_000;
    let daemon = world().with(GREETER)?;
    let mut speaker = daemon.robot("greeter_cpp?robot=backlog")?;
    let mut slow = Robot::on_a_short_line(&daemon.url("greeter_cpp?robot=backlog"), &[])?;
    let topic = json!({"op": "subscribe", "topic": "/big", "type": "std_msgs/String", "compression": "cbor-raw"});
    slow.says(topic)?;
    slow.calls("/rosapi/get_time", json!({}))?;
    speaker.says(json!({"op": "advertise", "topic": "/big", "type": "std_msgs/String"}))?;
    let text = "x".repeat(SIZE);
    for _ in 0..8 {
        speaker.says(json!({"op": "publish", "topic": "/big", "msg": {"data": text}}))?;
    }
    // All of it has been taken up before the question comes.
    speaker.calls("/rosapi/get_time", json!({}))?;
    slow.says(json!({"op": "call_service", "id": "urgent", "service": "/rosapi/get_ros_version"}))?;
    // Its answer waits in the queue when three answers have been put there.
    let answered = || -> anyhow::Result<u64> {
        let metrics = daemon.get("/metrics")?.1;
        let counts = metrics.lines().filter(|line| {
            line.starts_with("cloudroid_bridge_answers_total{") && line.contains("backlog")
        });
        counts
            .map(|line| Ok(line.rsplit(' ').next().context("a value")?.parse::<u64>()?))
            .sum()
    };
    support::until("three answers in the queue", || {
        let count = answered()?;
        Ok(if count < 3 {
            Err(count.to_string())
        } else {
            Ok(())
        })
    })?;
    let mut ahead = 0;
    loop {
        match slow.frame()? {
            Message::Binary(bytes) if bytes.len() > SIZE => ahead += 1,
            Message::Text(text) if text.contains("urgent") => break,
            other => anyhow::bail!("{other:?}"),
        }
    }
    ensure!(ahead <= 1, "{ahead} big messages came before the answer");
    Ok(())
}
