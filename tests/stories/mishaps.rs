//! Failures on a robot: each is reported with its reason and a remedy.

use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::sync::Arc;

use anyhow::{Context, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use ros::bus::{Bus, RosVersion, WireFormat};
use support::daemon::Daemon;
use support::deployer::path_str;
use support::machine::{Machine, free_port};
use support::site::{NodeProcess, Site, string_in};
use support::twins::Twin;
use support::world::{TELLER, world};
use support::{Verdict, binaries, procfs};

/// Checks that the stub exits with status 1 and has printed all of `words`.
fn expect_refused(mut stub: NodeProcess, words: &[&str]) -> Verdict {
    let status = stub.wait_for_exit()?;
    let said = stub.output();
    ensure!(status.code() == Some(1), "{status}: {said}");
    for word in words {
        ensure!(said.contains(word), "{word:?} was not said, but:\n{said}");
    }
    Ok(())
}

/// A package whose node latches a message at startup, and changes that create variants of it.
struct PackageVariants {
    package: &'static str,
    /// Service as which they are pushed.
    service: &'static str,
    executable: &'static str,
    /// Source of the node, and the topic of the message.
    file: &'static str,
    topic: &'static str,
    /// A change that adds a parameter.
    another_parameter: &'static [(&'static str, &'static str)],
    /// A change of the topic's type.
    another_type: &'static [(&'static str, &'static str)],
    /// The two types.
    types: [&'static str; 2],
}

impl PackageVariants {
    fn for_ros(ros: RosVersion) -> Self {
        match ros {
            RosVersion::One => Self {
                package: "teller_py",
                service: "teller_rev",
                executable: "teller.py",
                file: "scripts/teller.py",
                topic: "/teller/told",
                another_parameter: &[("\ntold = ", "\nrospy.get_param(\"~more\", 1)\ntold = ")],
                another_type: &[
                    ("told\", String", "told\", Int32"),
                    ("    \"life", "    len(\"life"),
                    ("    )\n)", "    ))\n)"),
                ],
                types: ["std_msgs/String", "std_msgs/Int32"],
            },
            RosVersion::Two => Self {
                package: "courier_ros2",
                service: "courier_rev",
                executable: "courier",
                file: "courier_ros2/node.py",
                topic: "/home",
                another_parameter: &[(
                    "        self.route = None",
                    "        self.declare_parameter(\"more\", 1)\n        self.route = None",
                )],
                another_type: &[
                    ("import String", "import Int32, String"),
                    ("(String, \"home\"", "(Int32, \"home\""),
                    ("String(data=\"in the clouds\")", "Int32(data=1)"),
                ],
                types: ["std_msgs/msg/String", "std_msgs/msg/Int32"],
            },
        }
    }

    /// Pushes the package with these changes of its source.
    fn push(&self, daemon: &Daemon, changes: &[(&str, &str)]) -> Verdict {
        let place = world().directory(self.package)?;
        let original = binaries::package(self.package);
        let copied = std::process::Command::new("cp").arg("-rT").args([&*original, place.path()]).status()?;
        ensure!(copied.success(), "{copied}");
        let file = place.path().join(self.file);
        let mut text = std::fs::read_to_string(&file)?;
        for (old, new) in changes {
            ensure!(text.contains(old), "{old:?} is not in {}", self.file);
            text = text.replace(old, new);
        }
        std::fs::write(file, text)?;
        let words = ["push", path_str(place.path()), "--name", self.service, "--node", self.executable];
        daemon.deployer().run(&words)?.expect_success().map(drop)
    }
}

fn servant_revision(daemon: &Daemon, robot: &str) -> anyhow::Result<u64> {
    let servants = daemon.deployer().run_json(&["servants"])?;
    let all = servants.as_array().context("a list")?;
    let mut mine = all.iter().filter(|servant| servant["robot"] == robot);
    let revision = mine.find_map(|servant| servant["revision"].as_u64());
    revision.with_context(|| format!("{servants:#}"))
}

pub fn a_later_revision_is_gone_on_with_unless_its_interface_differs(ros: RosVersion) -> Verdict {
    let daemon = world().ensure_shared()?;
    let variants = PackageVariants::for_ros(ros);
    let service = variants.service;
    variants.push(&daemon, &[])?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = &*format!("mishap-revisions-{}", ros.number());
    let settings = format!("robot = \"{robot}\"\nlocal = \"none\"\n");
    let overlay = site.install_stub(&daemon, service, &settings)?;
    let start = || site.start_installed(&overlay, variants.package, variants.executable, &[]);
    let speaks = |stub: &NodeProcess| -> Verdict {
        let mut told = site.subscribe_latched(&app, variants.topic)?;
        let told = site.next_message(&mut told).with_context(|| stub.output())?;
        ensure!(told.wire_type.name == variants.types[0], "{told:?}");
        Ok(())
    };
    let stops = || -> Verdict {
        let words = ["stop", "--service", service];
        daemon.deployer().run(&words)?.expect_success().map(drop)
    };
    let first = start()?;
    speaks(&first)?;
    // A further parameter is compatible: running stubs continue, and new ones use the new revision.
    variants.push(&daemon, variants.another_parameter)?;
    speaks(&first)?;
    ensure!(servant_revision(&daemon, robot)? == 1);
    drop(first);
    stops()?;
    let second = start()?;
    speaks(&second)?;
    ensure!(servant_revision(&daemon, robot)? == 2);
    // Another type is incompatible.
    variants.push(&daemon, variants.another_type)?;
    speaks(&second)?;
    drop(second);
    stops()?;
    let [before, after] = variants.types;
    let differs = format!("output topic {} was a {before} and is a {after}", variants.topic);
    expect_refused(
        start()?,
        &[
            &format!("{service} is at revision 3, but this robot's stub was made from revision 1"),
            &differs,
            &format!("install the stub again from /stubs/{service}.tar.gz"),
        ],
    )?;
    // A rollback is the other remedy.
    let back = ["rollback", service, "2"];
    daemon.deployer().run(&back)?.expect_success()?;
    speaks(&start()?)
}

pub fn another_version_of_the_protocol_is_named() -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    // A stub that was installed earlier, and one from the future.
    for version in ["cloudroid-link.v1", "cloudroid-link.v9"] {
        let (status, body) = daemon.request(
            "GET",
            "/teller_py?robot=mishap-version",
            &[
                ("Connection", "close, Upgrade"),
                ("Upgrade", "websocket"),
                ("Sec-WebSocket-Version", "13"),
                ("Sec-WebSocket-Key", "dGhlIHNhbXBsZSBub25jZQ=="),
                ("Sec-WebSocket-Protocol", version),
            ],
        )?;
        let named = format!("the stub speaks {version}, this server cloudroid-link.v2");
        ensure!(status == 400 && body.contains(&named) && body.contains("install the stub again"), "{status} {body}");
    }
    Ok(())
}

pub fn a_wrong_token_is_named(ros: RosVersion) -> Verdict {
    let daemon = world()
        .setup(&format!("mishap-token-{}", ros.number()))
        .config("tokens = [\"open sesame\"]\n[tls]\nserve = \"plain-text-beyond-loopback\"\n")
        .listen("0.0.0.0:0")
        .start()?;
    let port = daemon.address.rsplit(':').next().context("a port")?;
    let site = Site::with_ros(ros)?;
    let stub = |token: &str| {
        let toml = format!(
            "server = \"ws://127.0.0.1:{port}\"\nservice = \"any\"\nrobot = \"mishap\"\nlocal = \"none\"\n{token}"
        );
        site.start_stub_with_config(&toml, "any", "node", &[])
    };
    expect_refused(stub("token = \"wrong\"\n")?, &["401", "token", "install.sh --token"])?;
    expect_refused(stub("")?, &["401", "token", "install.sh --token"])?;
    // With the right token it gets further.
    expect_refused(stub("token = \"open sesame\"\n")?, &["404", "any"])
}

/// Runs a program as on another machine, which is identified by its boot id.
const ELSEWHERE: &str = r#"#!/bin/sh
exec unshare --mount --propagation private sh -ec '
  mount --bind "${0%/*}/boot_id" /proc/sys/kernel/random/boot_id
  exec "$@"' "$0" "$@"
"#;

pub fn two_robots_with_one_id_are_told(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let (service, package, executable) = twin.names();
    let daemon = world().daemon_with(twin.service)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = &*twin.robot_name("mishap-duplicates");
    let argv = twin.argv("greeter", &[("~name", "/who")]);
    let stub = twin.stub(&site, (&daemon.address, robot), "", &argv)?;
    let answers = || -> Verdict {
        let names = site.advertise_strings(&app, "/who", false)?;
        site.wait_for_subscribers(&*names, 1)?;
        let mut greetings = site.subscribe(&app, "/greeter/greeting")?;
        site.wait_for_publishers(&greetings, 1)?;
        names.publish(string_in(WireFormat::for_version(ros), "robot"));
        site.next_message(&mut greetings).map(drop)
    };
    answers().with_context(|| stub.output())?;
    // Another machine has another id, and a ROS system of its own.
    let place = world().directory("elsewhere")?;
    let elsewhere = place.path().join("run");
    std::fs::write(&elsewhere, ELSEWHERE)?;
    std::fs::set_permissions(&elsewhere, Permissions::from_mode(0o755))?;
    let boot = "01234567-89ab-4def-8123-456789abcdef\n";
    std::fs::write(place.path().join("boot_id"), boot)?;
    let other = Site::with_ros(ros)?;
    let settings = format!("robot = \"{robot}\"\nlocal = \"none\"\n");
    let overlay = other.install_stub(&daemon, service, &settings)?;
    let start = |node: &str| {
        let argv = twin.argv(node, &[("~name", "/who")]);
        let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
        other.start_emulated(path_str(&elsewhere), &overlay, package, executable, &argv)
    };
    expect_refused(
        start("greeter")?,
        &[") is connected as this robot and runs /greeter; give one of them another id", "CLOUDROID_ROBOT"],
    )?;
    answers().context("the first goes on")?;
    // Another node of the package would share the servant: both sides and the server report it.
    let neighbour = start("other")?;
    for stub in [&neighbour, &stub] {
        stub.wait_for_output("two machines are connected as this robot: ")?;
        let said = stub.output();
        ensure!(said.contains(" runs /other") && said.contains("CLOUDROID_ROBOT"), "{said}");
    }
    let path = format!("/api/v1/robots/{robot}/explain");
    daemon.wait_for(&path, "an event of two robots", |told| {
        let mut events = told["events"].as_array()?.iter();
        let told = events.any(|event| event["kind"] == "duplicate-robot");
        told.then_some(())
    })
}

pub fn parameters_that_cannot_be_carried_are_named_and_the_others_arrive() -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    let machine = Machine::with_stub(&daemon, "teller_py")?;
    let port = free_port()?;
    let script = format!(
        r#"set -e
sh teller_py-stub/install.sh --robot mishap-parameters
. /opt/cloudroid/setup.sh
export ROS_MASTER_URI=http://localhost:{port} CLOUDROID_LOCAL=none
rosmaster --core -p {port} > /dev/null 2>&1 & master=$!
until rosparam list > /dev/null 2>&1; do kill -0 $master; sleep 0.1; done
rosparam set /teller/word hello
rosparam set /teller/number .nan
rosparam set /teller/far .inf
cat > poison.py << 'END'
import sys, xmlrpc.client
xmlrpc.client.Marshaller.dispatch[int] = lambda self, value, write: write("<value><i8>%d</i8></value>" % value)
for name in "/teller/big", "/odd/big":
    xmlrpc.client.ServerProxy(sys.argv[1]).setParam("/poison", name, 2 ** 40)
xmlrpc.client.ServerProxy(sys.argv[1]).setParam("/poison", "/teller/key", xmlrpc.client.Binary(b"as bytes"))
END
python3 poison.py $ROS_MASTER_URI
! rosparam get / > /dev/null 2>&1
rosrun teller_py teller.py > said 2>&1 & node=$!
timeout "$PATIENCE" rostopic echo -n 1 -p /teller/told
# The robot's Master starts again, and the node is there again.
kill -9 $master; wait $master || true
rosmaster --core -p {port} > /dev/null 2>&1 &
until rosnode list 2> /dev/null | grep /teller; do kill -0 $node; sleep 0.1; done
kill -INT $node; wait $node || true
cat said"#
    );
    let outcome = machine.run_script("bash", &script)?.expect_success()?;
    for words in [
        "word hello, number nan",
        ", key as bytes",
        "parameter /teller/big has a value that XML-RPC cannot represent",
        "parameter /odd/big has a value that XML-RPC cannot represent",
        "rosparam delete /odd/big",
        "then restart this node",
        "\n/teller\n",
    ] {
        ensure!(outcome.stdout.contains(words), "{words:?}: {}", outcome.output());
    }
    Ok(())
}

pub fn a_missing_original_is_said_once_and_the_cloud_goes_on(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let (service, package, executable) = twin.names();
    let daemon = world().daemon_with(twin.service)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    // No answer is fast enough, so each one counts as late and the local original is needed.
    let robot = twin.robot_name("mishap-missing");
    let settings = format!("robot = \"{robot}\"\ndesire = 0.000001\nmax = 0.000002\n");
    let overlay = site.install_stub(&daemon, service, &settings)?;
    let argv = twin.argv("greeter", &[("~name", "/who")]);
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    let stub = site.start_installed(&overlay, package, executable, &argv)?;
    let names = site.advertise_strings(&app, "/who", false)?;
    site.wait_for_subscribers(&*names, 1).with_context(|| stub.output())?;
    let mut greetings = site.subscribe(&app, "/greeter/greeting")?;
    site.wait_for_publishers(&greetings, 1).with_context(|| stub.output())?;
    for number in 0..8 {
        let name = string_in(WireFormat::for_version(ros), &format!("robot {number}"));
        names.publish(name);
        site.next_message(&mut greetings).with_context(|| stub.output())?;
    }
    stub.wait_for_output("there is no local original")?;
    let said = stub.output();
    let times = said.matches("there is no local original").count();
    ensure!(times == 1, "{times} times: {said}");
    Ok(())
}

/// Starts a greeter and its original, as installed on a robot, with these environment variables.
fn start_installed_greeter(
    site: &Site,
    daemon: &Daemon,
    twin: &Twin,
    settings: &str,
    variables: &[(&str, &str)],
) -> anyhow::Result<NodeProcess> {
    let (service, package, executable) = twin.names();
    let overlay = site.install_stub(daemon, service, settings)?;
    let program = twin.program();
    let workspace = site.install_original(daemon, service, (package, executable), &program)?;
    let prefixes = format!("{}:{}", overlay.display(), workspace.display());
    let workspaces = match twin.ros {
        RosVersion::One => "CMAKE_PREFIX_PATH",
        RosVersion::Two => "AMENT_PREFIX_PATH",
    };
    let variables = [&[(workspaces, prefixes.as_str()), ("NO_COLOR", "1")], variables].concat();
    let argv = twin.argv("greeter", &[("~name", "/who")]);
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    site.start_installed_with_environment(&variables, &overlay, package, executable, &argv)
}

/// Publishes names until a greeter on either side answers.
fn wait_until_greeted(site: &Site, app: &Arc<dyn Bus>, stub: &NodeProcess) -> Verdict {
    let names = site.advertise_strings(app, "/who", false)?;
    let mut greetings = site.subscribe(app, "/greeter/greeting")?;
    let mut number = 0;
    let ask = || {
        number += 1;
        let name = format!("robot {number}");
        names.publish(string_in(WireFormat::for_version(site.system.version()), &name));
        Ok(())
    };
    let greeted = site.ask_until(&mut greetings, ask, |_| Ok(true));
    greeted.map(drop).with_context(|| stub.output())
}

/// Returns the original that a stub has started, once its shell has executed it.
fn find_original(stub: &NodeProcess, program: &str) -> Option<i32> {
    let path = format!("/proc/{0}/task/{0}/children", stub.pid());
    let children = std::fs::read_to_string(path).ok()?;
    let mut children = children.split_whitespace().filter_map(|pid| pid.parse().ok());
    children.find(|pid| {
        let line = procfs::command_line(*pid).unwrap_or_default();
        // It may be preceded by an interpreter.
        line.split(' ').take(2).any(|word| word == program)
    })
}

pub fn an_original_that_crashes_is_told_and_started_again(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let daemon = world().daemon_with(twin.service)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = twin.robot_name("mishap-crash-here");
    let settings = format!("robot = \"{robot}\"\nlocal = \"warm\"\ndesire = 60.0\nmax = 60.0\n");
    let stub = start_installed_greeter(&site, &daemon, &twin, &settings, &[])?;
    wait_until_greeted(&site, &app, &stub)?;
    let program = twin.program();
    let runs = |but: i32| {
        support::wait_until("an original", || {
            let runs = find_original(&stub, &program).filter(|pid| *pid != but);
            Ok(runs.ok_or_else(|| stub.output()))
        })
    };
    let first = runs(0)?;
    kill(Pid::from_raw(first), Signal::SIGKILL)?;
    let second = runs(first)?;
    let said = stub.output();
    ensure!(said.matches("the local original ended").count() == 1 && said.contains("signal: 9"), "{said}");
    wait_until_greeted(&site, &app, &stub)?;
    // The original ends if its stub is killed.
    stub.signal(Signal::SIGKILL)?;
    support::wait_until("its end", || {
        let line = procfs::command_line(second).filter(|line| !line.is_empty());
        Ok(line.map_or(Ok(()), Err))
    })
}

/// With the original below /usr and `local = "warm"`; its process is killed, and later the whole launch is ended.
const CRASH: &str = r#"set -e -m
sh teller_py-stub/install.sh --robot mishap-crash > /dev/null
printf 'desire = 5\nmax = 10\nlocal = "warm"\n' >> /opt/cloudroid/share/teller_py/stub.toml
. /opt/cloudroid/setup.sh
export ROS_MASTER_URI=http://localhost:PORT
cat > /root/one.launch << 'END'
<launch><node pkg="teller_py" type="teller.py" name="teller" ns="/front" output="screen"/></launch>
END
roslaunch -p PORT /root/one.launch > log 2>&1 & launched=$!
original() { pgrep -f '[p]ython3 /usr/lib/teller_py'; }
until original > /dev/null; do kill -0 $launched; sleep 0.1; done
first=$(original)
timeout "$PATIENCE" rostopic echo -n 1 -p /front/teller/told
stub=$(pgrep -f '[c]loudroid-stub run')
echo "same group: $([ $(ps -o pgid= $first) = $(ps -o pgid= $stub) ] && echo yes)"
echo "namespace: $(tr '\0' '\n' < /proc/$first/environ | grep ^ROS_NAMESPACE)"
tr '\0' '\n' < /proc/$first/environ | grep -q "^ROS_MASTER_URI=$ROS_MASTER_URI" || echo "a Master of its own"
rosnode list | grep teller | grep -v _cloudroid # which tells diagnostics
kill -9 $first
until original | grep -qv "^$first$"; do kill -0 $stub; sleep 0.1; done
echo "another runs"
last=$(pgrep -f '[c]loudroid-stub run')
kill -9 $last
timeout "$PATIENCE" sh -c 'while pgrep -f "[p]ython3 /usr/lib/teller_py" > /dev/null; do sleep 0.1; done'
echo "it ends with a stub that is killed"
kill -INT $launched || true; wait $launched || true
pgrep -fa '[p]ython3 /usr/lib/teller_py|[c]loudroid-stub run' || echo "none is left"
grep 'the local original ended' log
echo "crashes: $(grep -c 'the local original ended' log)"
"#;

pub fn a_local_original_that_crashes_is_told_and_started_again() -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    let machine = Machine::with_stub(&daemon, "teller_py")?;
    machine.install_teller()?;
    let script = CRASH.replace("PORT", &free_port()?.to_string());
    let outcome = machine.run_script("bash", &script)?.expect_success()?;
    for words in [
        "life 1 of /front/teller",
        "same group: yes",
        "namespace: ROS_NAMESPACE=/front/",
        "a Master of its own\n/front/teller\nanother",
        "another runs\nit ends with a stub that is killed\nnone is left\n",
        "signal: 9",
        // Its end with the launch is not a crash.
        "crashes: 1\n",
    ] {
        ensure!(outcome.stdout.contains(words), "{words:?}: {}", outcome.output());
    }
    Ok(())
}

pub fn a_service_that_is_gone_leaves_the_local_original(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let daemon = world().daemon_with(twin.service)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let settings = format!("robot = \"{}\"\n", twin.robot_name("mishap-gone"));
    let gone = [("CLOUDROID_SERVICE", "nobody")];
    let stub = start_installed_greeter(&site, &daemon, &twin, &settings, &gone)?;
    stub.wait_for_output("running the local original instead")?;
    ensure!(stub.output().contains("nobody"), "{}", stub.output());
    wait_until_greeted(&site, &app, &stub)?;
    // The stub's process has become the original.
    let line = procfs::command_line(i32::try_from(stub.pid())?);
    let line = line.context("it runs")?;
    ensure!(line.contains(&twin.program()), "{line}");
    Ok(())
}
