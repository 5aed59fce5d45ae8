//! Third-party viewers (Foxglove, Lichtblick) look into a servant through Foxglove's protocol.

use std::process::Command;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::binaries;
use support::deployer::run;
use support::patience::tell_patience;
use support::robot::{ConnectionRefusal, Robot};
use tokio_tungstenite::tungstenite::{Bytes, Message};

use crate::access::create_token;
use crate::inside::{InsideScene, expect_refused, wait_for_picture};

const PROTOCOL: &str = "foxglove.sdk.v1";

fn viewer_url(scene: &InsideScene, token: &str) -> String {
    let path = format!("foxglove/{}?token={token}", scene.servant);
    scene.daemon.url(&path)
}

fn attach(scene: &InsideScene, token: &str) -> Result<Robot, ConnectionRefusal> {
    connect_with_protocol(&viewer_url(scene, token), PROTOCOL)
}

fn connect_with_protocol(url: &str, protocol: &str) -> Result<Robot, ConnectionRefusal> {
    Robot::try_connect_with_protocols(url, &[protocol]).map(|(viewer, _)| viewer)
}

/// Runs a program that uses all functions of Foxglove's own client.
pub fn run_foxglove(program: &str, url: &str, part: &str) -> Verdict {
    let mut client = Command::new("node");
    client
        .arg(binaries::checkout().join("tests/robots").join(program))
        .args([url, part])
        .env("NODE_PATH", binaries::node_modules());
    let said = run(tell_patience(&mut client))?.expect_success()?.stdout;
    ensure!(said.ends_with("done\n"), "{said}");
    Ok(())
}

pub fn foxgloves_client_hears_and_an_operators_acts() -> Verdict {
    let mut scene = InsideScene::new("viewers", "")?;
    let olga = create_token(&scene.daemon, &["olga", "--role", "operator"])?;
    let program = "with_foxglove.cjs";
    run_foxglove(program, &viewer_url(&scene, &olga), "acts")?;
    let eve = scene.viewer_token("eve", "sights*")?;
    run_foxglove(program, &viewer_url(&scene, &eve), "looks")?;
    scene.wait_for_audit("olga", "looks inside")?;
    scene.wait_for_audit("olga", "inside: publish:/sights/say")?;
    scene.wait_for_audit("eve", "was refused publish:/sights/say")?;
    // It did not count as a robot.
    let told = scene.servant()?;
    ensure!(told["connections"] == 1, "{told:#}");

    // Changes of the topics are reported.
    let mut viewer = attach(&scene, &eve)?;
    let op = |op: &str| json!({"op": op, "topic": "/later", "type": "std_msgs/String"});
    scene.rover.send(op("advertise"))?;
    let is_later = |channel: &Value| channel["topic"] == "/later";
    let advertised = viewer.wait_for("the new topic", |said| {
        let channels = said["channels"].as_array();
        channels.is_some_and(|channels| channels.iter().any(is_later))
    })?;
    let channels = advertised["channels"].as_array().context("channels")?;
    let id = channels.iter().find(|channel| is_later(channel));
    let id = id.context("the channel")?["id"].clone();
    scene.rover.send(op("unadvertise"))?;
    viewer.wait_for("its end", |said| said["op"] == "unadvertise" && said["channelIds"] == json!([id]))?;
    // The ends of its token and of the servant are reported.
    let mut stays = attach(&scene, &olga)?;
    let revoke = ["token", "revoke", "eve"];
    scene.daemon.deployer().run(&revoke)?.expect_success()?;
    let close = viewer.wait_for_close()?;
    ensure!(u16::from(close.code) == 1008 && close.reason.contains("revoked"), "{close:?}");
    let stop = ["stop", &scene.servant];
    scene.daemon.deployer().run(&stop)?.expect_success()?;
    let close = stays.wait_for_close()?;
    ensure!(u16::from(close.code) == 1012, "{close:?}");
    expect_refused(attach(&scene, &olga), 404, "servant")?;
    scene.daemon.stop()?;
    Ok(())
}

/// Bytes that have arrived of an image which is not read further.
const PARTIAL_IMAGE: usize = 32 << 10;
/// More images than are queued for a viewer: 2 of the topic, 16 of all its topics, 2 at its socket, and 4 MB in the
/// kernel.
const UNREAD_IMAGES: usize = 40;

fn request_pictures(viewer: &mut Robot) -> Verdict {
    let is_picture = |channel: &Value| channel["topic"] == "/sights/image/rgb8";
    let advertised = viewer.wait_for("the picture", |said| {
        let channels = said["channels"].as_array();
        channels.is_some_and(|channels| channels.iter().any(is_picture))
    })?;
    let channels = advertised["channels"].as_array().context("channels")?;
    let picture = channels.iter().find(|channel| is_picture(channel));
    let picture = &picture.context("the channel")?["id"];
    viewer.send(json!({"op": "subscribe", "subscriptions": [{"id": 0, "channelId": picture}]}))
}

pub fn viewers_that_ask_badly_are_told_and_cost_nothing() -> Verdict {
    let mut scene = InsideScene::new("viewers-bad", "")?;
    let eve = scene.viewer_token("eve", "sights*")?;
    let stranger = scene.viewer_token("stranger", "other*")?;
    expect_refused(attach(&scene, &stranger), 403, "may not see servant")?;
    expect_refused(attach(&scene, "guess"), 401, "not known")?;
    let bare = scene.daemon.url(&format!("foxglove/{}", scene.servant));
    let bare = connect_with_protocol(&bare, PROTOCOL);
    expect_refused(bare, 401, "token")?;
    let silent = Robot::try_connect(&viewer_url(&scene, &eve));
    expect_refused(silent, 400, "speaks foxglove.sdk.v1")?;
    let other = connect_with_protocol(&viewer_url(&scene, &eve), "rosbridge_v2");
    expect_refused(other, 400, "speaks foxglove.sdk.v1")?;
    for depth in ["0", "100000", "many"] {
        let url = format!("{}&depth={depth}", viewer_url(&scene, &eve));
        let greedy = connect_with_protocol(&url, PROTOCOL);
        expect_refused(greedy, 400, "not a number of messages from 2 to 1000")?;
    }

    // An invalid message is answered with an error, and the connection continues.
    let mut viewer = attach(&scene, &eve)?;
    let complaint = |said: &Value| said["op"] == "status" && said["level"] == 2;
    for rubbish in [
        Message::text("{"),
        Message::text("[]"),
        Message::text(r#"{"op":"launch"}"#),
        Message::text(r#"{"op":"subscribe","subscriptions":[{"id":-1,"channelId":"x"}]}"#),
        // A message with a megabyte of payload.
        Message::text(format!(r#"{{"op":"unsubscribe","subscriptionIds":[{}0]}}"#, "0,".repeat(600_000))),
        Message::binary(Bytes::new()),
        Message::binary(&b"\xffwhat"[..]),
        Message::binary(&b"\x01\x02"[..]),
        Message::binary(&b"\x02\x01\x00"[..]),
    ] {
        viewer.send_frame(rubbish.clone())?;
        viewer.wait_for("a complaint", complaint).with_context(|| format!("{rubbish:?}"))?;
    }
    let channel = viewer.wait_for("channels", |said| said["op"] == "advertise")?["channels"][0]["id"]
        .as_u64()
        .context("a channel")?;
    let subscriptions: Vec<_> = (0..513).map(|id| json!({"id": id, "channelId": channel})).collect();
    viewer.send(json!({"op": "subscribe", "subscriptions": subscriptions}))?;
    let told = viewer.wait_for("the bound", complaint)?;
    ensure!(told["message"].to_string().contains("512 subscriptions"), "{told}");
    viewer.send(json!({"op": "subscribe", "subscriptions": [subscriptions[0]]}))?;
    let told = viewer.wait_for("the second of one number", complaint)?;
    ensure!(told["message"].to_string().contains("already exists"), "{told}");
    // A message that is too large closes the connection.
    viewer.send_frame(Message::binary(vec![1; (16 << 20) + 1]))?;
    let close = viewer.wait_for_close()?;
    ensure!(u16::from(close.code) == 1009, "{close:?}");

    // Thirty images per second that nobody reads: the robot loses nothing.
    let mut slow = Robot::connect_with_small_buffer(&viewer_url(&scene, &eve), &[PROTOCOL])?;
    request_pictures(&mut slow)?;
    support::wait_until("a picture that it does not take", || {
        let bytes = slow.count_waiting_bytes()?;
        Ok((bytes >= PARTIAL_IMAGE).then_some(()).ok_or(format!("{bytes} bytes")))
    })?;
    // Its queue is full once another viewer has received this many more.
    let mut quick = attach(&scene, &eve)?;
    request_pictures(&mut quick)?;
    for _ in 0..UNREAD_IMAGES {
        wait_for_picture(&mut quick)?;
        let answer = scene.rover.call("/sights/ping", json!({}))?;
        ensure!(answer["values"]["message"] == "pong", "{answer}");
    }
    ensure!(scene.servant()?["dropped"] == 0, "{:#}", scene.servant()?);
    wait_for_picture(&mut slow)?;
    let missed = slow.wait_for("what it missed", |said| said["op"] == "status")?;
    ensure!(missed["message"].to_string().contains("were dropped"), "{missed}");
    scene.daemon.stop()?;
    Ok(())
}
