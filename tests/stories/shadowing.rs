//! A robot installs a stub, and its own tools find the stub in place of the original.

use anyhow::{Context, ensure};
use ros::bus::RosVersion;
use support::Verdict;
use support::deployer::path_str;
use support::machine::{Machine, free_port};
use support::world::{HERALD, PEOPLE, world};

const SHELLS: [(&str, &str); 3] = [("sh", "setup.sh"), ("bash", "setup.bash"), ("zsh", "setup.zsh")];
const OVERLAY: &str = "/opt/cloudroid";

/// Prints where each tool finds the package and its nodes, one line each.
const LOOK: &str = r#"
rospack find opencv_apps
rosrun --prefix echo opencv_apps people_detect
rosrun --prefix echo opencv_apps face_detection
roslaunch --files opencv_apps people_detect.launch
roslaunch --args /people_detect opencv_apps people_detect.launch | grep -o '/[^ ]*/people_detect '
python3 -c "import roslib.packages as p; print(p.find_node('opencv_apps', 'people_detect'))"
rospack find roslaunch
"#;

fn expected_paths(prefix: &str) -> String {
    format!(
        "{prefix}/share/opencv_apps\n{prefix}/lib/opencv_apps/people_detect\n\
         {prefix}/lib/opencv_apps/face_detection\n{prefix}/share/opencv_apps/launch/people_detect.launch\n\
         {prefix}/lib/opencv_apps/people_detect \n['{prefix}/lib/opencv_apps/people_detect']\n/usr/share/roslaunch\n"
    )
}

/// Returns a machine with the stub of people_detect unpacked in /root.
fn machine_with_stub() -> anyhow::Result<Machine> {
    Machine::with_stub(&*world().daemon_with(PEOPLE)?, "opencv_apps")
}

fn machine_with_installed_stub() -> anyhow::Result<Machine> {
    let machine = machine_with_stub()?;
    let outcome = machine.run_script("sh", "sh opencv_apps-stub/install.sh")?.expect_success()?;
    for words in ["ok    server", "ok    clock", "the token is valid", ". /opt/cloudroid/setup.sh"] {
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    Ok(machine)
}

pub fn on_debians_layout_every_tool_finds_the_stub() -> Verdict {
    let machine = machine_with_installed_stub()?;
    let before = machine.run_script("sh", LOOK)?.expect_success()?;
    ensure!(before.stdout == expected_paths("/usr"), "{}", before.output());
    for (shell, setup) in SHELLS {
        // Twice, and with arguments that belong to the script and that `.` would pass on.
        let script =
            format!("set -- --extend x\n. {OVERLAY}/{setup}\n. {OVERLAY}/{setup}\n{LOOK}\necho $CMAKE_PREFIX_PATH $*");
        let found = machine.run_script(shell, &script)?.expect_success()?;
        let expected = format!("{}{OVERLAY}:/usr --extend x\n", expected_paths(OVERLAY));
        ensure!(found.stdout == expected, "{shell}: {}", found.output());
        let left = machine.run_script(shell, &format!(". {OVERLAY}/{setup}; set | grep ^_cloudroid"))?;
        ensure!(left.stdout.is_empty(), "{shell} keeps {}", left.stdout);
    }
    Ok(())
}

pub fn what_is_not_outsourced_becomes_the_original() -> Verdict {
    let machine = machine_with_installed_stub()?;
    let script = format!(
        ". {OVERLAY}/setup.sh\n{OVERLAY}/lib/opencv_apps/face_detection __name:=y > /tmp/said 2>&1 &\n\
         until grep -q 'contact master' /tmp/said; do kill -0 $! || break; sleep 0.1; done\n\
         readlink /proc/$!/exe; tr '\\0' '\\n' < /proc/$!/environ | grep -c '{OVERLAY}'; cat /tmp/said >&2"
    );
    let become_it = machine.run_script("sh", &script)?;
    ensure!(become_it.stdout == "/usr/lib/opencv_apps/face_detection\n0\n", "{}", become_it.output());
    Ok(())
}

pub fn without_the_original_the_stub_stands_alone() -> Verdict {
    let machine = machine_with_installed_stub()?;
    machine.run_script("sh", "rm -r /usr/share/opencv_apps /usr/lib/opencv_apps")?.expect_success()?;
    for (shell, setup) in SHELLS {
        let found = machine.run_script(shell, &format!(". {OVERLAY}/{setup}\n{LOOK}"))?;
        ensure!(found.stdout == expected_paths(OVERLAY), "{shell}: {}", found.output());
    }
    let source = format!(". {OVERLAY}/setup.sh\n");
    machine
        .run_script("sh", &format!("{source}timeout $PATIENCE rosrun opencv_apps face_detection"))?
        .expect_failure(&["no original opencv_apps/face_detection is installed"])?;
    let doctor = machine.run_script("sh", &format!("{source}rosrun opencv_apps cloudroid-stub doctor"))?;
    let said = doctor.expect_success()?.stdout;
    ensure!(
        said.contains("people_detect is not installed on this robot, so it runs in the cloud only")
            && said.contains("fix it:  install the package opencv_apps"),
        "{said}"
    );
    Ok(())
}

/// Files installed by upstream's packages: catkin's own set-up files, generated from its templates, below
/// /opt/ros/noetic.
const OPT_ROS: &str = r#"
set -e
ros=/opt/ros/noetic templates=/usr/share/catkin/cmake/templates
mkdir -p $ros/lib $ros/share $ros/etc/catkin/profile.d
mv /usr/lib/opencv_apps $ros/lib/; mv /usr/share/opencv_apps $ros/share/
touch $ros/.catkin
for file in setup.sh setup.bash setup.zsh; do sed "s|@SETUP_DIR@|$ros|" $templates/$file.in > $ros/$file; done
sed "s|@PYTHON_EXECUTABLE@|/usr/bin/python3|; s|@CATKIN_LIB_ENVIRONMENT_PATHS@|'lib'|
     s|@CATKIN_PKGCONFIG_ENVIRONMENT_PATHS@|'lib/pkgconfig'|; s|@PYTHON_INSTALL_DIR@|lib/python3/dist-packages|
     s|@CATKIN_GLOBAL_BIN_DESTINATION@|bin|; s|@CMAKE_PREFIX_PATH_AS_IS@|$ros|; s|@[A-Z_]*@||g" \
  $templates/_setup_util.py.in > $ros/_setup_util.py
chmod +x $ros/_setup_util.py
cp /usr/share/ros_environment/catkin_env_hook/1.ros_package_path.sh $ros/etc/catkin/profile.d/
"#;

pub fn on_an_opt_ros_layout_every_tool_finds_the_stub() -> Verdict {
    let machine = machine_with_installed_stub()?;
    machine.run_script("bash", OPT_ROS)?.expect_success()?;
    for (shell, setup) in SHELLS {
        let upstream =
            format!("set --\n. /opt/ros/noetic/{setup}\nexport ROS_PACKAGE_PATH=$ROS_PACKAGE_PATH:/usr/share\n");
        let before = machine.run_script(shell, &format!("{upstream}{LOOK}"))?;
        ensure!(before.stdout == expected_paths("/opt/ros/noetic"), "{shell}: {}", before.output());
        let script = format!("{upstream}. {OVERLAY}/{setup}\n{LOOK}");
        let found = machine.run_script(shell, &script)?;
        ensure!(found.stdout == expected_paths(OVERLAY), "{shell}: {}", found.output());
    }
    // The original is found there as well; sourcing upstream again takes precedence over the stub, which is reported.
    let source = format!(
        "set --\n. /opt/ros/noetic/setup.sh\nexport ROS_PACKAGE_PATH=$ROS_PACKAGE_PATH:/usr/share\n. \
         {OVERLAY}/setup.sh\n"
    );
    let doctor = format!("{OVERLAY}/lib/opencv_apps/cloudroid-stub doctor");
    let good = machine.run_script("sh", &format!("{source}{doctor}"))?.expect_success()?;
    ensure!(
        good.stdout.contains("people_detect is /opt/ros/noetic/lib/opencv_apps/people_detect"),
        "{}",
        good.output()
    );
    machine
        .run_script("sh", &format!("{source}. /opt/ros/noetic/setup.sh\n{doctor}"))?
        .expect_failure(&["FAIL  shadowing", "fix it:  . /opt/cloudroid/setup.sh"])?;
    Ok(())
}

pub fn on_an_opt_ros_layout_without_the_original_the_stub_stands_alone() -> Verdict {
    let machine = machine_with_installed_stub()?;
    machine.run_script("bash", OPT_ROS)?.expect_success()?;
    machine
        .run_script("sh", "rm -r /opt/ros/noetic/lib/opencv_apps /opt/ros/noetic/share/opencv_apps")?
        .expect_success()?;
    for (shell, setup) in SHELLS {
        let source = format!(
            "set --\n. /opt/ros/noetic/{setup}\nexport ROS_PACKAGE_PATH=$ROS_PACKAGE_PATH:/usr/share\n. \
             {OVERLAY}/{setup}\n"
        );
        let found = machine.run_script(shell, &format!("{source}{LOOK}"))?;
        ensure!(found.stdout == expected_paths(OVERLAY), "{shell}: {}", found.output());
        machine
            .run_script(shell, &format!("{source}timeout $PATIENCE rosrun opencv_apps face_detection"))?
            .expect_failure(&["no original opencv_apps/face_detection is installed"])?;
        let doctor = format!("{source}rosrun opencv_apps cloudroid-stub doctor");
        let doctor = machine.run_script(shell, &doctor)?.expect_success()?;
        ensure!(
            doctor.stdout.contains("people_detect is not installed on this robot, so it runs in the cloud only"),
            "{shell}: {}",
            doctor.output()
        );
    }
    Ok(())
}

pub fn the_installer_checks_before_it_writes_and_undoes_itself() -> Verdict {
    let machine = machine_with_stub()?;
    let nobody = "sh opencv_apps-stub/install.sh --server ws://127.0.0.1:9";
    machine.run_script("sh", nobody)?.expect_failure(&[
        "FAIL  server",
        "cannot be reached",
        "nothing was installed",
    ])?;
    let written = machine.run_script("sh", &format!("ls -d {OVERLAY}"))?;
    ensure!(written.status != 0, "{}", written.output());
    machine
        .run_script("sh", "sh opencv_apps-stub/setup.sh; sh -c '. opencv_apps-stub/setup.sh'")?
        .expect_success()
        .and_then(|outcome| {
            ensure!(outcome.stderr.contains("run install.sh"), "{}", outcome.output());
            Ok(())
        })?;
    machine
        .run_script("sh", "sh opencv_apps-stub/install.sh --prefix /root/mine --robot rover --token secret")?
        .expect_success()?;
    let settings = machine
        .run_script("sh", "cat /root/mine/share/opencv_apps/stub.toml; stat -c %a /root/mine/share/opencv_apps/token")?
        .expect_success()?
        .stdout;
    let sets = |key: &str| {
        let of = |line: &&str| line.starts_with(key);
        settings.lines().filter(of).collect::<Vec<_>>()
    };
    ensure!(sets("robot") == ["robot = \"rover\""] && settings.ends_with("600\n"), "{settings}");
    // At the place in the file where they are explained.
    ensure!(settings.starts_with("# How this robot uses") && !settings.contains("# robot"), "{settings}");
    // Settings of the owner survive another installation.
    let again = "echo 'max = 0.4' >> /root/mine/share/opencv_apps/stub.toml\n\
                 sh opencv_apps-stub/install.sh --prefix /root/mine > /dev/null\n\
                 cat /root/mine/share/opencv_apps/stub.toml";
    let kept = machine.run_script("sh", again)?.expect_success()?.stdout;
    ensure!(kept.contains("max = 0.4") && kept.contains("robot = \"rover\""), "{kept}");
    machine.run_script("sh", "sh /root/mine/share/opencv_apps/install.sh --uninstall")?.expect_success()?;
    let left = machine.run_script("sh", "ls -A /root/mine; rospack find opencv_apps")?;
    ensure!(left.stdout == "/usr/share/opencv_apps\n", "{}", left.output());
    Ok(())
}

pub fn where_the_other_ros_is_set_up_a_stub_is_refused() -> Verdict {
    let machine = machine_with_stub()?;
    let other = "export ROS_VERSION=2 ROS_DISTRO=jazzy\n";
    let install = format!("{other}sh opencv_apps-stub/install.sh");
    let refused = ["FAIL  ros", "ROS 2 (ROS_VERSION is 2)", "robots of ROS 1", "nothing was installed"];
    machine.run_script("sh", &install)?.expect_failure(&refused)?;
    let written = machine.run_script("sh", &format!("ls -d {OVERLAY}"))?;
    ensure!(written.status != 0, "{}", written.output());
    machine.run_script("sh", &format!("{install} --force"))?.expect_success()?;
    for program in ["cloudroid-stub doctor", "people_detect"] {
        let script = format!("{other}. {OVERLAY}/setup.sh\n{OVERLAY}/lib/opencv_apps/{program}");
        machine.run_script("sh", &script)?.expect_failure(&["ROS 2 (ROS_VERSION is 2)", "robots of ROS 1"])?;
    }
    // Debian's own ROS 1 sets no variable.
    let doctor = format!(". {OVERLAY}/setup.sh\nrosrun opencv_apps cloudroid-stub doctor");
    let good = machine.run_script("sh", &doctor)?.expect_success()?;
    ensure!(good.stdout.contains("ok    ros        ROS_VERSION is not set"), "{}", good.output());
    Ok(())
}

pub fn where_nodes_speak_zenoh_a_stub_is_refused() -> Verdict {
    let machine = Machine::with_stub_for(&*world().daemon_with(HERALD)?, "herald", RosVersion::Two)?;
    let sourced = "export ROS_VERSION=2 ROS_DISTRO=kilted\n";
    let zenoh = format!("{sourced}export RMW_IMPLEMENTATION=rmw_zenoh_cpp\n");
    let said = ["RMW_IMPLEMENTATION is rmw_zenoh_cpp", "stubs speak DDS only", "RMW_IMPLEMENTATION=rmw_fastrtps_cpp"];
    let install = "sh herald-stub/install.sh --robot zenoh";
    let refused = machine.run_script("sh", &format!("{zenoh}{install}"))?.expect_failure(&said)?;
    for words in ["FAIL  middleware", "nothing was installed"] {
        ensure!(refused.output().contains(words), "{}", refused.output());
    }
    let written = machine.run_script("sh", &format!("ls -d {OVERLAY}"))?;
    ensure!(written.status != 0, "{}", written.output());
    let default = machine.run_script("sh", &format!("{sourced}{install}"))?.expect_success()?;
    ensure!(default.stdout.contains("ok    middleware RMW_IMPLEMENTATION is not set"), "{}", default.output());
    for program in ["cloudroid-stub doctor", "herald"] {
        let script = format!("{zenoh}. {OVERLAY}/setup.sh\n{OVERLAY}/lib/herald/{program}");
        machine.run_script("sh", &script)?.expect_failure(&said)?;
    }
    Ok(())
}

pub fn a_stub_that_was_changed_on_its_way_is_not_installed() -> Verdict {
    let machine = machine_with_stub()?;
    let program = "opencv_apps-stub/lib/opencv_apps/cloudroid-stub";
    let tampered = format!("printf '#!/bin/sh\\ntouch /root/ran\\n' > {program}; sh opencv_apps-stub/install.sh");
    machine
        .run_script("sh", &tampered)?
        .expect_failure(&["./lib/opencv_apps/cloudroid-stub", "differ from what the server signed"])?;
    let left = machine.run_script("sh", &format!("ls -d {OVERLAY} /root/ran"))?;
    ensure!(left.stdout.is_empty(), "{}", left.output());
    let unsigned = "rm opencv_apps-stub/MANIFEST.sig; sh opencv_apps-stub/install.sh";
    machine.run_script("sh", unsigned)?.expect_failure(&["this archive is not signed"])?;
    Ok(())
}

pub fn its_nodelets_cannot_be_loaded_on_the_robot() -> Verdict {
    let machine = machine_with_installed_stub()?;
    let port = free_port()?;
    let script = format!(
        r#"set -e
. {OVERLAY}/setup.sh
export ROS_MASTER_URI=http://localhost:{port}
rosmaster --core -p {port} > /dev/null 2>&1 & master=$!
until rosparam list > /dev/null 2>&1; do kill -0 $master; sleep 0.2; done
rosrun nodelet nodelet standalone opencv_apps/people_detect || echo "standalone: $?"
cat > load.launch << 'END'
<launch>
  <node pkg="nodelet" type="nodelet" name="manager" args="manager" output="screen"/>
  <node pkg="nodelet" type="nodelet" name="people" args="load opencv_apps/people_detect manager" output="screen" required="true"/>
</launch>
END
timeout "$PATIENCE" roslaunch load.launch || echo "roslaunch: $?""#
    );
    let refused = machine.run_script("bash", &script)?.expect_success()?;
    // As a process of its own, and in a manager from a launch file, where the loader exits and is required.
    for words in ["standalone: ", "REQUIRED process [people"] {
        ensure!(refused.output().contains(words), "{words}: {}", refused.output());
    }
    let why = "opencv_apps runs in the cloud: its nodelets cannot be loaded";
    let times = refused.output().matches(why).count();
    ensure!(times >= 2, "{times} times: {}", refused.output());
    Ok(())
}

pub fn stubs_are_served_to_those_who_may_and_say_what_is_lacking() -> Verdict {
    let daemon = world().daemon_with(PEOPLE)?;
    let (status, body) = daemon.get("/stubs/nobody.tar.gz")?;
    ensure!(status == 404 && body.contains("opencv_apps"), "{status} {body}");
    let (status, body) = daemon.get("/stubs/opencv_apps.tar.gz?arch=riscv64")?;
    ensure!(status == 404 && body.contains("make stub-cross"), "{status} {body}");
    let stubs = daemon.deployer().run_json(&["stub"])?;
    ensure!(stubs["architectures"][0] == "x86_64", "{stubs}");
    // The available architectures depend on what was built; for each of them there is a response.
    for (list, expected) in [("architectures", 200), ("lacking", 404)] {
        for architecture in stubs[list].as_array().context("a list")? {
            let name = architecture.as_str().context("a name")?;
            let path = format!("/stubs/opencv_apps.tar.gz?arch={name}");
            let (status, body) = daemon.request("HEAD", &path, &[])?;
            ensure!(status == expected, "{name} is in {list}: {status} {body}");
        }
    }
    let place = world().directory("twice")?;
    let archive = |name: &str| -> anyhow::Result<Vec<u8>> {
        let directory = place.path().join(name);
        let words = ["stub", "opencv_apps", "-o", path_str(&directory)];
        daemon.deployer().run(&words)?.expect_success()?;
        std::fs::read(directory.join("opencv_apps.tar.gz")).context("the archive")
    };
    ensure!(archive("a")? == archive("b")?, "the same stub twice differs");
    Ok(())
}
