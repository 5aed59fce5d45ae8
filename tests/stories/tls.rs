//! A robot whose server is behind TLS, under an authority of its owner's.

use anyhow::ensure;
use support::Verdict;
use support::machine::{Machine, free_port};
use support::site::Site;
use support::tls::Proxy;
use support::world::{TELLER, world};

pub fn a_robot_works_through_tls() -> Verdict {
    let daemon = world().with(TELLER)?;
    let proxy = Proxy::of(&daemon.address)?;
    let machine = Machine::with_stub(&daemon, "teller_py")?;
    machine.puts(&proxy.authority(), "/root/authority.pem", 0o644)?;
    let install = format!(
        "sh teller_py-stub/install.sh --robot secure --server wss://localhost:{}",
        proxy.port
    );
    // This machine came without any authority.
    machine.runs("sh", &install)?.failed_saying(&[
        "this robot trusts nobody yet",
        "ca-certificates",
        "nothing was installed",
    ])?;
    let port = free_port()?;
    let script = format!(
        r#"set -e
{install} --ca authority.pem
# What was set is kept.
sh teller_py-stub/install.sh > /dev/null
. /opt/cloudroid/setup.sh
export ROS_MASTER_URI=http://localhost:{port} CLOUDROID_LOCAL=none
rosmaster --core -p {port} > /dev/null 2>&1 & master=$!
until rosparam list > /dev/null 2>&1; do kill -0 $master; sleep 0.1; done
rosrun teller_py teller.py > said 2>&1 &
timeout 60 rostopic echo -n 1 -p /teller/told
cat said"#
    );
    let outcome = machine.runs("bash", &script)?.succeeded()?;
    for words in [
        "ok    server     wss://localhost",
        "ok    service",
        "life 1 of /teller",
        "linked to wss://localhost",
    ] {
        ensure!(
            outcome.stdout.contains(words),
            "{words}: {}",
            outcome.said()
        );
    }
    Ok(())
}

pub fn what_stands_against_tls_is_said() -> Verdict {
    let daemon = world().with(TELLER)?;
    let proxy = Proxy::of(&daemon.address)?;
    let site = Site::new()?;
    let other = Proxy::of(&daemon.address)?;
    let authority = format!("ca_file = {:?}\n", proxy.authority());
    let stranger = format!("ca_file = {:?}\n", other.authority());
    let mistaken = Proxy::of_authority(&daemon.address)?;
    let itself = format!("ca_file = {:?}\n", mistaken.authority());
    let mistaken = format!("127.0.0.1:{}", mistaken.port);
    let plain = daemon.address.clone();
    let secure = format!("127.0.0.1:{}", proxy.port);
    for (server, authority, words) in [
        (&secure, "ca_file = \"/nowhere.pem\"\n", "/nowhere.pem"),
        (
            &secure,
            "ca_file = \"/dev/null\"\n",
            "it should be a PEM file",
        ),
        (&secure, &*stranger, "install.sh --ca FILE"),
        (&mistaken, &*itself, "have it sign one for the server"),
        // Another name of the same machine, which the certificate does not have.
        (
            &format!("127.0.0.2:{}", proxy.port),
            &*authority,
            "it is another server's",
        ),
        (&plain, &*authority, "try ws:// in place of wss://"),
    ] {
        let toml = format!(
            "server = \"wss://{server}\"\nservice = \"teller_py\"\nrobot = \"insecure\"\nlocal = \"none\"\n{authority}"
        );
        let stub = site.stub_with(&toml, "teller_py", "teller.py", &[])?;
        stub.says(words)?;
    }
    Ok(())
}
