//! The roles of this program inside a [`BenchNetwork`](crate::world::BenchNetwork): `bench-ros2 inside ROLE …`. Each
//! role prints `{}` when it is ready, then lines of JSON.

use std::net::UdpSocket;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use bench_report::Process;
use rtps::{EndpointQos, ReceivedSample, SampleIdentity, SequenceNumber};
use serde_json::json;
use tokio::sync::mpsc::UnboundedReceiver;

use crate::ends::{create_listener, create_reader, create_writer, join, wait_until_matched};
use crate::measuring::{DATAGRAM, ECHO, PATIENCE, WARM, print_json, quantiles, wait_for_request};
use crate::message::{self, REQUEST, RESPONSE, STRING, TEXT};
use crate::{awake, bus, camera, client, crowd, hop, portal};

const PING: (&str, &str) = ("rt/ping", STRING);
const PONG: (&str, &str) = ("rt/pong", STRING);
const BEAT: (&str, &str) = ("rt/beat", STRING);
const ASKED: (&str, &str) = ("rq/setboolRequest", REQUEST);
const ANSWERED: (&str, &str) = ("rr/setboolReply", RESPONSE);
/// Runs the role that `words` names.
pub(crate) fn run(words: &[&str]) -> Result<()> {
    match words {
        ["awake"] => return awake::run(),
        ["datagrams"] => return echo_datagrams(),
        ["datagram-trips", count] => return time_datagrams(count.parse()?),
        ["hop"] => return hop::run_relay(),
        ["hop-trips", count] => return hop::time_trips(count.parse()?),
        ["crowd", what, count, seconds] => {
            return crowd::run(what, count.parse()?, seconds.parse()?);
        }
        ["portal", rest @ ..] => return portal::run(rest),
        ["client", rest @ ..] => return client::run(rest),
        _ => {}
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        match words {
            ["relay"] => run_relay().await,
            ["trips", count] => time_trips(count.parse()?).await,
            ["calls", count] => time_calls(count.parse()?).await,
            ["joins"] => time_join().await,
            ["rests"] => measure_idle().await,
            ["sends", rest @ ..] => camera::send_pictures(rest).await,
            ["takes", rest @ ..] => camera::receive_pictures(rest).await,
            ["bus", rest @ ..] => bus::run(rest).await,
            _ => bail!("no role is called {words:?}"),
        }
    })
}

/// Runs the role `relay`: returns every ping and answers calls.
async fn run_relay() -> Result<()> {
    let participant = join().await?;
    let qos = EndpointQos::default();
    let pong = create_writer(&participant, PONG, qos);
    let _pings = create_listener(&participant, PING, qos, move |ping| {
        pong.write(ping.payload);
    });
    let answers = create_writer(&participant, ANSWERED, qos);
    let _requests = create_listener(&participant, ASKED, qos, move |request| {
        // Clients of Fast DDS request the answer at their reader.
        let to = request.related.map_or(request.writer, |related| related.writer);
        let related = SampleIdentity { writer: to, number: request.number };
        answers.write_related(message::set_bool_response(&request.payload), related);
    });
    print_json(&json!({}));
    wait_for_request().await.map(drop)
}

/// Returns the next sample, or `None` if none arrives in time.
async fn next_sample(samples: &mut UnboundedReceiver<ReceivedSample>, patience: Duration) -> Option<ReceivedSample> {
    tokio::time::timeout(patience, samples.recv()).await.ok().flatten()
}

/// Measures round trips of Strings, one at a time.
async fn time_trips(count: usize) -> Result<()> {
    let participant = join().await?;
    let qos = EndpointQos::default();
    let (_reader, mut pongs) = create_reader(&participant, PONG, qos);
    let pings = create_writer(&participant, PING, qos);
    wait_until_matched(pings.watch_matches()).await?;
    // The other side may not have discovered both endpoints yet.
    let brief = Duration::from_millis(20);
    let first = message::string("first");
    for _ in 0..500 {
        pings.write(first.clone());
        if next_sample(&mut pongs, brief).await.is_some() {
            break;
        }
    }
    print_json(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let text = message::string(&format!("{TEXT}, {number}"));
        let begun = Instant::now();
        pings.write(text.clone());
        // Further copies of the first message may still be in flight.
        while next_sample(&mut pongs, PATIENCE).await.context("a pong")?.payload != text {}
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    print_json(&quantiles(&times));
    Ok(())
}

/// Measures calls, one at a time.
async fn time_calls(count: usize) -> Result<()> {
    let participant = join().await?;
    let qos = EndpointQos::default();
    let (reader, mut answers) = create_reader(&participant, ANSWERED, qos);
    let requests = create_writer(&participant, ASKED, qos);
    wait_until_matched(requests.watch_matches()).await?;
    wait_until_matched(reader.watch_matches()).await?;
    let related = SampleIdentity { writer: reader.guid(), number: SequenceNumber::UNKNOWN };
    let mut call = async |patience| {
        let number = requests.write_related(message::set_bool_request(true), related);
        loop {
            let answer = next_sample(&mut answers, patience).await?;
            if answer.related.is_some_and(|related| related.number == number) {
                return Some(answer);
            }
        }
    };
    // A server that has not discovered our reader cannot answer.
    for _ in 0..500 {
        if call(Duration::from_millis(20)).await.is_some() {
            break;
        }
    }
    print_json(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        call(PATIENCE).await.context("an answer")?;
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    print_json(&quantiles(&times));
    Ok(())
}

/// Joins a running node; measures until its first message arrives, and until one of ours has been returned.
async fn time_join() -> Result<()> {
    print_json(&json!({}));
    let begun = Instant::now();
    let participant = join().await?;
    let qos = EndpointQos::default();
    let (_beats, mut beats) = create_reader(&participant, BEAT, qos);
    let (_pongs, mut pongs) = create_reader(&participant, PONG, qos);
    let pings = Arc::new(create_writer(&participant, PING, qos));
    let pinging = {
        let pings = pings.clone();
        tokio::spawn(async move {
            loop {
                pings.write(message::string("ping"));
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
        })
    };
    let long = Duration::from_secs(10);
    let since = async |samples: &mut UnboundedReceiver<ReceivedSample>| {
        let came = next_sample(samples, long).await;
        came.map(|_| begun.elapsed().as_secs_f64() * 1e3)
    };
    let (beat, pong) = tokio::join!(since(&mut beats), since(&mut pongs));
    pinging.abort();
    print_json(&json!({"beat": beat.context("a beat")?, "pong": pong.context("a pong")?}));
    Ok(())
}

/// Measures the resources of a matched and idle participant.
async fn measure_idle() -> Result<()> {
    let this = Process::current();
    // The runtime's own threads and descriptors are not the participant's.
    tokio::task::spawn_blocking(|| ()).await?;
    let before = (this.resident()?, this.descriptors()?, this.threads()?);
    let participant = join().await?;
    let qos = EndpointQos::default();
    let (_pongs, _samples) = create_reader(&participant, PONG, qos);
    let pings = create_writer(&participant, PING, qos);
    wait_until_matched(pings.watch_matches()).await?;
    print_json(&json!({}));
    while wait_for_request().await? {
        print_json(&json!({
            "memory": this.resident()? - before.0, "process": this.resident()?,
            "descriptors": this.descriptors()? - before.1, "threads": this.threads()? - before.2,
        }));
    }
    Ok(())
}

/// Runs the role `datagrams`: returns every datagram.
fn echo_datagrams() -> Result<()> {
    let socket = UdpSocket::bind(ECHO)?;
    print_json(&json!({}));
    let mut datagram = [0; 2048];
    loop {
        let (length, from) = socket.recv_from(&mut datagram)?;
        socket.send_to(&datagram[..length], from)?;
    }
}

/// Measures round trips of [`DATAGRAM`], one at a time.
fn time_datagrams(count: usize) -> Result<()> {
    let socket = UdpSocket::bind("127.0.0.1:0")?;
    socket.connect(ECHO)?;
    socket.set_read_timeout(Some(PATIENCE))?;
    print_json(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        socket.send(&DATAGRAM)?;
        socket.recv(&mut [0; 2048])?;
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    print_json(&quantiles(&times));
    Ok(())
}
