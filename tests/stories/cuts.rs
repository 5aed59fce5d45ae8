//! A link that is cut again and again while requests are under way.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU32, AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, ensure};
use ros::bus::{BusError, Graph, RosVersion, WireFormat};
use support::Verdict;
use support::cutter::Cutter;
use support::daemon::Daemon;
use support::patience::{Deadline, patience, scale, wait_for};
use support::site::{Site, string_of, text_of};
use support::twins::{Twin, sum, sum_of};
use support::world::world;

/// After which nothing more is expected to come for now; another call is made then. Where nothing else runs.
const PAUSE: Duration = Duration::from_millis(200);
/// Callers at the same time.
const CALLERS: usize = 4;
/// The longest stretch between two cuts, bytes: some hundred calls. Many are in the midst of a handshake.
const STRETCH: usize = 20_000;

/// How many messages of a topic either side of a robot's link tells to have dropped.
fn told_as_dropped(daemon: &Daemon, robot: &str, topic: &str) -> anyhow::Result<u64> {
    let told = daemon.deployer().asks(&["explain", robot])?;
    let servants = told["servants"].as_array().into_iter().flatten();
    let links = servants.flat_map(|servant| servant["links"].as_array().into_iter().flatten());
    let drops = links.flat_map(|link| link["drops"].as_array().into_iter().flatten());
    let of_topic = format!(" of {topic} ");
    let counts = drops
        .filter_map(|drop| drop.as_str())
        .filter(|drop| drop.contains(&of_topic))
        .filter_map(|drop| drop.split(' ').find_map(|word| word.parse::<u64>().ok()));
    Ok(counts.sum())
}

/// What a process holds: descriptors, threads, resident memory in kB.
fn holds(pid: u32) -> anyhow::Result<(usize, usize, usize)> {
    let count = |what: &str| -> anyhow::Result<usize> {
        Ok(std::fs::read_dir(format!("/proc/{pid}/{what}"))?.count())
    };
    let status = std::fs::read_to_string(format!("/proc/{pid}/status"))?;
    let resident = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))
        .and_then(|rest| rest.split_whitespace().next()?.parse().ok());
    Ok((count("fd")?, count("task")?, resident.context("VmRSS")?))
}

pub fn no_request_is_lost_or_answered_twice_however_often_the_link_is_cut(
    ros: RosVersion,
) -> Verdict {
    // A thousand: `CLOUDROID_CUTS=1000 make stories ONLY=cuts`.
    let cuts = std::env::var("CLOUDROID_CUTS")
        .ok()
        .and_then(|cuts| cuts.parse().ok())
        .unwrap_or(60);
    let (adder, greeter) = (Twin::adder(ros), Twin::greeter(ros));
    // Of its own: what it holds is looked at.
    let daemon = world().own(&adder.robot("cuts")).start()?;
    let mut services = vec![adder.service, greeter.service];
    services.dedup_by_key(|service| service.name);
    for service in services {
        let package = service.package.context("a package")?;
        let pushed = daemon.deployer().pushes(package, service.arguments)?;
        pushed.succeeded()?;
    }
    let cutter = Cutter::new(&daemon.address, cuts, STRETCH, 0x5eed)?;
    let server = cutter.server.to_string();
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let (adds, greets) = (adder.robot("cut-adder"), greeter.robot("cut-greeter"));
    let argv = adder.argv("adder", &[]);
    let adder = adder.stub(&site, (&server, &adds), "", &argv)?;
    let argv = greeter.argv("greeter", &[("~name", "/who")]);
    let greeter = greeter.stub(&site, (&server, &greets), "", &argv)?;
    let said = || {
        format!(
            "the adder's:\n{}\nthe greeter's:\n{}",
            adder.said(),
            greeter.said()
        )
    };
    let is_there = |graph: &Graph| {
        graph.services.contains_key("/add_two") && graph.services.contains_key("/greeter/count")
    };
    site.until(&app, "both", is_there).with_context(said)?;
    let names = site.says(&app, "/who", false)?;
    site.connected(&*names, 1)?;
    let mut greetings = site.hears(&app, "/greeter/greeting")?;
    site.fed(&greetings, 1)?;
    let mut sums = site.hears(&app, "/sums")?;
    // Both outputs are heard from here on.
    let next = Arc::new(AtomicI64::new(1));
    let ask = || site.calls(&app, "/add_two", &sum(ros, 0)).map(drop);
    site.asks_until(&mut sums, ask, |_| Ok(true))
        .with_context(said)?;
    names.publish(string_of(WireFormat::of(ros), "0"));
    site.next(&mut greetings).with_context(said)?;
    let before = [
        holds(adder.pid())?,
        holds(greeter.pid())?,
        holds(daemon.pid().unsigned_abs())?,
    ];
    cutter.begin();
    let over = || cutter.cuts() >= cuts;
    let (answered, failed) = (AtomicU32::new(0), AtomicU32::new(0));
    let done = AtomicUsize::new(0);
    let (executed, greeted) = site
        .runtime
        .block_on(async {
            let call = async || {
                while !over() {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    match app.call("/add_two", sum(ros, number), patience()).await {
                        Ok(response) => {
                            let response = sum_of(ros, &response)?;
                            ensure!(response == number, "{response} is not {number}");
                            answered.fetch_add(1, Ordering::Relaxed);
                        }
                        // A reason is an answer; silence is none.
                        Err(BusError::CallFailed { .. }) => {
                            failed.fetch_add(1, Ordering::Relaxed);
                        }
                        Err(error) => anyhow::bail!("a call was lost: {error}"),
                    }
                }
                done.fetch_add(1, Ordering::Relaxed);
                Ok(())
            };
            let calls = async {
                let calls: [_; CALLERS] = std::array::from_fn(|_| call());
                let [one, two, three, four] = calls;
                tokio::try_join!(one, two, three, four).map(drop)
            };
            let greet = async {
                let mut count = 0_u32;
                while !over() {
                    count += 1;
                    names.publish(string_of(WireFormat::of(ros), &count.to_string()));
                    let greeting = wait_for(greetings.messages.recv()).await;
                    let greeting = greeting
                        .ok()
                        .flatten()
                        .with_context(|| format!("name {count} was lost"))?;
                    let text = format!("hi {count}");
                    ensure!(
                        greeting
                            .bytes
                            .windows(text.len())
                            .any(|part| part == text.as_bytes()),
                        "not the answer to {count}, or one twice: {greeting:?}"
                    );
                }
                anyhow::Ok(count)
            };
            let hear = async {
                let mut executed = BTreeSet::new();
                // Each is heard in order: once a call that came after all others is heard, so were those.
                let mut fence = None;
                loop {
                    if over() && done.load(Ordering::Relaxed) == CALLERS {
                        let number = next.fetch_add(1, Ordering::Relaxed);
                        fence.get_or_insert(number);
                        app.call("/add_two", sum(ros, number), patience()).await?;
                    }
                    let pause = scale(PAUSE);
                    while let Ok(Some(told)) =
                        tokio::time::timeout(pause, sums.messages.recv()).await
                    {
                        let number: i64 = text_of(ros, &told.bytes, 0)?.parse()?;
                        if fence.is_some_and(|fence| number >= fence) {
                            return anyhow::Ok(executed);
                        }
                        ensure!(
                            number == 0 || executed.insert(number),
                            "{number} was added twice"
                        );
                    }
                }
            };
            let all = async { tokio::try_join!(calls, greet, hear) };
            let deadline = Deadline::begin_many(u32::try_from(cuts / 60 + 1).unwrap_or(1));
            let ((), greeted, executed) = deadline.limit(all).await.with_context(|| {
                let cuts = cutter.cuts();
                format!("after {cuts} cuts {done:?} callers are done, {answered:?} answers")
            })??;
            anyhow::Ok((executed.len(), greeted))
        })
        .with_context(said)?;
    let after = [
        holds(adder.pid())?,
        holds(greeter.pid())?,
        holds(daemon.pid().unsigned_abs())?,
    ];
    let (answered, failed) = (answered.into_inner(), failed.into_inner());
    println!(
        "{cuts} cuts: {answered} calls answered, {failed} failed with a reason, {executed} executed, {greeted} names greeted; descriptors, threads, kB before {before:?}, after {after:?}"
    );
    ensure!(
        answered > 0 && greeted > 0,
        "{answered} answers, {greeted} greetings"
    );
    // Each answered call has told its sum on a topic, too: it was heard once, or is told as dropped.
    let all_known = support::until("each answered call's sum, heard or told as dropped", || {
        let here = sums.dropped.get();
        let dropped = here + told_as_dropped(&daemon, &adds, "/sums")?;
        let known = executed as u64 + dropped;
        let told = format!(
            "{answered} calls were answered and {failed} failed, {executed} sums were heard, {dropped} told as dropped"
        );
        let all = (u64::from(answered)..=u64::from(answered + failed)).contains(&known);
        Ok(if all { Ok(told) } else { Err(told) })
    });
    println!("{}", all_known.with_context(said)?);
    for ((fds, threads, memory), (fds_after, threads_after, memory_after)) in
        before.iter().zip(&after)
    {
        ensure!(
            fds_after <= &(fds + 8) && threads_after <= &(threads + 8),
            "they grow: {before:?}, {after:?}"
        );
        ensure!(
            *memory_after < memory + 12_000,
            "memory grows: {before:?}, {after:?}"
        );
    }
    // The same nodes in the same servants.
    let servants = daemon.deployer().asks(&["servants"])?;
    let ours = servants
        .as_array()
        .context("a list")?
        .iter()
        .filter(|servant| {
            servant["robot"]
                .as_str()
                .is_some_and(|robot| robot.starts_with("cut-"))
        });
    ensure!(ours.count() == 2, "{servants:#}");
    drop((adder, greeter));
    daemon.deployer().types(&["stop", "--all"])?;
    daemon.ends()?;
    Ok(())
}
