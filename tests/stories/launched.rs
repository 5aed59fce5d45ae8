//! Launching as usual: the real roslaunch, with the original and with its stub.

use anyhow::{Context, ensure};
use support::Verdict;
use support::machine::{Machine, free_port};
use support::world::{TELLER, world};

/// Returns the beginning of every script: the Master's address, the overlay if it is to be used, and a subscription to
/// the node.
fn prelude(port: u16, setup: &str) -> String {
    format!(
        r#"set -u -m
{setup}
export ROS_MASTER_URI=http://localhost:{port}
launch() {{
  roslaunch -p {port} "$1" > "$1.log" 2>&1 &
  launched=$!
  until rosparam list > /dev/null 2>&1; do kill -0 $launched || {{ cat "$1.log"; exit 1; }}; sleep 0.1; done
  exec 3< <(exec timeout "$PATIENCE" rostopic echo -p /told 2> /dev/null)
}}
told() {{
  while read -r -t "$PATIENCE" -u 3 line; do
    case $line in *,life*) echo "${{line#*,}}"; return ;; esac
  done
  echo "nothing was told"; cat /root/*.log; exit 1
}}
# Until it is heard: of another life than the one that is meant a number ends nothing.
ends() {{ rostopic pub -r 2 /front/teller/end std_msgs/Int32 "$1" > /dev/null 2>&1 & saying=$!; }}
ended() {{ kill $saying 2> /dev/null; wait $saying 2> /dev/null; }}
"#
    )
}

const CONTRACT: &str = r#"
cat > /root/prefix << 'END'
#!/bin/sh
echo "the prefix runs ${1##*/}" >> /root/prefixed
exec "$@"
END
chmod +x /root/prefix
cat > /root/respawn.launch << 'END'
<launch>
  <group ns="front">
    <node pkg="teller_py" type="teller.py" name="teller" args="one 'two words' --three _number:=4" output="screen"
          respawn="true" launch-prefix="/root/prefix">
      <param name="word" value="hello"/>
      <param name="file" value="$(find teller_py)/package.xml"/>
      <param name="code" value="3"/>
      <remap from="~told" to="/told"/>
    </node>
  </group>
</launch>
END
cat > /root/required.launch << 'END'
<launch>
  <node pkg="teller_py" type="teller.py" name="teller" ns="/front" required="true" cwd="node">
    <remap from="~told" to="/told"/>
    <param name="code" value="5"/>
  </node>
  <node pkg="rosout" type="rosout" name="bystander"/>
</launch>
END

launch /root/respawn.launch
told
echo "rosnode kill"; rosnode kill /front/teller > /dev/null
told
echo "exit code 3"; ends 2
told
ended
echo "SIGINT to roslaunch"; kill -INT $launched
wait $launched; echo "roslaunch ended with $?"
grep -o 'has died.*exit code [0-9-]*' /root/respawn.launch.log | sed 's/pid [0-9]*/pid/'
echo "farewells: $(grep -c '^told to end' /root/respawn.launch.log)"
pgrep -fa '[l]ib/teller_py'
cat /root/prefixed; rm /root/prefixed

launch /root/required.launch
told
ends 1
wait $launched; echo "roslaunch ended with $?"
ended
grep -o 'REQUIRED process' /root/required.launch.log
grep -o 'has died.*exit code [0-9-]*' /root/required.launch.log | sed 's/pid [0-9]*/pid/' | sort -u
pgrep -fa '[l]ib/teller_py'
echo done
"#;

/// Output of the original.
const AS_EVER: &str = "\
life 1 of /front/teller in /front, directory ROS's, arguments ['one', 'two words', '--three'], word hello, number 4, \
file there
rosnode kill
life 2 of /front/teller in /front, directory ROS's, arguments ['one', 'two words', '--three'], word hello, number 4, \
file there
exit code 3
life 3 of /front/teller in /front, directory ROS's, arguments ['one', 'two words', '--three'], word hello, number 4, \
file there
SIGINT to roslaunch
roslaunch ended with 0
has died [pid, exit code 3
farewells: 2
the prefix runs teller.py
the prefix runs teller.py
the prefix runs teller.py
life 1 of /front/teller in /front, directory the program's, arguments [], word none, number none, file missing
roslaunch ended with 0
REQUIRED process
has died [pid, exit code 5
done
";

pub fn roslaunch_cannot_tell_the_stub_from_the_original() -> Verdict {
    for setup in ["", ". /opt/cloudroid/setup.sh"] {
        let machine = Machine::with_stub(&*world().daemon_with(TELLER)?, "teller_py")?;
        machine.install_teller()?;
        machine.run_script("sh", "sh teller_py-stub/install.sh --robot launched-contract")?.expect_success()?;
        let script = format!("{}{CONTRACT}", prelude(free_port()?, setup));
        let outcome = machine.run_script("bash", &script)?;
        ensure!(outcome.stdout == AS_EVER, "{setup}: {}", outcome.output());
    }
    Ok(())
}

pub fn rosrun_gives_the_node_the_name_that_the_original_has() -> Verdict {
    let machine = Machine::with_stub(&*world().daemon_with(TELLER)?, "teller_py")?;
    let script = format!(
        r#"{}
sh teller_py-stub/install.sh --robot launched-name > /dev/null
printf '[nodes]\n"teller.py" = "usual_name"\n' >> /opt/cloudroid/share/teller_py/stub.toml
. /opt/cloudroid/setup.sh
rosmaster --core -p ${{ROS_MASTER_URI##*:}} > /dev/null 2>&1 & master=$!
until rosparam list > /dev/null 2>&1; do kill -0 $master || exit 1; sleep 0.1; done
CLOUDROID_LOCAL=none rosrun teller_py teller.py > said 2>&1 &
timeout "$PATIENCE" rostopic echo -n 1 -p /usual_name/told || cat said
find /opt/cloudroid -name teller.py -perm /111
"#,
        prelude(free_port()?, "")
    );
    let outcome = machine.run_script("bash", &script)?.expect_success()?;
    // Scripts of a source package are shared as well; with two executables of the same name roslaunch would not know
    // which to start.
    let found = outcome.stdout.matches("/teller.py\n").count();
    ensure!(outcome.stdout.contains("life 1 of /usual_name in") && found == 1, "{}", outcome.output());
    Ok(())
}

/// Promises to a robot in a launch file as usual: for a node and for a namespace.
const PROMISES: &str = r#"
cat > /root/promises.launch << 'END'
<launch>
  <group ns="front">
    <rosparam>
      cloudroid: { max: 2, threshold: 3 }
    </rosparam>
    <node pkg="teller_py" type="teller.py" name="teller">
      <param name="cloudroid/desire" value="0.25"/>
    </node>
    <node pkg="teller_py" type="teller.py" name="other">
      <param name="cloudroid/desire" value="0.5"/>
      <param name="cloudroid/max" value="1.5"/>
    </node>
  </group>
  <node pkg="teller_py" type="teller.py" name="frames">
    <param name="cloudroid/frames_per_second" value="4.0"/>
  </node>
</launch>
END
cat > /root/explained.py << 'END'
import json, os, sys, time, urllib.error, urllib.request
end = time.monotonic() + float(os.environ["PATIENCE"])
while time.monotonic() < end:
    try:
        with urllib.request.urlopen(sys.argv[1]) as answer:
            explained = json.load(answer)
        links = [link for served in explained["servants"] for link in served["links"]]
        if len(links) == 3:
            print(json.dumps(links))
            sys.exit()
    except urllib.error.HTTPError as error:
        explained = error.read()
    time.sleep(0.1)
sys.exit("three nodes should be linked: %s" % explained)
END
roslaunch -p PORT /root/promises.launch > /root/log 2>&1 & launched=$!
python3 /root/explained.py http://SERVER/api/v1/robots/launched-promises/explain || { cat /root/log; exit 1; }
kill -INT $launched; wait $launched
"#;

/// Invalid values: each ends its own node.
const NONSENSE: &str = r#"
cat > /root/nonsense.launch << 'END'
<launch>
  <group ns="front">
    <rosparam ns="cloudroid">max: 1</rosparam>
    <node pkg="teller_py" type="teller.py" name="more" output="screen"><param name="cloudroid/desire" value="2"/></node>
    <node pkg="teller_py" type="teller.py" name="less" output="screen"><param name="cloudroid/desire" value="-0.5"/></node>
    <node pkg="teller_py" type="teller.py" name="text" output="screen"><param name="cloudroid/desire" value="soon"/></node>
    <node pkg="teller_py" type="teller.py" name="half" output="screen"/>
    <node pkg="teller_py" type="teller.py" name="typo" output="screen"><param name="cloudroid/desired" value="1"/></node>
  </group>
</launch>
END
roslaunch -p PORT /root/nonsense.launch > /root/log 2>&1 & launched=$!
end=$((SECONDS + PATIENCE))
until [ "$(grep -c 'has died' /root/log)" = 5 ] || [ $SECONDS -ge $end ]; do sleep 0.1; done
kill -INT $launched; wait $launched
cat /root/log
"#;

pub fn a_launch_file_says_what_is_promised() -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    let machine = Machine::with_stub(&daemon, "teller_py")?;
    let installs = "sh teller_py-stub/install.sh --robot launched-promises";
    machine.run_script("sh", installs)?.expect_success()?;
    let port = free_port()?;
    let promises = PROMISES.replace("PORT", &port.to_string()).replace("SERVER", &daemon.address);
    let setup = prelude(port, ". /opt/cloudroid/setup.sh");
    let outcome = machine.run_script("bash", &format!("{setup}{promises}"))?;
    let links = outcome.stdout.lines().find(|line| line.starts_with('['));
    let links: serde_json::Value =
        serde_json::from_str(links.with_context(|| outcome.output())?).context(outcome.output())?;
    for (node, key, value) in [
        ("/front/teller", "desire", 250.0),
        ("/front/teller", "max", 2000.0),
        ("/front/teller", "threshold", 3.0),
        ("/front/other", "desire", 500.0),
        ("/front/other", "max", 1500.0),
        ("/front/other", "threshold", 3.0),
        ("/frames", "frames_per_second", 4.0),
    ] {
        let all = links.as_array().context("a list")?;
        let link = all.iter().find(|link| link["node"] == node);
        let told = link.context(node)?[key].as_f64();
        ensure!(told == Some(value), "{key} of {node}: {links:#}");
    }
    let nonsense = NONSENSE.replace("PORT", &free_port()?.to_string());
    let setup = prelude(free_port()?, ". /opt/cloudroid/setup.sh");
    let outcome = machine.run_script("bash", &format!("{setup}{nonsense}"))?;
    for words in [
        "parameter /front/more/cloudroid/desire: desire (2 s) is greater than max (1 s); lower it, or raise max",
        "parameter /front/less/cloudroid/desire: desire is -0.5; it should be a number greater than 0",
        "parameter /front/text/cloudroid/desire is \"soon\": invalid type",
        "rosparam delete /front/text/cloudroid/desire",
        "parameter /front/cloudroid/max: max is given without desire; set desire, too, or remove max",
        "parameter /front/typo/cloudroid/desired is 1: unknown field",
    ] {
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    let died = outcome.stdout.matches("exit code 1").count();
    ensure!(died == 5, "{died} died: {}", outcome.output());
    Ok(())
}
