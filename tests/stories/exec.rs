//! `cloudroidctl exec`: programs in servants, as their nodes run, for those who may.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::{Receiver, channel};

use anyhow::{Context, ensure};
use ros::bus::RosVersion;
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::patience;
use support::robot::Robot;
use support::world::{ADDER, SEER, world};
use support::{Verdict, binaries, procfs};

use crate::access::{create_token, push_adder, run_with_token};
use crate::survival::expect_nothing_left;

/// A running `cloudroidctl exec`, or a terminal around it.
struct ExecProcess {
    child: Child,
    input: Option<ChildStdin>,
    /// Pieces of its standard output.
    printed: Receiver<String>,
    heard: String,
}

impl ExecProcess {
    fn start(command: &mut Command) -> anyhow::Result<ExecProcess> {
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let mut output = child.stdout.take().context("piped")?;
        let (sender, printed) = channel();
        std::thread::spawn(move || {
            let mut block = [0; 4096];
            while let Ok(length @ 1..) = output.read(&mut block) {
                if sender.send(String::from_utf8_lossy(&block[..length]).into_owned()).is_err() {
                    return;
                }
            }
        });
        Ok(ExecProcess { input: child.stdin.take(), child, printed, heard: String::new() })
    }

    /// Runs `cloudroidctl exec` with separate streams.
    fn start_command(daemon: &Daemon, servant: &str, command: &[&str]) -> anyhow::Result<ExecProcess> {
        ExecProcess::start(ctl(daemon).args(["exec", servant, "--"]).args(command))
    }

    fn types(&mut self, text: &str) -> Verdict {
        Ok(self.input.as_mut().context("open")?.write_all(text.as_bytes())?)
    }

    /// Waits until it has printed `words`, and forgets all up to there.
    fn hears(&mut self, words: &str) -> Verdict {
        loop {
            if let Some(at) = self.heard.find(words) {
                self.heard.drain(..at + words.len());
                return Ok(());
            }
            let came = patience::receive(&self.printed);
            self.heard += &came.with_context(|| format!("{words:?} did not come, but {:?}", self.heard))?;
        }
    }

    fn wait(mut self) -> anyhow::Result<ExitStatus> {
        drop(self.input.take());
        Ok(self.child.wait()?)
    }
}

fn ctl(daemon: &Daemon) -> Command {
    let mut command = Command::new(binaries::path("cloudroidctl"));
    command.env("CLOUDROID_HOME", daemon.deployer().home).env_remove("CLOUDROID_SERVER");
    command
}

/// Returns the servant of a robot that stays connected.
fn working_servant(daemon: &Daemon, service: &str, query: &str, robot: &str) -> anyhow::Result<(Robot, String)> {
    let mut connected = daemon.robot(&format!("{service}?robot={robot}{query}"))?;
    connected.call("/rosapi/get_time", json!({}))?;
    let servant = daemon.servant_of(service, robot)?;
    Ok((connected, servant["id"].as_str().context("an id")?.to_owned()))
}

/// Returns the host pids of running processes with this in their command line, among those of the servant.
fn pids_with(daemon: &Daemon, servant: &str, words: &str) -> anyhow::Result<Vec<i32>> {
    let told = daemon.api(&format!("/api/v1/servants/{servant}"))?;
    let pids = told["pids"].as_array().context("pids")?.iter().filter_map(|pid| Some(pid.as_i64()? as i32));
    Ok(pids
        .filter(|pid| procfs::is_running(*pid))
        .filter(|pid| procfs::command_line(*pid).is_some_and(|line| line.contains(words)))
        .collect())
}

fn wait_until_gone(daemon: &Daemon, servant: &str, words: &str) -> Verdict {
    support::wait_until(&format!("the end of {words}"), || {
        let left = pids_with(daemon, servant, words)?;
        Ok(if left.is_empty() { Ok(()) } else { Err(format!("{left:?}")) })
    })
}

/// Returns what runs programs of Python with the packages of this ROS, and prints this.
fn asks_ros(ros: RosVersion) -> (&'static str, &'static str) {
    match ros {
        RosVersion::One => {
            ("import os, rosgraph; rosgraph.Master('/me').getPid(); print(os.environ['ROS_MASTER_URI'])", ":11311")
        }
        RosVersion::Two => {
            ("import os, rclpy; rclpy.init(); rclpy.create_node('me'); print(os.environ['ROS_DOMAIN_ID'])", "0")
        }
    }
}

pub fn a_program_runs_as_the_servants_nodes_do(ros: RosVersion) -> Verdict {
    let service = match ros {
        RosVersion::One => ADDER,
        RosVersion::Two => SEER,
    };
    let daemon = world().daemon_with(service)?;
    let (_robot, servant) = working_servant(&daemon, service.name, "", "entered")?;
    let deployer = daemon.deployer();
    let runs = |command: &[&str]| deployer.run(&[&["exec", &servant, "--"], command].concat());
    // Streams and exit statuses are told apart.
    let told = runs(&["sh", "-c", "id -u; pwd; echo complaint >&2; exit 7"])?;
    ensure!(told.status == 7 && told.stdout == "0\n/root\n" && told.stderr == "complaint\n", "{told:#?}");
    ensure!(runs(&["sh", "-c", "kill -TERM $$"])?.status == 128 + 15);
    ensure!(runs(&["no-such-program"])?.status == 127);
    // The ROS of its nodes is there.
    let (script, said) = asks_ros(ros);
    let told = runs(&["python3", "-c", script])?.expect_success()?;
    ensure!(told.stdout.contains(said), "{told:#?}");
    // It has the rights of a node, its limits and its namespaces.
    let fields = runs(&["cat", "/proc/self/status"])?.expect_success()?.stdout;
    let fields = procfs::fields(&fields);
    for (name, value) in [("Seccomp", "2"), ("NoNewPrivs", "1"), ("CapEff", "0000000000000000")] {
        ensure!(fields.get(name).is_some_and(|told| told == value), "{name}: {fields:#?}");
    }
    let mut sleeper = ExecProcess::start_command(&daemon, &servant, &["sh", "-c", "echo up; exec sleep 4711"])?;
    sleeper.hears("up")?;
    let pid = *support::wait_until("the program among the servant's processes", || {
        let pids = pids_with(&daemon, &servant, "sleep 4711")?;
        Ok(if pids.len() == 1 { Ok(pids) } else { Err(format!("{pids:?}")) })
    })?
    .first()
    .context("one")?;
    let told = daemon.api(&format!("/api/v1/servants/{servant}"))?;
    let pids = told["pids"].as_array().context("pids")?.iter().filter_map(|pid| Some(pid.as_i64()? as i32));
    let is_node = |pid: &i32| procfs::command_line(*pid).is_some_and(|line| line.contains(service.name));
    let node = pids.filter(is_node).find(|node| procfs::is_running(*node)).context("a node")?;
    ensure!(procfs::cgroups(pid) == procfs::cgroups(node), "{:?}", procfs::cgroups(pid));
    for kind in ["user", "mnt", "pid", "net", "ipc", "uts", "cgroup"] {
        ensure!(procfs::namespace(pid, kind) == procfs::namespace(node, kind), "another {kind} namespace");
    }
    // When its connection breaks, it is killed.
    sleeper.child.kill()?;
    sleeper.wait()?;
    wait_until_gone(&daemon, &servant, "sleep 4711")?;
    // Standard input is passed on to its end, and what is left behind is killed.
    let script = "(setsid sleep 4712 &); cat; echo end";
    let mut reader = ExecProcess::start_command(&daemon, &servant, &["sh", "-c", script])?;
    reader.types("typed\n")?;
    drop(reader.input.take());
    reader.hears("typed\nend\n")?;
    let status = reader.wait()?;
    ensure!(status.success(), "{status}");
    wait_until_gone(&daemon, &servant, "sleep 4712")
}

pub fn a_shell_at_a_terminal_has_one() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    let (_robot, servant) = working_servant(&daemon, "adder_py", "", "typed")?;
    // `script` of bsdutils gives it a terminal and returns its exit status.
    let typed = format!("stty cols 97 rows 31; exec {} exec {servant}", binaries::path("cloudroidctl").display());
    let mut command = Command::new("script");
    command.args(["-qec", &typed, "/dev/null"]);
    command.env("CLOUDROID_HOME", daemon.deployer().home).env_remove("CLOUDROID_SERVER").env("TERM", "xterm");
    let mut shell = ExecProcess::start(&mut command)?;
    // The echo of what is typed has the sum not yet.
    shell.types("stty size; test -t 0 && echo $TERM $((40 + 2))\n")?;
    shell.hears("31 97")?;
    shell.hears("xterm 42")?;
    // Ctrl-C interrupts what runs there, and not the session.
    shell.types("echo beg''in; sleep 4713\n")?;
    shell.hears("begin")?;
    shell.types("\u{3}")?;
    wait_until_gone(&daemon, &servant, "sleep 4713")?;
    shell.types("echo interrupted $?; exit 3\n")?;
    shell.hears("interrupted 130")?;
    let status = shell.wait()?;
    ensure!(status.code() == Some(3), "{status}");
    Ok(())
}

/// Waits for a record of the audit log.
fn wait_for_record(daemon: &Daemon, who: &str, did: &str, object: &str, status: u16) -> Verdict {
    support::wait_until(&format!("a record that {who} {did} {object}"), || {
        let log = daemon.deployer().run(&["--format", "json", "audit", "-n", "1000"])?.expect_success()?.stdout;
        let found = log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok()).any(|record| {
            let has = |key: &str, words: &str| record[key].as_str().is_some_and(|text| text.contains(words));
            has("who", who) && record["did"] == did && has("object", object) && record["status"] == status
        });
        Ok(found.then_some(()).ok_or(log))
    })
}

pub fn who_may_not_is_refused_and_who_may_no_longer_is_ended() -> Verdict {
    let setup = world().setup("exec");
    let daemon = setup.start()?;
    let scope = ["--service", "adder*"];
    let token = |arguments: &[&str]| create_token(&daemon, &[arguments, &scope[..]].concat());
    let alice = token(&["alice", "--role", "deployer"])?;
    let bob = token(&["bob", "--role", "deployer"])?;
    let eve = token(&["eve", "--role", "viewer"])?;
    let rover = token(&["rover", "--role", "robot", "--robot", "r1"])?;
    push_adder(&daemon, &alice, &[])?.expect_success()?;
    let (_robot, servant) = working_servant(&daemon, "adder_py", &format!("&token={rover}"), "r1")?;
    let runs = |token: &str| run_with_token(&daemon, token, &["exec", &servant, "--", "echo", "here"]);
    // A viewer may not, nor a robot, nor the deployer of another service.
    for token in [&eve, &rover, &bob] {
        let refused = runs(token)?.expect_failure(&["may not run programs in"])?;
        ensure!(refused.status == 4 && !refused.stdout.contains("here"), "{refused:#?}");
    }
    wait_for_record(&daemon, "eve (viewer)", "start a program", &servant, 403)?;
    let told = runs(&alice)?.expect_success()?;
    ensure!(told.stdout == "here\n", "{told:#?}");
    let object = format!("servant {servant} of robot r1 at service adder_py: echo here");
    wait_for_record(&daemon, "alice (deployer)", "start a program", &object, 101)?;
    wait_for_record(&daemon, "alice (deployer)", "end of a program", &format!("{object}: exit status 0"), 200)?;
    // Who leaves before the program has started is recorded all the same; who leaves before the answer started none.
    let hasty = format!(
        "GET /api/v1/servants/{servant}/exec?argument=sleep&argument=4716 HTTP/1.1\r\nHost: {address}\r\n\
            Authorization: Bearer {alice}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
            Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
            Sec-WebSocket-Protocol: exec.v1.cloudroid\r\n\r\n",
        address = daemon.address
    );
    let mut leaver = TcpStream::connect(&daemon.address)?;
    leaver.write_all(hasty.as_bytes())?;
    let mut status = [0; 12];
    leaver.read_exact(&mut status)?;
    ensure!(status == *b"HTTP/1.1 101", "{}", String::from_utf8_lossy(&status));
    drop(leaver);
    let words = "sleep 4716: killed: the connection ended";
    wait_for_record(&daemon, "alice (deployer)", "end of a program", words, 200)?;
    wait_until_gone(&daemon, &servant, "sleep 4716")?;
    // Nobody has more than so many, and the policy can take it away from a running one.
    let server = format!("http://{}", daemon.address);
    let mut sleepers = Vec::new();
    for _ in 0..4 {
        let mut command = ctl(&daemon);
        command.args(["--server", &server, "--token", &alice, "exec", &servant, "--"]);
        let mut sleeper = ExecProcess::start(command.args(["sh", "-c", "echo up; exec sleep 4714"]))?;
        sleeper.hears("up")?;
        sleepers.push(sleeper);
    }
    let refused = runs(&alice)?.expect_failure(&["alice runs 4 programs in servants already"])?;
    ensure!(refused.status == 7, "{refused:#?}");
    daemon.deployer().run(&["policy", "allow", "alice", "subscribe:/**"])?.expect_success()?;
    for sleeper in sleepers {
        let status = sleeper.wait()?;
        ensure!(!status.success(), "{status}");
    }
    wait_until_gone(&daemon, &servant, "sleep 4714")?;
    wait_for_record(&daemon, "alice (deployer)", "end of a program", "killed: this needs all of adder_py", 200)?;
    runs(&alice)?.expect_failure(&["needs all of adder_py"])?;
    // It ends with its servant.
    let deployer = daemon.deployer();
    let mut shell = ExecProcess::start_command(&daemon, &servant, &["sh", "-c", "echo up; exec sleep 4715"])?;
    shell.hears("up")?;
    deployer.run(&["stop", &servant])?.expect_success()?;
    let status = shell.wait()?;
    ensure!(!status.success(), "{status}");
    wait_for_record(&daemon, "root (admin)", "end of a program", "sleep 4715", 200)?;
    // An operator can switch it off for all.
    daemon.stop()?;
    let daemon = setup.config("[portal]\nexec = false\n").start()?;
    let (_robot, servant) = working_servant(&daemon, "adder_py", &format!("&token={rover}"), "r1")?;
    let refused = daemon.deployer().run(&["exec", &servant, "--", "true"])?;
    refused.expect_failure(&["no programs can be run in servants here", "[portal]"])?;
    Ok(())
}

pub fn a_program_ends_with_a_daemon_that_is_killed() -> Verdict {
    let setup = world().setup("exec-killed").config("keep_servants = true\n");
    let first = setup.start()?;
    first.deployer().push("adder_py", &["--node", "adder.py"])?.expect_success()?;
    let (_robot, servant) = working_servant(&first, "adder_py", "", "r1")?;
    let script = "(setsid sleep 4718 &); echo up; exec sleep 4718";
    let mut sleeper = ExecProcess::start_command(&first, &servant, &["sh", "-c", script])?;
    sleeper.hears("up")?;
    let pids = support::wait_until("both programs", || {
        let pids = pids_with(&first, &servant, "sleep 4718")?;
        Ok(if pids.len() == 2 { Ok(pids) } else { Err(format!("{pids:?}")) })
    })?;
    first.kill()?;
    let status = sleeper.wait()?;
    ensure!(!status.success(), "{status}");
    support::wait_until("the end of the programs", || {
        let left: Vec<&i32> = pids.iter().filter(|pid| procfs::is_running(**pid)).collect();
        Ok(if left.is_empty() { Ok(()) } else { Err(format!("{left:?} run")) })
    })?;
    // The servant has survived, and the next daemon runs programs in it.
    let second = setup.start()?;
    let (_robot, adopted) = working_servant(&second, "adder_py", "", "r1")?;
    ensure!(adopted == servant, "{adopted} instead of {servant}");
    let told = second.deployer().run(&["exec", &servant, "--", "echo", "here"])?.expect_success()?;
    ensure!(told.stdout == "here\n", "{told:#?}");
    expect_nothing_left(second)
}
