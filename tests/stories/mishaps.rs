//! What goes wrong on a robot: each thing is named, with its reason and what to do.

use anyhow::{Context, ensure};
use support::Verdict;
use support::binaries;
use support::daemon::Daemon;
use support::deployer::path_str;
use support::machine::{Machine, free_port};
use support::site::{Running, Site, string};
use support::world::{GREETER, TELLER, world};

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

/// Pushes a variant of the teller as service `teller_rev`.
fn pushes(daemon: &Daemon, changes: &[(&str, &str)]) -> Verdict {
    let place = world().directory("teller")?;
    let original = binaries::package("teller_py");
    for name in ["package.xml", "CMakeLists.txt"] {
        std::fs::copy(original.join(name), place.path().join(name))?;
    }
    let mut text = std::fs::read_to_string(original.join("scripts/teller.py"))?;
    for (old, new) in changes {
        ensure!(text.contains(old), "{old:?} is not in teller.py");
        text = text.replace(old, new);
    }
    std::fs::create_dir(place.path().join("scripts"))?;
    std::fs::write(place.path().join("scripts/teller.py"), text)?;
    let words = [
        "push",
        path_str(place.path()),
        "--name",
        "teller_rev",
        "--node",
        "teller.py",
    ];
    daemon.deployer().types(&words)?.succeeded().map(drop)
}

fn revision_of(daemon: &Daemon, robot: &str) -> anyhow::Result<u64> {
    let servants = daemon.deployer().asks(&["servants"])?;
    let all = servants.as_array().context("a list")?;
    let mut mine = all.iter().filter(|servant| servant["robot"] == robot);
    let revision = mine.find_map(|servant| servant["revision"].as_u64());
    revision.with_context(|| format!("{servants:#}"))
}

pub fn a_later_revision_is_gone_on_with_unless_its_interface_differs() -> Verdict {
    let daemon = world().shared()?;
    pushes(&daemon, &[])?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let robot = "mishap-revisions";
    let settings = format!("robot = \"{robot}\"\nlocal = \"none\"\n");
    let overlay = site.installs(&daemon, "teller_rev", &settings)?;
    let start = || site.runs(&overlay, "teller_py", "teller.py", &[]);
    let speaks = |stub: &Running| -> Verdict {
        let mut told = site.hears(&app, "/teller/told")?;
        let told = site.next(&mut told).context(stub.said())?;
        ensure!(told.wire_type.name == "std_msgs/String");
        Ok(())
    };
    let first = start()?;
    speaks(&first)?;
    // Another parameter breaks nothing: whoever runs goes on, and whoever starts does so with the new revision.
    pushes(
        &daemon,
        &[("\ntold = ", "\nrospy.get_param(\"~more\", 1)\ntold = ")],
    )?;
    speaks(&first)?;
    ensure!(revision_of(&daemon, robot)? == 1);
    drop(first);
    daemon
        .deployer()
        .types(&["stop", "--service", "teller_rev"])?
        .succeeded()?;
    let second = start()?;
    speaks(&second)?;
    ensure!(revision_of(&daemon, robot)? == 2);
    // Another type does.
    pushes(
        &daemon,
        &[
            ("told\", String", "told\", Int32"),
            ("    \"life", "    len(\"life"),
            ("    )\n)", "    ))\n)"),
        ],
    )?;
    speaks(&second)?;
    drop(second);
    daemon
        .deployer()
        .types(&["stop", "--service", "teller_rev"])?
        .succeeded()?;
    refused(
        start()?,
        &[
            "teller_rev is at revision 3, this robot's stub was made of revision 1",
            "output topic /teller/told was a std_msgs/String and is a std_msgs/Int32",
            "install the stub again from /stubs/teller_rev.tar.gz",
        ],
    )?;
    // Going back is the other way.
    daemon
        .deployer()
        .types(&["rollback", "teller_rev", "2"])?
        .succeeded()?;
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

pub fn a_wrong_token_is_named() -> Verdict {
    let daemon = world()
        .own("mishap-token")
        .config("tokens = [\"open sesame\"]\n[tls]\nserve = \"plain-text-beyond-loopback\"\n")
        .listen("0.0.0.0:0")
        .start()?;
    let port = daemon.address.rsplit(':').next().context("a port")?;
    let site = Site::new()?;
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

pub fn two_robots_with_one_id_are_told() -> Verdict {
    let daemon = world().with(TELLER)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let robot = "mishap-duplicates";
    let of = ("teller_py", "teller_py", "teller.py");
    let stub = site.stub(&daemon, of, robot, &[])?;
    site.until(&app, "the node", |graph| {
        graph.topics.contains_key("/teller/told")
    })
    .with_context(|| stub.said())?;
    // Another machine has another id, and a Master of its own.
    let machine = Machine::with_stub(&daemon, "teller_py")?;
    let port = free_port()?;
    let script = format!(
        r#"set -e
echo 0123456789abcdef0123456789abcdef > /etc/machine-id
sh teller_py-stub/install.sh --robot {robot}
. /opt/cloudroid/setup.sh
export ROS_MASTER_URI=http://localhost:{port} CLOUDROID_LOCAL=none
rosmaster --core -p {port} > /dev/null 2>&1 &
exec timeout 60 rosrun teller_py teller.py"#
    );
    machine.runs("bash", &script)?.failed_saying(&[
        ") is connected as this robot and runs /teller; give one of them another id",
        "CLOUDROID_ROBOT",
    ])?;
    let mut told = site.hears(&app, "/teller/told")?;
    site.next(&mut told).context("the first goes on")?;
    // Another node of the package would share the servant: both sides and the server say so.
    let script = script
        .replace("exec timeout 60 rosrun teller_py teller.py", "rosrun teller_py teller.py __name:=other > said 2>&1 & node=$!\nuntil grep 'two machines' said; do kill -0 $node; sleep 0.1; done\nkill -INT $node; wait $node || true");
    let outcome = machine.runs("bash", &script)?.succeeded()?;
    for said in [outcome.stdout, stub.said()] {
        ensure!(
            said.contains("two machines are connected as this robot: ")
                && said.contains(" runs /other")
                && said.contains("CLOUDROID_ROBOT"),
            "{said}"
        );
    }
    let told = daemon.deployer().asks(&["explain", robot])?;
    let events = told["events"].as_array().context("events")?;
    ensure!(
        events
            .iter()
            .any(|event| event["kind"] == "duplicate-robot"),
        "{told:#}"
    );
    Ok(())
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
timeout 60 rostopic echo -n 1 -p /teller/told
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

pub fn a_missing_original_is_said_once_and_the_cloud_goes_on() -> Verdict {
    let daemon = world().with(GREETER)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    // No answer is as quick, so each counts as late and the local original is wanted.
    let settings = "robot = \"mishap-missing\"\ndesire = 0.000001\nmax = 0.000002\n";
    let overlay = site.installs(&daemon, "greeter_cpp", settings)?;
    let stub = site.runs(&overlay, "greeter_cpp", "greeter", &["~name:=/who"])?;
    let names = site.says(&app, "/who", false)?;
    site.connected(&*names, 1).with_context(|| stub.said())?;
    let mut greetings = site.hears(&app, "/greeter/greeting")?;
    for number in 0..8 {
        names.publish(string(&format!("robot {number}")));
        site.next(&mut greetings).with_context(|| stub.said())?;
    }
    let said = stub.said();
    let times = said.matches("there is no local original").count();
    ensure!(times == 1, "{times} times: {said}");
    Ok(())
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
timeout 60 rostopic echo -n 1 -p /front/teller/told
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
timeout 60 sh -c 'while pgrep -f "[p]ython3 /usr/lib/teller_py" > /dev/null; do sleep 0.1; done'
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

pub fn a_service_that_is_gone_leaves_the_local_original() -> Verdict {
    let daemon = world().with(TELLER)?;
    let machine = Machine::with_stub(&daemon, "teller_py")?;
    machine.has_teller()?;
    let script = format!(
        r#"set -e
sh teller_py-stub/install.sh --robot mishap-gone > /dev/null
sed -i 's/^service = .*/service = "nobody"/' /opt/cloudroid/share/teller_py/stub.toml
. /opt/cloudroid/setup.sh
export ROS_MASTER_URI=http://localhost:{port}
rosmaster --core -p {port} > /dev/null 2>&1 & master=$!
until rosparam list > /dev/null 2>&1; do kill -0 $master; sleep 0.1; done
rosrun teller_py teller.py > said 2>&1 &
timeout 60 rostopic echo -n 1 -p /teller/told; cat said"#,
        port = free_port()?
    );
    let outcome = machine.runs("bash", &script)?.succeeded()?;
    for words in [
        "nobody",
        "running the local original instead",
        "life 1 of /teller",
    ] {
        ensure!(
            outcome.stdout.contains(words),
            "{words:?}: {}",
            outcome.said()
        );
    }
    Ok(())
}
