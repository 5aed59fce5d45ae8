//! Robots of one ROS with the stub of a service of the other: the archive for their ROS, their tools, and the node that
//! they start by it.

use anyhow::{Context, ensure};
use ros::bus::{RosVersion, WireFormat};
use support::Verdict;
use support::machine::Machine;
use support::site::{NodeProcess, Site, string, string_in, string_text};
use support::world::{HERALD, TELLER, world};

/// Output of `teller.py` about how it was started.
const AS_ASKED: &str = "life 1 of /front/teller in /front, directory ROS's, arguments ['one', 'two words'], word \
                        hello, number 4, file there";

/// Adds the stub's output to an error.
fn with_log<T>(outcome: anyhow::Result<T>, stub: &NodeProcess) -> anyhow::Result<T> {
    outcome.with_context(|| format!("the stub said:\n{}", stub.output()))
}

pub fn a_robot_of_ros_2_starts_a_node_of_ros_1_as_its_own() -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    let ros = RosVersion::Two;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let overlay = site.install_stub(&daemon, "teller_py", "robot = \"other-ros-2\"\nlocal = \"none\"\n")?;
    for file in ["local_setup.sh", "share/ament_index/resource_index/packages/teller_py"] {
        ensure!(overlay.join(file).is_file(), "{file}");
    }
    let file = format!("file:={}", overlay.join("share/teller_py/package.xml").display());
    let names = ["-r", "__node:=teller", "-r", "__ns:=/front", "-r", "~/told:=/told"];
    let parameters = ["-p", "word:=hello", "-p", "number:=4", "-p", &file];
    let argv = [&["one", "two words", "--ros-args"][..], &names, &parameters].concat();
    let stub = site.start_installed(&overlay, "teller_py", "teller.py", &argv)?;
    let mut told = site.subscribe_latched(&app, "/told")?;
    let line = with_log(site.next_message(&mut told), &stub)?;
    let line = string_text(ros, &line.bytes, 0)?;
    ensure!(line == AS_ASKED, "{line}\n{}", stub.output());
    let mut said = site.subscribe(&app, "/front/teller/said")?;
    let say = site.advertise_strings(&app, "/front/teller/say", false)?;
    let text = string_in(WireFormat::Cdr, "in CDR");
    let ask = || {
        say.publish(text.clone());
        Ok(())
    };
    let heard = with_log(site.ask_until(&mut said, ask, |_| Ok(true)), &stub)?;
    ensure!(string_text(ros, &heard.bytes, 0)? == "in CDR", "{heard:?}");
    Ok(())
}

pub fn a_robot_of_ros_1_starts_a_node_of_ros_2_as_its_own() -> Verdict {
    let daemon = world().daemon_with(HERALD)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let overlay = site.install_stub(&daemon, "herald", "robot = \"other-ros-1\"\nlocal = \"none\"\n")?;
    // The robot builds the messages' code from it.
    for file in [".catkin", "share/herald/message_packages/herald_msgs/msg/Greeting.msg"] {
        ensure!(overlay.join(file).is_file(), "{file}");
    }
    let stub = site.start_installed(&overlay, "herald", "herald", &["__name:=herald", "greeting:=/heard"])?;
    let mut greetings = site.subscribe(&app, "/heard")?;
    let name = site.advertise_strings(&app, "/name", false)?;
    let ask = || {
        name.publish(string("crowd"));
        Ok(())
    };
    let greeted =
        site.ask_until(&mut greetings, ask, |heard| Ok(String::from_utf8_lossy(&heard.bytes).contains("Hello, crowd")));
    let greeted = with_log(greeted, &stub)?;
    ensure!(greeted.publisher.node() == "/herald", "{greeted:?}");
    Ok(())
}

pub fn tools_of_ros_1_find_the_stub_of_a_service_of_ros_2() -> Verdict {
    let machine = Machine::with_stub(&*world().daemon_with(HERALD)?, "herald")?;
    machine.run_script("sh", "sh herald-stub/install.sh --robot other-ros-tools")?.expect_success()?;
    let look = "rospack find herald\nrosrun --prefix echo herald herald\n\
                python3 -c \"import roslib.packages as p; print(p.find_node('herald', 'herald'))\"\n";
    for shell in ["sh", "bash", "zsh"] {
        let found = machine.run_script(shell, &format!(". /opt/cloudroid/setup.{shell}\n{look}"))?.expect_success()?;
        let expected = "/opt/cloudroid/share/herald\n/opt/cloudroid/lib/herald/herald\n\
                        ['/opt/cloudroid/lib/herald/herald']\n";
        ensure!(found.stdout == expected, "{shell}: {}", found.output());
    }
    let doctor = ". /opt/cloudroid/setup.sh\nrosrun herald cloudroid-stub doctor";
    let doctor = machine.run_script("sh", doctor)?.expect_success()?;
    ensure!(doctor.stdout.contains("ok    shadowing"), "{}", doctor.output());
    Ok(())
}

pub fn rules_of_a_lab_name_the_types_of_its_robots() -> Verdict {
    let place = world().directory("translation-rules")?;
    let configure = |name: &str, rules: &str| -> anyhow::Result<String> {
        let path = place.path().join(name);
        std::fs::write(&path, rules)?;
        Ok(format!("[ros]\ntranslation_rules = [{path:?}]\n"))
    };
    let unfinished = configure("unfinished.yaml", "- ros1_package_name: lab_msgs\n")?;
    let refused = world().setup("unfinished-rules").config(&unfinished).expect_refusal()?;
    ensure!(refused.contains("unfinished.yaml, rule 1 lacks ros2_package_name"), "{refused}");
    let lab = configure("lab.yaml", "- {ros1_package_name: lab_msgs, ros2_package_name: herald_msgs}\n")?;
    let daemon = world().setup("rules-of-a-lab").config(&lab).start()?;
    HERALD.push_to(&daemon)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let overlay = site.install_stub(&daemon, "herald", "robot = \"rules-of-a-lab\"\nlocal = \"none\"\n")?;
    let definition = overlay.join("share/herald/message_packages/lab_msgs/msg/Greeting.msg");
    ensure!(definition.is_file(), "{}", definition.display());
    let stub = site.start_installed(&overlay, "herald", "herald", &["__name:=herald", "greeting:=/heard"])?;
    let mut greetings = site.subscribe(&app, "/heard")?;
    let name = site.advertise_strings(&app, "/name", false)?;
    let ask = || {
        name.publish(string("crowd"));
        Ok(())
    };
    let greeted = with_log(site.ask_until(&mut greetings, ask, |_| Ok(true)), &stub)?;
    ensure!(greeted.wire_type.name == "lab_msgs/Greeting", "{greeted:?}");
    Ok(())
}

pub fn the_same_service_has_an_archive_for_either_ros() -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    for (query, expected) in [("?ros=1", 200), ("?ros=2", 200), ("", 200), ("?ros=3", 400)] {
        let (status, body) = daemon.request("HEAD", &format!("/stubs/teller_py.tar.gz{query}"), &[])?;
        ensure!(status == expected, "{query}: {status} {body}");
    }
    let place = world().directory("either")?;
    let archive = |name: &str, more: &[&str]| -> anyhow::Result<Vec<u8>> {
        let directory = place.path().join(name);
        let directory = directory.to_str().context("a text")?;
        let words = [&["stub", "teller_py", "-o", directory], more].concat();
        daemon.deployer().run(&words)?.expect_success()?;
        std::fs::read(place.path().join(name).join("teller_py.tar.gz")).context("the archive")
    };
    let (own, one, two) = (archive("own", &[])?, archive("one", &["--ros", "1"])?, archive("two", &["--ros", "2"])?);
    ensure!(own == one, "without a choice it is that of the service's ROS");
    ensure!(one != two && two == archive("again", &["--ros", "2"])?, "the same stub twice differs");
    Ok(())
}
