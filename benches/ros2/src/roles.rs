//! What this program does within a [`World`](crate::world::World): `bench-ros2 inside ROLE …`. Each role says `{}` when it is
//! ready, then lines of JSON.

use std::io::Read;
use std::net::UdpSocket;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use rtps::{EndpointQos, Sample, SampleIdentity, SequenceNumber};
use serde_json::{Value, json};
use tokio::sync::mpsc::UnboundedReceiver;

use crate::ends::{hears, join, matched, reads, writes};
use crate::message::{self, REQUEST, RESPONSE, STRING, TEXT};
use crate::process::Process;
use crate::{awake, bus, camera, client, crowd, hop, portal};

const PING: (&str, &str) = ("rt/ping", STRING);
const PONG: (&str, &str) = ("rt/pong", STRING);
const BEAT: (&str, &str) = ("rt/beat", STRING);
const ASKED: (&str, &str) = ("rq/setboolRequest", REQUEST);
const ANSWERED: (&str, &str) = ("rr/setboolReply", RESPONSE);
/// Where datagrams alone are echoed.
pub(crate) const ECHO: &str = "127.0.0.1:20000";
/// One as long as a String with what RTPS puts around it.
pub(crate) const DATAGRAM: [u8; 128] = [7; 128];
/// An answer that takes longer does not come.
pub(crate) const PATIENCE: Duration = Duration::from_secs(2);
/// The first of so many do not count.
pub(crate) const WARM: usize = 10;

/// Says a line.
pub(crate) fn say(line: &Value) {
    println!("{line}");
}

/// Plays the role.
pub(crate) fn play(words: &[&str]) -> Result<()> {
    match words {
        ["awake"] => return awake::play(),
        ["datagrams"] => return datagrams(),
        ["datagram-trips", count] => return datagram_trips(count.parse()?),
        ["hop"] => return hop::serve(),
        ["hop-trips", count] => return hop::trips(count.parse()?),
        ["crowd", what, count, seconds] => {
            return crowd::play(what, count.parse()?, seconds.parse()?);
        }
        ["portal", rest @ ..] => return portal::play(rest),
        ["client", rest @ ..] => return client::play(rest),
        _ => {}
    }
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    runtime.block_on(async {
        match words {
            ["relay"] => relay().await,
            ["trips", count] => trips(count.parse()?).await,
            ["calls", count] => calls(count.parse()?).await,
            ["joins"] => joins().await,
            ["rests"] => rests().await,
            ["sends", rest @ ..] => camera::sends(rest).await,
            ["takes", rest @ ..] => camera::takes(rest).await,
            ["bus", rest @ ..] => bus::play(rest).await,
            _ => bail!("no role is called {words:?}"),
        }
    })
}

/// Ends when whoever started this does, or says so.
pub(crate) async fn until_asked() -> Result<bool> {
    let ask = || std::io::stdin().read(&mut [0]);
    Ok(tokio::task::spawn_blocking(ask).await?? > 0)
}

/// Brings every ping back, and answers calls.
async fn relay() -> Result<()> {
    let participant = join().await?;
    let qos = EndpointQos::default();
    let pong = writes(&participant, PONG, qos);
    let _pings = hears(&participant, PING, qos, move |ping| {
        pong.write(ping.payload);
    });
    let answers = writes(&participant, ANSWERED, qos);
    let _requests = hears(&participant, ASKED, qos, move |request| {
        // Fast DDS's clients ask to be answered at their reader.
        let to = request
            .related
            .map_or(request.writer, |related| related.writer);
        let related = SampleIdentity {
            writer: to,
            number: request.number,
        };
        answers.write_related(message::response(&request.payload), related);
    });
    say(&json!({}));
    until_asked().await.map(drop)
}

pub(crate) fn quantiles(times: &[Duration]) -> Value {
    let micros = |share| {
        let time = bench_report::quantile(times, share);
        time.map_or(f64::NAN, |time| time.as_secs_f64() * 1e6)
    };
    json!({"p50": micros(0.5), "p99": micros(0.99)})
}

/// The next sample; none when it does not come.
async fn next(samples: &mut UnboundedReceiver<Sample>, patience: Duration) -> Option<Sample> {
    tokio::time::timeout(patience, samples.recv())
        .await
        .ok()
        .flatten()
}

/// Strings there and back, one at a time.
async fn trips(count: usize) -> Result<()> {
    let participant = join().await?;
    let qos = EndpointQos::default();
    let (_reader, mut pongs) = reads(&participant, PONG, qos);
    let pings = writes(&participant, PING, qos);
    matched(pings.ends()).await?;
    // The other side may not know of both ends yet.
    let brief = Duration::from_millis(20);
    let first = message::string("first");
    for _ in 0..500 {
        pings.write(first.clone());
        if next(&mut pongs, brief).await.is_some() {
            break;
        }
    }
    say(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let text = message::string(&format!("{TEXT}, {number}"));
        let begun = Instant::now();
        pings.write(text.clone());
        // Others of the first may still be on their way.
        while next(&mut pongs, PATIENCE).await.context("a pong")?.payload != text {}
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    say(&quantiles(&times));
    Ok(())
}

/// Calls, one at a time.
async fn calls(count: usize) -> Result<()> {
    let participant = join().await?;
    let qos = EndpointQos::default();
    let (reader, mut answers) = reads(&participant, ANSWERED, qos);
    let requests = writes(&participant, ASKED, qos);
    matched(requests.ends()).await?;
    matched(reader.ends()).await?;
    let related = SampleIdentity {
        writer: reader.guid(),
        number: SequenceNumber::UNKNOWN,
    };
    let mut call = async |patience| {
        let number = requests.write_related(message::request(true), related);
        loop {
            let answer = next(&mut answers, patience).await?;
            if answer
                .related
                .is_some_and(|related| related.number == number)
            {
                return Some(answer);
            }
        }
    };
    // A server that does not know of our reader yet has nobody to answer.
    for _ in 0..500 {
        if call(Duration::from_millis(20)).await.is_some() {
            break;
        }
    }
    say(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        call(PATIENCE).await.context("an answer")?;
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    say(&quantiles(&times));
    Ok(())
}

/// Comes to a node that runs: until its first message is here, and until one of ours has come back.
async fn joins() -> Result<()> {
    say(&json!({}));
    let begun = Instant::now();
    let participant = join().await?;
    let qos = EndpointQos::default();
    let (_beats, mut beats) = reads(&participant, BEAT, qos);
    let (_pongs, mut pongs) = reads(&participant, PONG, qos);
    let pings = Arc::new(writes(&participant, PING, qos));
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
    let since = async |samples: &mut UnboundedReceiver<Sample>| {
        let came = next(samples, long).await;
        came.map(|_| begun.elapsed().as_secs_f64() * 1e3)
    };
    let (beat, pong) = tokio::join!(since(&mut beats), since(&mut pongs));
    pinging.abort();
    say(&json!({"beat": beat.context("a beat")?, "pong": pong.context("a pong")?}));
    Ok(())
}

/// Is there, matched, and does nothing: what that takes.
async fn rests() -> Result<()> {
    let this = Process::this();
    // The runtime's own threads and descriptors are not the participant's.
    tokio::task::spawn_blocking(|| ()).await?;
    let before = (this.resident()?, this.descriptors()?, this.threads()?);
    let participant = join().await?;
    let qos = EndpointQos::default();
    let (_pongs, _samples) = reads(&participant, PONG, qos);
    let pings = writes(&participant, PING, qos);
    matched(pings.ends()).await?;
    say(&json!({}));
    while until_asked().await? {
        say(&json!({
            "memory": this.resident()? - before.0, "process": this.resident()?,
            "descriptors": this.descriptors()? - before.1, "threads": this.threads()? - before.2,
        }));
    }
    Ok(())
}

/// Brings every datagram back.
fn datagrams() -> Result<()> {
    let socket = UdpSocket::bind(ECHO)?;
    say(&json!({}));
    let mut datagram = [0; 2048];
    loop {
        let (length, from) = socket.recv_from(&mut datagram)?;
        socket.send_to(&datagram[..length], from)?;
    }
}

/// [`DATAGRAM`]s there and back, one at a time.
fn datagram_trips(count: usize) -> Result<()> {
    let socket = UdpSocket::bind("127.0.0.1:0")?;
    socket.connect(ECHO)?;
    socket.set_read_timeout(Some(PATIENCE))?;
    say(&json!({}));
    let mut times = Vec::with_capacity(count);
    for number in 0..count + WARM {
        let begun = Instant::now();
        socket.send(&DATAGRAM)?;
        socket.recv(&mut [0; 2048])?;
        if number >= WARM {
            times.push(begun.elapsed());
        }
    }
    say(&quantiles(&times));
    Ok(())
}
