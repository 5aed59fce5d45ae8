//! Privileges of the daemon's threads.

use std::collections::BTreeMap;
use std::fs;

use anyhow::{Context, ensure};
use serde_json::json;
use support::world::{GREETER, world};
use support::{Verdict, procfs};

/// Capabilities that no thread of the daemon needs (capability.h): modules, raw disks and memory, clocks, rebooting,
/// raw packets, the kernel's log, tracing, the audit system.
const NEVER: [(u32, &str); 12] = [
    (9, "linux_immutable"),
    (13, "net_raw"),
    (14, "ipc_lock"),
    (16, "sys_module"),
    (17, "sys_rawio"),
    (20, "sys_pacct"),
    (22, "sys_boot"),
    (25, "sys_time"),
    (30, "audit_control"),
    (33, "mac_admin"),
    (34, "syslog"),
    (38, "perfmon"),
];

/// A thread's name, and the fields of its `status`.
type Thread = (String, BTreeMap<String, String>);

fn read_threads(pid: i32) -> anyhow::Result<Vec<Thread>> {
    let mut threads = Vec::new();
    for entry in fs::read_dir(format!("/proc/{pid}/task"))? {
        let path = entry?.path();
        // The thread may have ended meanwhile.
        let Ok(text) = fs::read_to_string(path.join("status")) else {
            continue;
        };
        let fields = procfs::fields(&text);
        let name = fields.get("Name").context("a name")?.clone();
        threads.push((name, fields));
    }
    Ok(threads)
}

/// Checks that a thread which reads untrusted data has no privileges.
fn expect_confined((name, fields): &Thread, user: &str) -> Verdict {
    let of = |field: &str| fields.get(field).map_or("missing", String::as_str);
    for set in ["CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb"] {
        ensure!(of(set) == "0000000000000000", "{name}: {set} {}", of(set));
    }
    for ids in ["Uid", "Gid"] {
        // Real, effective, saved and file system ids.
        let all: Vec<&str> = of(ids).split_whitespace().collect();
        ensure!(all == [user; 4], "{name}: {ids} {all:?}");
    }
    ensure!(of("Groups").is_empty(), "{name}: groups {}", of("Groups"));
    ensure!(of("NoNewPrivs") == "1", "{name} may gain privileges");
    Ok(())
}

/// Checks that a thread has no capabilities that the daemon never needs.
fn expect_limited((name, fields): &Thread) -> Verdict {
    for set in ["CapPrm", "CapEff", "CapBnd"] {
        let held = u64::from_str_radix(fields.get(set).context("there")?, 16)?;
        for (number, capability) in NEVER {
            ensure!(held & 1 << number == 0, "{name} holds {capability} in {set}");
        }
    }
    Ok(())
}

/// Checks every thread of a daemon; its portal's threads have the ids `user`.
fn expect_least_privilege(pid: i32, user: &str) -> Verdict {
    let threads = read_threads(pid)?;
    let mut portals = 0;
    for thread in &threads {
        match thread.0.as_str() {
            // The main thread starts and stops the daemon, and waits in between. A reader starts with the privileges of
            // the engine's thread that creates it.
            "cloudroidd" | "engine" | "reader" | "netns-pool" | "netns" => expect_limited(thread)?,
            "netns-sockets" => {
                expect_limited(thread)?;
                // setns(2), ports below 1024, and large datagram buffers.
                let held = u64::from_str_radix(&thread.1["CapEff"], 16)?;
                ensure!(held == 1 << 21 | 1 << 10 | 1 << 12, "{held:x}");
            }
            // All other threads read untrusted data, or were started by threads that do.
            name => {
                portals += usize::from(name == "portal");
                expect_confined(thread, user)?;
            }
        }
    }
    ensure!(portals >= 2, "{:?}", threads.iter().map(|thread| &thread.0).collect::<Vec<_>>());
    Ok(())
}

pub fn threads_that_read_what_strangers_send_have_no_rights() -> Verdict {
    // After a push, a build and an examination: archives, compiler output and graphs of nodes were read.
    let daemon = world().daemon_with(GREETER)?;
    let mut robot = daemon.robot("greeter_cpp?robot=privileged")?;
    for _ in 0..20 {
        robot.call("/rosapi/get_time", json!({}))?;
    }
    // Blocking work on separate threads: packing an archive, reading a log, examining the machine.
    let (status, _) = daemon.get("/stubs/greeter_cpp.tar.gz")?;
    ensure!(status == 200, "{status}");
    daemon.get_json("/api/v1/doctor")?;
    let id = daemon.servant_of("greeter_cpp", "privileged")?["id"].clone();
    let id = id.as_str().context("an id")?.to_owned();
    daemon.deployer().run(&["logs", &id])?.expect_success()?;
    expect_least_privilege(daemon.pid(), "65521")
}

pub fn the_portals_user_is_who_the_configuration_says() -> Verdict {
    let setup = world().setup("portals-user");
    let daemon = setup.clone().config("portal_user = \"4711\"\n").start()?;
    daemon.get_json("/api/v1/status")?;
    // These threads cannot open files of the state directory, and changes are stored all the same.
    let create = ["token", "create", "r", "--role", "viewer", "--service", "*"];
    daemon.deployer().run(&create)?.expect_success()?;
    expect_least_privilege(daemon.pid(), "4711")?;
    daemon.stop()?;
    let refused = setup.config("portal_user = \"root\"\n").expect_refusal()?;
    ensure!(refused.contains("portal_user") && refused.contains("root"), "{refused}");
    Ok(())
}
