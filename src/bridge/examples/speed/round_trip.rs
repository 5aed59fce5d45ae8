//! How long a message or a call is under way.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use ros::bus::{Bus, Qos, ServiceHandler, ServiceType};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::Failure;
use crate::world::{World, frame, wire_type};

pub const TRIPS: usize = 5000;

/// Median and 99th percentile.
pub fn percentiles(mut times: Vec<Duration>) -> [Duration; 2] {
    times.sort();
    [50, 99].map(|percent| qos::nearest_rank(&times, percent).unwrap_or_default())
}

/// Client, relay, echo, relay, client: as many hops as through bridge and node.
pub async fn relay_round_trip(world: &World) -> Result<[Duration; 2], Failure> {
    let mut there = [
        TcpStream::connect(world.relay).await?,
        TcpStream::connect(world.relay).await?,
    ];
    let mut back = [
        TcpStream::connect(world.relay).await?,
        TcpStream::connect(world.relay).await?,
    ];
    for stream in there.iter_mut().chain(&mut back) {
        stream.set_nodelay(true)?;
    }
    let ([mut to, mut from], [mut echo_to, mut echo_from]) = (there, back);
    let echo = world.theirs.spawn(async move {
        let mut message = [0; 60];
        while from.read_exact(&mut message).await.is_ok()
            && echo_to.write_all(&message).await.is_ok()
        {}
    });
    let (mut message, mut times) = ([7; 60], Vec::with_capacity(TRIPS));
    for _ in 0..TRIPS {
        let begun = Instant::now();
        to.write_all(&message).await?;
        echo_from.read_exact(&mut message).await?;
        times.push(begun.elapsed());
    }
    echo.abort();
    Ok(percentiles(times))
}

/// Through the bridge: a String to a node that sends it back, or a call of a service.
pub fn round_trip(world: &World, service: bool) -> Result<[Duration; 2], Failure> {
    let wire_type = wire_type(world, "std_msgs/String")?;
    let publisher = world.theirs.block_on(world.node.advertise(
        "/trip/back",
        wire_type.clone(),
        Qos::keep_last(100),
    ))?;
    let mut subscription = world.theirs.block_on(world.node.subscribe(
        "/trip/there",
        wire_type,
        Qos::keep_last(100),
    ))?;
    let mut subscribers = publisher.matched();
    let echo = world.theirs.spawn(async move {
        while let Some(message) = subscription.messages.recv().await {
            publisher.publish(message.bytes);
        }
    });
    let def = world.registry.service("x/Echo")?;
    let service_type = ServiceType::of(&def);
    let _served =
        world
            .theirs
            .block_on(world.node.serve("/trip/call", service_type, Arc::new(Echo)))?;
    let found = world.ours.block_on(async {
        let mut stream = TcpStream::connect(world.portal).await?;
        stream.set_nodelay(true)?;
        let begin = if service {
            frame(1, br#"{"op":"set_level","level":"none"}"#)
        } else {
            let subscribe = frame(1, br#"{"op":"subscribe","topic":"/trip/back","type":"std_msgs/String"}"#);
            let advertise = frame(1, br#"{"op":"advertise","topic":"/trip/there","type":"std_msgs/String"}"#);
            [subscribe, advertise].concat()
        };
        stream.write_all(&begin).await?;
        if !service {
            subscribers.wait_for(|now| now.connected() > 0).await?;
        }
        let ask = if service {
            frame(1, br#"{"op":"call_service","id":"1","service":"/trip/call","args":{"data":"hello there"}}"#)
        } else {
            frame(1, br#"{"op":"publish","topic":"/trip/there","msg":{"data":"hello there"}}"#)
        };
        let (mut times, mut buffer) = (Vec::with_capacity(TRIPS), vec![0; 4096]);
        for _ in 0..TRIPS {
            let begun = Instant::now();
            stream.write_all(&ask).await?;
            // One short frame: its length is in the second byte.
            let mut got = stream.read(&mut buffer).await?;
            while got < 2 + usize::from(buffer[1]) {
                got += stream.read(&mut buffer[got..]).await?;
            }
            times.push(begun.elapsed());
        }
        Ok::<_, Failure>(percentiles(times))
    });
    echo.abort();
    found
}

pub struct Echo;

#[async_trait::async_trait]
impl ServiceHandler for Echo {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
        Ok(request)
    }
}
