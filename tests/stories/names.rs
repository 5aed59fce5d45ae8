//! A robot finds its server by name: the stub's program is static, so it resolves names as the C library would.

use anyhow::ensure;
use support::Verdict;
use support::machine::Machine;
use support::world::{PEOPLE, world};

/// A network with a single machine: a device that exists while a program holds it, 10.9.8.7, with a web server.
const NETWORK: &str = r#"
set -e
PATH=$PATH:/usr/sbin:/sbin
cat > /root/card.py << 'END'
import fcntl, os, struct, time
card = os.open("/dev/net/tun", os.O_RDWR)
fcntl.ioctl(card, 0x400454ca, struct.pack("16sH22x", b"lan0", 0x0002 | 0x1000))
print("ready", flush=True)
while os.read(card, 2000): pass
END
ip link set lo up
mkfifo /root/ready
python3 /root/card.py > /root/ready &
read word < /root/ready
ip address add 10.9.8.7/24 dev lan0
ip link set lan0 up multicast on
ip route add default dev lan0
mkdir /root/web; echo fine > /root/web/healthz
python3 -m http.server --bind 10.9.8.7 --directory /root/web 9090 > /dev/null 2>&1 &
until ip -brief address show dev lan0 | grep -q 10.9.8.7 && exec 3<>/dev/tcp/10.9.8.7/9090; do sleep 0.1; done 2> /dev/null
echo '127.0.0.1 localhost' > /etc/hosts
asks() {
  printf 'server = "ws://%s:9090"\nservice = "opencv_apps"\n' "$1" > /root/asked/stub.toml
  echo "$1: $(/root/opencv_apps-stub/lib/opencv_apps/cloudroid-stub doctor --share /root/asked --package nobody --only server | grep server)"
}
mkdir /root/asked
"#;

/// Returns the output of the doctor for each name in that network, after `preparation`.
fn run_doctor(preparation: &str, names: &[&str]) -> anyhow::Result<String> {
    let machine = Machine::with_stub(&*world().daemon_with(PEOPLE)?, "opencv_apps")?;
    let questions: Vec<String> = names.iter().map(|name| format!("asks {name}")).collect();
    let script = format!("{NETWORK}{preparation}\n{}", questions.join("\n"));
    machine.write_file("/root/inside.sh", &script)?;
    Ok(machine.run_script("sh", "unshare --net bash /root/inside.sh")?.expect_success()?.output())
}

pub fn a_server_is_found_in_the_hosts_file_and_by_dns() -> Verdict {
    let dns = r#"
echo '10.9.8.7 byhand' >> /etc/hosts
rm -f /etc/resolv.conf
printf 'search lab.example\nnameserver 127.0.0.1\noptions edns0 trust-ad\n' > /etc/resolv.conf
dnsmasq --no-resolv --no-hosts --local=/#/ --host-record=brain.lab.example,10.9.8.7 --cname=alias.lab.example,brain.lab.example \
  --pid-file=/root/dnsmasq.pid --listen-address=127.0.0.1 --bind-interfaces
"#;
    let names = ["byhand", "brain", "brain.lab.example", "alias", "nobody"];
    let said = run_doctor(dns, &names)?;
    for name in &names[..4] {
        let fine = format!("{name}: ok    server     ws://{name}:9090 answers");
        ensure!(said.contains(&fine), "{name}: {said}");
    }
    ensure!(
        said.contains("nobody: FAIL  server     nobody is not found: host nobody has no address: asked 127.0.0.1"),
        "{said}"
    );
    Ok(())
}

pub fn a_server_is_found_by_multicast_dns() -> Verdict {
    let avahi = r#"
rm -f /etc/resolv.conf
printf '[server]\nhost-name=brain\nallow-interfaces=lan0\nuse-ipv6=no\nenable-dbus=no\n[rlimits]\n' > /root/avahi.conf
avahi-daemon --file /root/avahi.conf --no-drop-root --no-chroot > /root/avahi.log 2>&1 &
until grep -q 'startup complete' /root/avahi.log && grep -q 'record for 10.9.8.7' /root/avahi.log; do kill -0 $! || { cat /root/avahi.log; exit 1; }; sleep 0.1; done
"#;
    let names = ["brain.local", "nobody.local", "nobody"];
    let said = run_doctor(avahi, &names)?;
    for words in [
        "brain.local: ok    server     ws://brain.local:9090 answers",
        "nobody.local: FAIL  server     nobody.local is not found: host nobody.local has no address: no host on this \
            network",
        "nobody: FAIL  server     nobody is not found: host nobody has no address: it is not in /etc/hosts",
    ] {
        ensure!(said.contains(words), "{words}: {said}");
    }
    Ok(())
}
