//! What goes wrong on a robot: each thing is named, with its reason and what to do.

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
use support::site::{Running, Site, string_of};
use support::twins::Twin;
use support::world::{TELLER, world};
use support::{Verdict, binaries, procfs};

/// The stub ends with status 1 and has said all of `words`.
fn refused(mut stub: Running, words: &[&str]) -> Verdict {
    let status = stub.ends()?;
    let said = stub.said();
    ensure!(status.code() == Some(1), "{status}: {said}");
    for word in words {
        ensure!(said.contains(word), "{word:?} was not said, but:\n{said}");
    }
    Ok(())
}

/// A package whose node latches what it says at its beginning, and how variants of it differ.
struct Variants {
    package: &'static str,
    /// The service that they are pushed as.
    service: &'static str,
    executable: &'static str,
    /// The node's text, and where it says it.
    file: &'static str,
    topic: &'static str,
    /// One parameter more.
    another_parameter: &'static [(&'static str, &'static str)],
    /// The topic has another type.
    another_type: &'static [(&'static str, &'static str)],
    /// The two types.
    types: [&'static str; 2],
}

impl Variants {
    fn of(ros: RosVersion) -> Self {
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

    /// Pushes the package with these changes of its node.
    fn pushes(&self, daemon: &Daemon, changes: &[(&str, &str)]) -> Verdict {
        let place = world().directory(self.package)?;
        let original = binaries::package(self.package);
        let copied = std::process::Command::new("cp")
            .arg("-rT")
            .args([&*original, place.path()])
            .status()?;
        ensure!(copied.success(), "{copied}");
        let file = place.path().join(self.file);
        let mut text = std::fs::read_to_string(&file)?;
        for (old, new) in changes {
            ensure!(text.contains(old), "{old:?} is not in {}", self.file);
            text = text.replace(old, new);
        }
        std::fs::write(file, text)?;
        let words = [
            "push",
            path_str(place.path()),
            "--name",
            self.service,
            "--node",
            self.executable,
        ];
        daemon.deployer().types(&words)?.succeeded().map(drop)
    }
}

fn revision_of(daemon: &Daemon, robot: &str) -> anyhow::Result<u64> {
    let servants = daemon.deployer().asks(&["servants"])?;
    let all = servants.as_array().context("a list")?;
    let mut mine = all.iter().filter(|servant| servant["robot"] == robot);
    let revision = mine.find_map(|servant| servant["revision"].as_u64());
    revision.with_context(|| format!("{servants:#}"))
}

pub fn a_later_revision_is_gone_on_with_unless_its_interface_differs(ros: RosVersion) -> Verdict {
    let daemon = world().shared()?;
    let variants = Variants::of(ros);
    let service = variants.service;
    variants.pushes(&daemon, &[])?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = &*format!("mishap-revisions-{}", ros.number());
    let settings = format!("robot = \"{robot}\"\nlocal = \"none\"\n");
    let overlay = site.installs(&daemon, service, &settings)?;
    let start = || site.runs(&overlay, variants.package, variants.executable, &[]);
    let speaks = |stub: &Running| -> Verdict {
        let mut told = site.hears_latched(&app, variants.topic)?;
        let told = site.next(&mut told).with_context(|| stub.said())?;
        ensure!(told.wire_type.name == variants.types[0], "{told:?}");
        Ok(())
    };
    let stops = || -> Verdict {
        let words = ["stop", "--service", service];
        daemon.deployer().types(&words)?.succeeded().map(drop)
    };
    let first = start()?;
    speaks(&first)?;
    // Another parameter breaks nothing: whoever runs goes on, and whoever starts does so with the new revision.
    variants.pushes(&daemon, variants.another_parameter)?;
    speaks(&first)?;
    ensure!(revision_of(&daemon, robot)? == 1);
    drop(first);
    stops()?;
    let second = start()?;
    speaks(&second)?;
    ensure!(revision_of(&daemon, robot)? == 2);
    // Another type does.
    variants.pushes(&daemon, variants.another_type)?;
    speaks(&second)?;
    drop(second);
    stops()?;
    let [before, after] = variants.types;
    let differs = format!(
        "output topic {} was a {before} and is a {after}",
        variants.topic
    );
    refused(
        start()?,
        &[
            &format!("{service} is at revision 3, this robot's stub was made of revision 1"),
            &differs,
            &format!("install the stub again from /stubs/{service}.tar.gz"),
        ],
    )?;
    // Going back is the other way.
    let back = ["rollback", service, "2"];
    daemon.deployer().types(&back)?.succeeded()?;
    speaks(&start()?)
}

pub fn another_version_of_the_protocol_is_named() -> Verdict {
    let daemon = world().with(TELLER)?;
    // One of a stub that was installed before, and one that does not exist yet.
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
        ensure!(
            status == 400 && body.contains(&named) && body.contains("install the stub again"),
            "{status} {body}"
        );
    }
    Ok(())
}

pub fn a_wrong_token_is_named(ros: RosVersion) -> Verdict {
    let daemon = world()
        .own(&format!("mishap-token-{}", ros.number()))
        .config("tokens = [\"open sesame\"]\n[tls]\nserve = \"plain-text-beyond-loopback\"\n")
        .listen("0.0.0.0:0")
        .start()?;
    let port = daemon.address.rsplit(':').next().context("a port")?;
    let site = Site::of(ros)?;
    let stub = |token: &str| {
        let toml = format!(
            "server = \"ws://127.0.0.1:{port}\"\nservice = \"any\"\nrobot = \"mishap\"\nlocal = \"none\"\n{token}"
        );
        site.stub_with(&toml, "any", "node", &[])
    };
    refused(
        stub("token = \"wrong\"\n")?,
        &["401", "token", "install.sh --token"],
    )?;
    refused(stub("")?, &["401", "token", "install.sh --token"])?;
    // The right one gets further.
    refused(stub("token = \"open sesame\"\n")?, &["404", "any"])
}

/// Runs a program as if this machine had been booted another time: by that it is known to be another.
const ELSEWHERE: &str = r#"#!/bin/sh
exec unshare --mount --propagation private sh -ec '
  mount --bind "${0%/*}/boot_id" /proc/sys/kernel/random/boot_id
  exec "$@"' "$0" "$@"
"#;

pub fn two_robots_with_one_id_are_told(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let (service, package, executable) = twin.names();
    let daemon = world().with(twin.service)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = &*twin.robot("mishap-duplicates");
    let argv = twin.argv("greeter", &[("~name", "/who")]);
    let stub = twin.stub(&site, (&daemon.address, robot), "", &argv)?;
    let answers = || -> Verdict {
        let names = site.says(&app, "/who", false)?;
        site.connected(&*names, 1)?;
        let mut greetings = site.hears(&app, "/greeter/greeting")?;
        site.fed(&greetings, 1)?;
        names.publish(string_of(WireFormat::of(ros), "robot"));
        site.next(&mut greetings).map(drop)
    };
    answers().with_context(|| stub.said())?;
    // Another machine has another id, and a ROS system of its own.
    let place = world().directory("elsewhere")?;
    let elsewhere = place.path().join("run");
    std::fs::write(&elsewhere, ELSEWHERE)?;
    std::fs::set_permissions(&elsewhere, Permissions::from_mode(0o755))?;
    let boot = "01234567-89ab-4def-8123-456789abcdef\n";
    std::fs::write(place.path().join("boot_id"), boot)?;
    let other = Site::of(ros)?;
    let settings = format!("robot = \"{robot}\"\nlocal = \"none\"\n");
    let overlay = other.installs(&daemon, service, &settings)?;
    let start = |node: &str| {
        let argv = twin.argv(node, &[("~name", "/who")]);
        let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
        other.emulates(path_str(&elsewhere), &overlay, package, executable, &argv)
    };
    refused(
        start("greeter")?,
        &[
            ") is connected as this robot and runs /greeter; give one of them another id",
            "CLOUDROID_ROBOT",
        ],
    )?;
    answers().context("the first goes on")?;
    // Another node of the package would share the servant: both sides and the server say so.
    let neighbour = start("other")?;
    for stub in [&neighbour, &stub] {
        stub.says("two machines are connected as this robot: ")?;
        let said = stub.said();
        ensure!(
            said.contains(" runs /other") && said.contains("CLOUDROID_ROBOT"),
            "{said}"
        );
    }
    let path = format!("/api/v1/robots/{robot}/explain");
    daemon.awaits(&path, "an event of two robots", |told| {
        let mut events = told["events"].as_array()?.iter();
        let told = events.any(|event| event["kind"] == "duplicate-robot");
        told.then_some(())
    })
}

pub fn parameters_that_cannot_be_carried_are_named_and_the_others_arrive() -> Verdict {
    let daemon = world().with(TELLER)?;
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
    let outcome = machine.runs("bash", &script)?.succeeded()?;
    for words in [
        "word hello, number nan",
        ", key as bytes",
        "parameter /teller/big has a value that XML-RPC cannot carry",
        "parameter /odd/big has a value that XML-RPC cannot carry",
        "rosparam delete /odd/big",
        "then start this node again",
        "\n/teller\n",
    ] {
        ensure!(
            outcome.stdout.contains(words),
            "{words:?}: {}",
            outcome.said()
        );
    }
    Ok(())
}

pub fn a_missing_original_is_said_once_and_the_cloud_goes_on(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let (service, package, executable) = twin.names();
    let daemon = world().with(twin.service)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    // No answer is as quick, so each counts as late and the local original is wanted.
    let robot = twin.robot("mishap-missing");
    let settings = format!("robot = \"{robot}\"\ndesire = 0.000001\nmax = 0.000002\n");
    let overlay = site.installs(&daemon, service, &settings)?;
    let argv = twin.argv("greeter", &[("~name", "/who")]);
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    let stub = site.runs(&overlay, package, executable, &argv)?;
    let names = site.says(&app, "/who", false)?;
    site.connected(&*names, 1).with_context(|| stub.said())?;
    let mut greetings = site.hears(&app, "/greeter/greeting")?;
    site.fed(&greetings, 1).with_context(|| stub.said())?;
    for number in 0..8 {
        let name = string_of(WireFormat::of(ros), &format!("robot {number}"));
        names.publish(name);
        site.next(&mut greetings).with_context(|| stub.said())?;
    }
    stub.says("there is no local original")?;
    let said = stub.said();
    let times = said.matches("there is no local original").count();
    ensure!(times == 1, "{times} times: {said}");
    Ok(())
}

/// A greeter and its original as they are installed on a robot, with these variables in their environment.
fn installed(
    site: &Site,
    daemon: &Daemon,
    twin: &Twin,
    settings: &str,
    variables: &[(&str, &str)],
) -> anyhow::Result<Running> {
    let (service, package, executable) = twin.names();
    let overlay = site.installs(daemon, service, settings)?;
    let program = twin.program();
    let workspace = site.installs_original(daemon, service, (package, executable), &program)?;
    let prefixes = format!("{}:{}", overlay.display(), workspace.display());
    let workspaces = match twin.ros {
        RosVersion::One => "CMAKE_PREFIX_PATH",
        RosVersion::Two => "AMENT_PREFIX_PATH",
    };
    let variables = [
        &[(workspaces, prefixes.as_str()), ("NO_COLOR", "1")],
        variables,
    ]
    .concat();
    let argv = twin.argv("greeter", &[("~name", "/who")]);
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    site.runs_among(&variables, &overlay, package, executable, &argv)
}

/// Names somebody until a greeter of whichever side answers.
fn is_greeted(site: &Site, app: &Arc<dyn Bus>, stub: &Running) -> Verdict {
    let names = site.says(app, "/who", false)?;
    let mut greetings = site.hears(app, "/greeter/greeting")?;
    let mut number = 0;
    let ask = || {
        number += 1;
        let name = format!("robot {number}");
        names.publish(string_of(WireFormat::of(site.system.version()), &name));
        Ok(())
    };
    let greeted = site.asks_until(&mut greetings, ask, |_| Ok(true));
    greeted.map(drop).with_context(|| stub.said())
}

/// The original that a stub has started, once it is more than the shell that starts it.
fn original_of(stub: &Running, program: &str) -> Option<i32> {
    let path = format!("/proc/{0}/task/{0}/children", stub.pid());
    let children = std::fs::read_to_string(path).ok()?;
    let mut children = children
        .split_whitespace()
        .filter_map(|pid| pid.parse().ok());
    children.find(|pid| {
        let line = procfs::command_line(*pid).unwrap_or_default();
        // An interpreter may stand before it.
        line.split(' ').take(2).any(|word| word == program)
    })
}

pub fn an_original_that_crashes_is_told_and_started_again(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let daemon = world().with(twin.service)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = twin.robot("mishap-crash-here");
    let settings = format!("robot = \"{robot}\"\nlocal = \"warm\"\ndesire = 60.0\nmax = 60.0\n");
    let stub = installed(&site, &daemon, &twin, &settings, &[])?;
    is_greeted(&site, &app, &stub)?;
    let program = twin.program();
    let runs = |but: i32| {
        support::until("an original", || {
            let runs = original_of(&stub, &program).filter(|pid| *pid != but);
            Ok(runs.ok_or_else(|| stub.said()))
        })
    };
    let first = runs(0)?;
    kill(Pid::from_raw(first), Signal::SIGKILL)?;
    let second = runs(first)?;
    let said = stub.said();
    ensure!(
        said.matches("the local original ended").count() == 1 && said.contains("signal: 9"),
        "{said}"
    );
    is_greeted(&site, &app, &stub)?;
    // It ends with a stub that is killed.
    stub.signal(Signal::SIGKILL)?;
    support::until("its end", || {
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
    let daemon = world().with(TELLER)?;
    let machine = Machine::with_stub(&daemon, "teller_py")?;
    machine.has_teller()?;
    let script = CRASH.replace("PORT", &free_port()?.to_string());
    let outcome = machine.runs("bash", &script)?.succeeded()?;
    for words in [
        "life 1 of /front/teller",
        "same group: yes",
        "namespace: ROS_NAMESPACE=/front/",
        "a Master of its own\n/front/teller\nanother",
        "another runs\nit ends with a stub that is killed\nnone is left\n",
        "signal: 9",
        // That it ends with the launch is none.
        "crashes: 1\n",
    ] {
        ensure!(
            outcome.stdout.contains(words),
            "{words:?}: {}",
            outcome.said()
        );
    }
    Ok(())
}

pub fn a_service_that_is_gone_leaves_the_local_original(ros: RosVersion) -> Verdict {
    let twin = Twin::greeter(ros);
    let daemon = world().with(twin.service)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let settings = format!("robot = \"{}\"\n", twin.robot("mishap-gone"));
    let gone = [("CLOUDROID_SERVICE", "nobody")];
    let stub = installed(&site, &daemon, &twin, &settings, &gone)?;
    stub.says("running the local original instead")?;
    ensure!(stub.said().contains("nobody"), "{}", stub.said());
    is_greeted(&site, &app, &stub)?;
    // What was the stub is the original now.
    let line = procfs::command_line(i32::try_from(stub.pid())?);
    let line = line.context("it runs")?;
    ensure!(line.contains(&twin.program()), "{line}");
    Ok(())
}
