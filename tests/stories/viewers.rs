//! Viewers of others (Foxglove, Lichtblick) look into a servant by Foxglove's protocol.

use std::process::Command;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::binaries;
use support::deployer::run;
use support::patience::tell_patience;
use support::robot::{Refusal, Robot};
use tokio_tungstenite::tungstenite::{Bytes, Message};

use crate::access::token;
use crate::inside::{Scene, hears_a_picture, refused};

const PROTOCOL: &str = "foxglove.sdk.v1";

fn address(scene: &Scene, token: &str) -> String {
    let path = format!("foxglove/{}?token={token}", scene.servant);
    scene.daemon.url(&path)
}

fn attaches(scene: &Scene, token: &str) -> Result<Robot, Refusal> {
    offers(&address(scene, token), PROTOCOL)
}

fn offers(url: &str, protocol: &str) -> Result<Robot, Refusal> {
    Robot::try_connect_offering(url, &[protocol]).map(|(viewer, _)| viewer)
}

/// A program with Foxglove's own client does all that it can.
pub fn foxglove(program: &str, url: &str, part: &str) -> Verdict {
    let mut client = Command::new("node");
    client
        .arg(binaries::checkout().join("tests/robots").join(program))
        .args([url, part])
        .env("NODE_PATH", binaries::node_modules());
    let said = run(tell_patience(&mut client))?.succeeded()?.stdout;
    ensure!(said.ends_with("done\n"), "{said}");
    Ok(())
}

pub fn foxgloves_client_hears_and_an_operators_acts() -> Verdict {
    let mut scene = Scene::new("viewers", "")?;
    let olga = token(&scene.daemon, &["olga", "--role", "operator"])?;
    let program = "with_foxglove.cjs";
    foxglove(program, &address(&scene, &olga), "acts")?;
    let eve = scene.viewer("eve", "sights*")?;
    foxglove(program, &address(&scene, &eve), "looks")?;
    scene.audited("olga", "looks inside")?;
    scene.audited("olga", "inside: publish:/sights/say")?;
    scene.audited("eve", "was refused publish:/sights/say")?;
    // It was nobody's robot.
    let told = scene.told()?;
    ensure!(told["connections"] == 1, "{told:#}");

    // What comes and goes is told.
    let mut viewer = attaches(&scene, &eve)?;
    let op = |op: &str| json!({"op": op, "topic": "/later", "type": "std_msgs/String"});
    scene.rover.says(op("advertise"))?;
    let is_later = |channel: &Value| channel["topic"] == "/later";
    let advertised = viewer.hears("the new topic", |said| {
        let channels = said["channels"].as_array();
        channels.is_some_and(|channels| channels.iter().any(is_later))
    })?;
    let channels = advertised["channels"].as_array().context("channels")?;
    let id = channels.iter().find(|channel| is_later(channel));
    let id = id.context("the channel")?["id"].clone();
    scene.rover.says(op("unadvertise"))?;
    viewer.hears("its end", |said| {
        said["op"] == "unadvertise" && said["channelIds"] == json!([id])
    })?;
    // And so is the end of its token, and of the servant.
    let mut stays = attaches(&scene, &olga)?;
    let revoke = ["token", "revoke", "eve"];
    scene.daemon.deployer().types(&revoke)?.succeeded()?;
    let close = viewer.hears_close()?;
    ensure!(
        u16::from(close.code) == 1008 && close.reason.contains("revoked"),
        "{close:?}"
    );
    let stop = ["stop", &scene.servant];
    scene.daemon.deployer().types(&stop)?.succeeded()?;
    let close = stays.hears_close()?;
    ensure!(u16::from(close.code) == 1012, "{close:?}");
    refused(attaches(&scene, &olga), 404, "servant")?;
    scene.daemon.ends()?;
    Ok(())
}

/// Of a picture that has begun to come, and is not read.
const SOME: usize = 32 << 10;
/// More pictures than wait for a viewer: two, and what its socket takes.
const MANY: usize = 20;

fn asks_for_pictures(viewer: &mut Robot) -> Verdict {
    let is_picture = |channel: &Value| channel["topic"] == "/sights/image/rgb8";
    let advertised = viewer.hears("the picture", |said| {
        let channels = said["channels"].as_array();
        channels.is_some_and(|channels| channels.iter().any(is_picture))
    })?;
    let channels = advertised["channels"].as_array().context("channels")?;
    let picture = channels.iter().find(|channel| is_picture(channel));
    let picture = &picture.context("the channel")?["id"];
    viewer.says(json!({"op": "subscribe", "subscriptions": [{"id": 0, "channelId": picture}]}))
}

pub fn viewers_that_ask_badly_are_told_and_cost_nothing() -> Verdict {
    let mut scene = Scene::new("viewers-bad", "")?;
    let eve = scene.viewer("eve", "sights*")?;
    let stranger = scene.viewer("stranger", "other*")?;
    refused(attaches(&scene, &stranger), 403, "may not see servant")?;
    refused(attaches(&scene, "guess"), 401, "not known")?;
    let bare = scene.daemon.url(&format!("foxglove/{}", scene.servant));
    let bare = offers(&bare, PROTOCOL);
    refused(bare, 401, "token")?;
    let silent = Robot::try_connect(&address(&scene, &eve));
    refused(silent, 400, "speaks foxglove.sdk.v1")?;
    let other = offers(&address(&scene, &eve), "rosbridge_v2");
    refused(other, 400, "speaks foxglove.sdk.v1")?;
    for depth in ["0", "100000", "many"] {
        let url = format!("{}&depth={depth}", address(&scene, &eve));
        let greedy = offers(&url, PROTOCOL);
        refused(greedy, 400, "no number of messages from 2 to 1000")?;
    }

    // What is no message is answered in words, and the connection goes on.
    let mut viewer = attaches(&scene, &eve)?;
    let complaint = |said: &Value| said["op"] == "status" && said["level"] == 2;
    for rubbish in [
        Message::text("{"),
        Message::text("[]"),
        Message::text(r#"{"op":"launch"}"#),
        Message::text(r#"{"op":"subscribe","subscriptions":[{"id":-1,"channelId":"x"}]}"#),
        // A message, and a megabyte of it.
        Message::text(format!(
            r#"{{"op":"unsubscribe","subscriptionIds":[{}0]}}"#,
            "0,".repeat(600_000)
        )),
        Message::binary(Bytes::new()),
        Message::binary(&b"\xffwhat"[..]),
        Message::binary(&b"\x01\x02"[..]),
        Message::binary(&b"\x02\x01\x00"[..]),
    ] {
        viewer.sends(rubbish.clone())?;
        viewer
            .hears("a complaint", complaint)
            .with_context(|| format!("{rubbish:?}"))?;
    }
    let channel = viewer.hears("channels", |said| said["op"] == "advertise")?["channels"][0]["id"]
        .as_u64()
        .context("a channel")?;
    let subscriptions: Vec<_> = (0..513)
        .map(|id| json!({"id": id, "channelId": channel}))
        .collect();
    viewer.says(json!({"op": "subscribe", "subscriptions": subscriptions}))?;
    let told = viewer.hears("the bound", complaint)?;
    ensure!(
        told["message"].to_string().contains("512 subscriptions"),
        "{told}"
    );
    viewer.says(json!({"op": "subscribe", "subscriptions": [subscriptions[0]]}))?;
    let told = viewer.hears("the second of one number", complaint)?;
    ensure!(
        told["message"].to_string().contains("there already"),
        "{told}"
    );
    // A message that is too large closes it.
    viewer.sends(Message::binary(vec![1; (16 << 20) + 1]))?;
    let close = viewer.hears_close()?;
    ensure!(u16::from(close.code) == 1009, "{close:?}");

    // Thirty pictures a second that nobody takes: the robot loses nothing.
    let mut slow = Robot::on_a_short_line(&address(&scene, &eve), &[PROTOCOL])?;
    asks_for_pictures(&mut slow)?;
    support::until("a picture that it does not take", || {
        let bytes = slow.counts_waiting()?;
        Ok((bytes >= SOME)
            .then_some(())
            .ok_or(format!("{bytes} bytes")))
    })?;
    // What waits for it is full when another has taken so many more.
    let mut quick = attaches(&scene, &eve)?;
    asks_for_pictures(&mut quick)?;
    for _ in 0..MANY {
        hears_a_picture(&mut quick)?;
        let answer = scene.rover.calls("/sights/ping", json!({}))?;
        ensure!(answer["values"]["message"] == "pong", "{answer}");
    }
    ensure!(scene.told()?["dropped"] == 0, "{:#}", scene.told()?);
    hears_a_picture(&mut slow)?;
    let missed = slow.hears("what it missed", |said| said["op"] == "status")?;
    ensure!(
        missed["message"].to_string().contains("were left out"),
        "{missed}"
    );
    scene.daemon.ends()?;
    Ok(())
}
