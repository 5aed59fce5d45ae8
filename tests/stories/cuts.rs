//! A link that is cut repeatedly while requests are in progress.

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
use support::site::{Site, string_in, string_text};
use support::twins::{Twin, parse_sum, sum_request};
use support::world::world;

/// Time after which no further message is expected and another call is made; on an idle machine.
const PAUSE: Duration = Duration::from_millis(200);
/// Number of concurrent callers.
const CALLERS: usize = 4;
/// Maximum number of bytes between two cuts: some hundred calls. Many cuts happen during a handshake.
const STRETCH: usize = 20_000;

/// Returns how many messages of a topic both sides of a robot's link report as dropped.
fn reported_drops(daemon: &Daemon, robot: &str, topic: &str) -> anyhow::Result<u64> {
    let told = daemon.deployer().run_json(&["explain", robot])?;
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

/// Returns the resources of a process: descriptors, threads, resident memory in kB.
fn process_resources(pid: u32) -> anyhow::Result<(usize, usize, usize)> {
    let count = |what: &str| -> anyhow::Result<usize> { Ok(std::fs::read_dir(format!("/proc/{pid}/{what}"))?.count()) };
    let status = std::fs::read_to_string(format!("/proc/{pid}/status"))?;
    let resident = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))
        .and_then(|rest| rest.split_whitespace().next()?.parse().ok());
    Ok((count("fd")?, count("task")?, resident.context("VmRSS")?))
}

pub fn no_request_is_lost_or_answered_twice_however_often_the_link_is_cut(ros: RosVersion) -> Verdict {
    // A thousand cuts: `CLOUDROID_CUTS=1000 make stories ONLY=cuts`.
    let cuts = std::env::var("CLOUDROID_CUTS").ok().and_then(|cuts| cuts.parse().ok()).unwrap_or(60);
    let (adder, greeter) = (Twin::adder(ros), Twin::greeter(ros));
    // A separate daemon, because its resources are measured.
    let daemon = world().setup(&adder.robot_name("cuts")).start()?;
    let mut services = vec![adder.service, greeter.service];
    services.dedup_by_key(|service| service.name);
    for service in services {
        let package = service.package.context("a package")?;
        let pushed = daemon.deployer().push(package, service.arguments)?;
        pushed.expect_success()?;
    }
    let cutter = Cutter::new(&daemon.address, cuts, STRETCH, 0x5eed)?;
    let server = cutter.server.to_string();
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let (adds, greets) = (adder.robot_name("cut-adder"), greeter.robot_name("cut-greeter"));
    let argv = adder.argv("adder", &[]);
    let adder = adder.stub(&site, (&server, &adds), "", &argv)?;
    let argv = greeter.argv("greeter", &[("~name", "/who")]);
    let greeter = greeter.stub(&site, (&server, &greets), "", &argv)?;
    let said = || format!("the adder's:\n{}\nthe greeter's:\n{}", adder.output(), greeter.output());
    let is_there =
        |graph: &Graph| graph.services.contains_key("/add_two") && graph.services.contains_key("/greeter/count");
    site.wait_for_graph(&app, "both", is_there).with_context(said)?;
    let names = site.advertise_strings(&app, "/who", false)?;
    site.wait_for_subscribers(&*names, 1)?;
    let mut greetings = site.subscribe(&app, "/greeter/greeting")?;
    site.wait_for_publishers(&greetings, 1)?;
    let mut sums = site.subscribe(&app, "/sums")?;
    // From here on messages of both outputs arrive.
    let next = Arc::new(AtomicI64::new(1));
    let ask = || site.call_service(&app, "/add_two", &sum_request(ros, 0)).map(drop);
    site.ask_until(&mut sums, ask, |_| Ok(true)).with_context(said)?;
    names.publish(string_in(WireFormat::for_version(ros), "0"));
    site.next_message(&mut greetings).with_context(said)?;
    let before = [
        process_resources(adder.pid())?,
        process_resources(greeter.pid())?,
        process_resources(daemon.pid().unsigned_abs())?,
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
                    match app.call("/add_two", sum_request(ros, number), patience()).await {
                        Ok(response) => {
                            let response = parse_sum(ros, &response)?;
                            ensure!(response == number, "{response} is not {number}");
                            answered.fetch_add(1, Ordering::Relaxed);
                        }
                        // An error is an answer; a missing response is not.
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
                    names.publish(string_in(WireFormat::for_version(ros), &count.to_string()));
                    let greeting = wait_for(greetings.messages.recv()).await;
                    let greeting = greeting.ok().flatten().with_context(|| format!("name {count} was lost"))?;
                    let text = format!("hi {count}");
                    ensure!(
                        greeting.bytes.windows(text.len()).any(|part| part == text.as_bytes()),
                        "not the answer to {count}, or one twice: {greeting:?}"
                    );
                }
                anyhow::Ok(count)
            };
            let hear = async {
                let mut executed = BTreeSet::new();
                // Messages of each topic arrive in order: once that of a later call has arrived, all earlier ones have.
                let mut fence = None;
                loop {
                    if over() && done.load(Ordering::Relaxed) == CALLERS {
                        let number = next.fetch_add(1, Ordering::Relaxed);
                        fence.get_or_insert(number);
                        app.call("/add_two", sum_request(ros, number), patience()).await?;
                    }
                    let pause = scale(PAUSE);
                    while let Ok(Some(told)) = tokio::time::timeout(pause, sums.messages.recv()).await {
                        let number: i64 = string_text(ros, &told.bytes, 0)?.parse()?;
                        if fence.is_some_and(|fence| number >= fence) {
                            return anyhow::Ok(executed);
                        }
                        ensure!(number == 0 || executed.insert(number), "{number} was added twice");
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
        process_resources(adder.pid())?,
        process_resources(greeter.pid())?,
        process_resources(daemon.pid().unsigned_abs())?,
    ];
    let (answered, failed) = (answered.into_inner(), failed.into_inner());
    println!(
        "{cuts} cuts: {answered} calls answered, {failed} failed with a reason, {executed} executed, {greeted} names \
         greeted; descriptors, threads, kB before {before:?}, after {after:?}"
    );
    ensure!(answered > 0 && greeted > 0, "{answered} answers, {greeted} greetings");
    // Each answered call has also published its sum: it was received once, or is reported as dropped.
    let all_known = support::wait_until("each answered call's sum, heard or told as dropped", || {
        let here = sums.dropped.get();
        let dropped = here + reported_drops(&daemon, &adds, "/sums")?;
        let known = executed as u64 + dropped;
        let told = format!(
            "{answered} calls were answered and {failed} failed, {executed} sums were heard, {dropped} told as \
                    dropped"
        );
        let all = (u64::from(answered)..=u64::from(answered + failed)).contains(&known);
        Ok(if all { Ok(told) } else { Err(told) })
    });
    println!("{}", all_known.with_context(said)?);
    for ((fds, threads, memory), (fds_after, threads_after, memory_after)) in before.iter().zip(&after) {
        ensure!(fds_after <= &(fds + 8) && threads_after <= &(threads + 8), "they grow: {before:?}, {after:?}");
        ensure!(*memory_after < memory + 12_000, "memory grows: {before:?}, {after:?}");
    }
    // The same nodes in the same servants.
    let servants = daemon.deployer().run_json(&["servants"])?;
    let ours = servants
        .as_array()
        .context("a list")?
        .iter()
        .filter(|servant| servant["robot"].as_str().is_some_and(|robot| robot.starts_with("cut-")));
    ensure!(ours.count() == 2, "{servants:#}");
    drop((adder, greeter));
    daemon.deployer().run(&["stop", "--all"])?;
    daemon.stop()?;
    Ok(())
}
