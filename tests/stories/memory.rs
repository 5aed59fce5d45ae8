//! Memory that robots make the daemon hold is limited: a robot that exceeds its budget is told, and others are not
//! affected.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;

use anyhow::{Context, bail, ensure};
use serde_json::json;
use support::Verdict;
use support::daemon::Daemon;
use support::patience::{PatientStream, scale_seconds};
use support::robot::Robot;
use support::world::world;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::frame::Frame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{Data, OpCode};

/// Sends three megabytes of an unfinished message.
fn send_unfinished_message(robot: &mut Robot) -> Verdict {
    let bytes = vec![7_u8; 3 << 20];
    let frame = Frame::message(bytes, OpCode::Data(Data::Binary), false);
    robot.send_frame(Message::Frame(frame))
}

/// Requests a trial with a recording of which only three megabytes are sent.
fn send_unfinished_trial(daemon: &Daemon) -> anyhow::Result<PatientStream<UnixStream>> {
    // Uses the daemon's socket, because only operators and the owner of a service may start a trial.
    let mut stream = PatientStream::new(UnixStream::connect(daemon.home.join("run/daemon.sock"))?)?;
    let head = format!(
        "POST /api/v1/services/adder_py/trial?kind=bag HTTP/1.1\r\nHost: {}\r\nContent-Length: {}\r\n\r\n",
        daemon.address,
        100 << 20
    );
    stream.write_all(head.as_bytes())?;
    // If it is refused meanwhile, the rest is not read.
    let _ = stream.write_all(&vec![7; 3 << 20]);
    Ok(stream)
}

pub fn what_is_begun_and_never_ended_costs_its_owner() -> Verdict {
    // All have to start before the first one times out.
    let late = scale_seconds(8);
    let daemon =
        world().setup("memory").config(&format!("[memory]\nclient = \"8M\"\nunfinished = \"{late}s\"\n")).start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let mut polite = daemon.robot("adder_py?robot=polite")?;
    let mut answered = |sum: i64| -> Verdict {
        let answer = polite.call("/add_two", json!({"a": sum - 1, "b": 1}))?;
        ensure!(answer["values"]["sum"] == sum, "{answer}");
        Ok(())
    };
    answered(1)?;
    // Behind a proxy on this machine each robot is a client of its own.
    let greedy = || daemon.robot("adder_py?robot=greedy");
    let mut robots = [greedy()?, greedy()?, greedy()?, greedy()?];
    for robot in &mut robots {
        send_unfinished_message(robot)?;
    }
    // Two of them fit and time out; the others are refused at once.
    let closes = robots.iter_mut().map(Robot::wait_for_close);
    let closes = closes.collect::<anyhow::Result<Vec<_>>>()?;
    let of = |code: u16| closes.iter().filter(move |close| u16::from(close.code) == code);
    ensure!(of(1013).count() >= 2 && of(1013).count() + of(1008).count() == 4, "{closes:?}");
    for close in of(1013) {
        ensure!(close.reason.contains("client greedy"), "{close:?}");
    }
    answered(2)?;
    crate::survival::wait_for_event(&daemon, "memory-refused", &["client greedy"])?;
    // Request bodies count in the same way.
    let mut trials = Vec::new();
    for _ in 0..4 {
        trials.push(send_unfinished_trial(&daemon)?);
    }
    let mut refused = 0;
    for mut trial in trials {
        let mut answer = [0; 12];
        match trial.read_exact(&mut answer) {
            Ok(()) if &answer == b"HTTP/1.1 503" => refused += 1,
            Ok(()) if &answer == b"HTTP/1.1 408" => {}
            // Unread data resets the connection.
            Err(error) if error.kind() == std::io::ErrorKind::ConnectionReset => refused += 1,
            other => bail!("{other:?}: {}", String::from_utf8_lossy(&answer)),
        }
    }
    ensure!(refused >= 2, "{refused} were refused");
    answered(3)?;
    // The memory is released a moment after the response.
    support::wait_until("all that was held to be given back", || {
        let (_, metrics) = daemon.get("/metrics")?;
        let mut lines = metrics.lines();
        let held = lines.find(|line| line.starts_with("cloudroid_memory_bytes{what=\"held\"}"));
        let held = held.context("it is told")?;
        let is_none = held.ends_with(" 0");
        Ok(is_none.then_some(()).ok_or_else(|| held.to_owned()))
    })
}
