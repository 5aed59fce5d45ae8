//! Robots with a key of their own: paired with a line of text, identified by certificates that renew themselves, and
//! revoked with one command.

use std::io::{BufRead, BufReader};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, ensure};
use support::daemon::{Daemon, DaemonSetup};
use support::deployer::{CommandOutcome, path_str, run};
use support::machine::Machine;
use support::patience::{patience, scale_seconds};
use support::site::{NodeProcess, Site};
use support::world::{ADDER, TELLER, world};
use support::{Verdict, binaries, wait_until};

/// On loopback as well, so that stories need no other address of this machine.
const TLS: &str = "[tls]\nserve = \"tls\"\n";

fn secure_setup(name: &str, more: &str) -> DaemonSetup {
    world().setup(name).config(&format!("{TLS}{more}"))
}

/// Returns the line that `cloudroidctl pair` prints for a robot.
fn pairing_line(daemon: &Daemon, arguments: &[&str]) -> anyhow::Result<String> {
    let made = daemon.deployer().run_json(&[&["pair"], arguments].concat())?;
    Ok(made["line"].as_str().context("a line")?.to_owned())
}

/// A robot's identity directory, and the commands that use it.
struct PairedRobot {
    own: support::world::Directory,
}

impl PairedRobot {
    fn new() -> anyhow::Result<PairedRobot> {
        let own = world().directory("robot")?;
        Ok(PairedRobot { own })
    }

    fn directory(&self) -> PathBuf {
        self.own.path().join("own")
    }

    fn pair(&self, line: &str) -> anyhow::Result<CommandOutcome> {
        run(Command::new(binaries::path("stubs/x86_64/cloudroid-stub"))
            .args(["pair", line])
            .env("CLOUDROID_IDENTITY", self.directory()))
    }

    fn key(&self) -> PathBuf {
        self.directory().join("robot.key")
    }

    /// Writes its certificate for a server to a separate file.
    fn certificate(&self, server: &str) -> anyhow::Result<PathBuf> {
        let kept = self.directory().join(format!("paired/{server}.toml"));
        let text = std::fs::read_to_string(&kept).with_context(|| kept.display().to_string())?;
        let text = text.replace("\\n", "\n");
        let begin = text.find("-----BEGIN").context("a certificate")?;
        let end = text.find("-----END CERTIFICATE-----").context("its end")?;
        let path = self.own.path().join("certificate.pem");
        std::fs::write(&path, format!("{}-----END CERTIFICATE-----\n", &text[begin..end]))?;
        Ok(path)
    }

    /// Starts a stub whose configuration contains nothing but the server's address.
    fn start_stub(&self, site: &Site, daemon: &Daemon, service: (&str, &str)) -> anyhow::Result<NodeProcess> {
        let toml = format!(
            "server = \"wss://{}\"\nservice = \"{}\"\nlocal = \"none\"\nidentity = {:?}\n",
            daemon.address,
            service.0,
            self.directory()
        );
        site.start_stub_with_config(&toml, service.0, service.1, &[])
    }
}

/// Runs curl with a certificate and its key.
fn curl(daemon: &Daemon, path: &str, pair: Option<(&Path, &Path)>, more: &[&str]) -> anyhow::Result<CommandOutcome> {
    let mut command = Command::new("curl");
    command
        .args([
            "--silent",
            "--show-error",
            "--max-time",
            &patience().as_secs().to_string(),
            "--write-out",
            "\n%{http_code}",
        ])
        .arg("--cacert")
        .arg(daemon.home.join("tls/own.pem"))
        .args(more);
    if let Some((certificate, key)) = pair {
        command.arg("--cert").arg(certificate).arg("--key").arg(key);
    }
    run(command.arg(format!("https://{}{path}", daemon.address)))
}

fn file_mode(path: &Path) -> anyhow::Result<u32> {
    Ok(path.metadata()?.permissions().mode() & 0o7777)
}

/// Returns the time in milliseconds since 1970.
fn unix_millis() -> anyhow::Result<u64> {
    Ok(u64::try_from(SystemTime::now().duration_since(UNIX_EPOCH)?.as_millis())?)
}

const AUDIT: [&str; 5] = ["audit", "-n", "1000", "--format", "json"];

/// Waits until the audit log contains these words: some records are written with a delay.
fn wait_for_audit(daemon: &Daemon, words: &str) -> Verdict {
    wait_until(&format!("{words:?} in the audit log"), || {
        let audit = daemon.deployer().run(&AUDIT)?.expect_success()?;
        Ok(if audit.stdout.contains(words) { Ok(()) } else { Err(audit.stdout) })
    })
}

const NODE: (&str, &str) = ("teller_py", "teller.py");

pub fn a_robot_is_paired_by_a_line_and_gone_at_a_word() -> Verdict {
    let daemon = secure_setup("paired", "").start()?;
    let deployer = daemon.deployer();
    deployer.push(TELLER.name, TELLER.arguments)?.expect_success()?;
    deployer.push(ADDER.name, ADDER.arguments)?.expect_success()?;
    // For people: the line alone on standard output, a QR code on standard error.
    let printed = deployer.run(&["pair", "rover1", "--services", "teller_py"])?.expect_success()?;
    ensure!(
        printed.stdout.trim().lines().count() == 1 && printed.stdout.starts_with("cloudroid://"),
        "{}",
        printed.output()
    );
    for words in ["▀", "cloudroid-stub pair 'LINE'", "install.sh --pair"] {
        ensure!(printed.stderr.contains(words), "{words}: {}", printed.output());
    }
    let line = printed.stdout.trim();
    let robot = PairedRobot::new()?;
    let paired = robot.pair(line)?.expect_success()?;
    for words in ["paired with", "as rover1", "7 days"] {
        ensure!(paired.stdout.contains(words), "{words}: {}", paired.output());
    }
    ensure!(file_mode(&robot.key())? == 0o600 && file_mode(&robot.directory())? == 0o700);
    ensure!(file_mode(&daemon.home.join("tls/authority.pem"))? == 0o600);
    for (file, words) in [("known_servers", daemon.address.as_str()), ("servers.pub", "cloudroid ssh-ed25519 AAAA")] {
        let text = std::fs::read_to_string(robot.directory().join(file))?;
        ensure!(text.contains(words), "{file}: {text}");
    }
    // It needs neither a token nor a name.
    let site = Site::new()?;
    let stub = robot.start_stub(&site, &daemon, NODE)?;
    stub.wait_for_output("linked to wss://")?;
    daemon.servant_of("teller_py", "rover1")?;
    let certificate = robot.certificate(&daemon.address)?;
    let key = robot.key();
    let pair = Some((&*certificate, &*key));
    let whoami = curl(&daemon, "/api/v1/whoami", pair, &[])?.expect_success()?;
    for words in ["\"name\":\"rover1\"", "\"robot\"", "\"teller_py\"", "\n200"] {
        ensure!(whoami.stdout.contains(words), "{words}: {}", whoami.output());
    }
    // It has no further rights, and without its certificate nobody has its identity.
    for (path, given, status) in [
        ("/api/v1/services/adder_py", pair, "403"),
        ("/api/v1/status", pair, "403"),
        ("/api/v1/pairings", pair, "403"),
        ("/api/v1/services", None, "401"),
    ] {
        let answer = curl(&daemon, path, given, &[])?.expect_success()?;
        ensure!(answer.stdout.ends_with(status), "{path}: {}", answer.output());
    }
    let other = robot.start_stub(&site, &daemon, ("adder_py", "adder.py"))?;
    other.wait_for_output("may not connect to service adder_py")?;
    // Revocation ends everything of the robot.
    let mut watched = Command::new(binaries::python())
        .args(["-c", WATCH, &daemon.address, path_str(&certificate), path_str(&key), &patience().as_secs().to_string()])
        .stdout(Stdio::piped())
        .spawn()?;
    let mut told = BufReader::new(watched.stdout.take().context("what it says")?).lines();
    let mut next = || -> anyhow::Result<String> { Ok(told.next().context("it ended")??) };
    ensure!(next()? == "open");
    let began = unix_millis()?;
    deployer.run(&["unpair", "rover1"])?.expect_success()?;
    let mut ends = Vec::new();
    for _ in 0..2 {
        let said = next()?;
        let (at, what) = said.split_once(' ').context("a time")?;
        ends.push(format!("{what} after {} ms", at.parse::<u64>()?.saturating_sub(began)));
    }
    let all = ends.join(", ");
    println!("unpaired: {all}");
    ensure!(all.contains("API") && all.contains("rosbridge 1008 robot rover1 was unpaired"), "{all}");
    watched.wait()?;
    stub.wait_for_output("robot rover1 was unpaired")?;
    let refused = curl(&daemon, "/api/v1/whoami", pair, &[])?.expect_success()?;
    for words in ["robot rover1 was unpaired", "cloudroidctl pair ROBOT", "\n401"] {
        ensure!(refused.stdout.contains(words), "{words}: {}", refused.output());
    }
    let renewal = ["--data-binary", "{\"request\":\"x\"}"];
    let refused = curl(&daemon, "/api/v1/renew", pair, &renewal)?.expect_success()?;
    ensure!(refused.stdout.ends_with("\n401"), "{}", refused.output());
    deployer.run(&["unpair", "rover1"])?.expect_failure(&["robot \"rover1\" is not paired", "pair --list"])?;
    // The audit log contains who did it, and no secret.
    for words in [
        r#""did":"begin a pairing""#,
        "was paired by a code",
        "connected by a stub",
        r#""did":"unpair""#,
        r#""did":"renew a certificate""#,
    ] {
        wait_for_audit(&daemon, words)?;
    }
    let code = line.rsplit('=').next().context("a code")?;
    let audit = deployer.run(&AUDIT)?.expect_success()?.stdout;
    ensure!(!audit.contains(code) && !daemon.log_tail().contains(code));
    Ok(())
}

/// Opens an idle connection of the API and one of rosbridge with a certificate, and reports when each ends.
const WATCH: &str = r#"
import base64, socket, ssl, struct, sys, threading, time
address, certificate, key, patience = sys.argv[1:]
host, port = address.rsplit(":", 1)
context = ssl.create_default_context()
context.check_hostname = False
context.verify_mode = ssl.CERT_NONE
context.load_cert_chain(certificate, key)
def connect(head):
    tls = context.wrap_socket(socket.create_connection((host, int(port))), server_hostname="localhost")
    tls.settimeout(float(patience))
    tls.sendall((head + "Host: " + address + "\r\n\r\n").encode())
    file = tls.makefile("rb")
    status = file.readline()
    while file.readline() not in (b"\r\n", b""):
        pass
    return tls, file, status
api, api_file, status = connect("GET /api/v1/whoami HTTP/1.1\r\n")
assert b"200" in status, status
ws, ws_file, status = connect("GET /teller_py HTTP/1.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n")
assert b"101" in status, status
# An answer to a question says that the session is there.
question = b'{"op":"call_service","service":"/rosapi/get_time","id":"q"}'
ws.sendall(bytes([0x81, 0x80 | len(question), 0, 0, 0, 0]) + question)
lock = threading.Lock()
def say(what, at=None):
    with lock:
        print(what if at is None else "%d %s" % (at * 1000, what), flush=True)
def frame():
    head = ws_file.read(2)
    if len(head) < 2:
        return None, b""
    length = head[1] & 127
    if length == 126:
        length = struct.unpack(">H", ws_file.read(2))[0]
    elif length == 127:
        length = struct.unpack(">Q", ws_file.read(8))[0]
    return head[0] & 15, ws_file.read(length)
kind, payload = frame()
while b'"q"' not in payload:
    assert kind is not None, "closed"
    kind, payload = frame()
say("open")
def of_api():
    try:
        while api_file.read(1):
            pass
    except ssl.SSLError:
        pass
    say("the idle connection of the API", time.time())
def of_rosbridge():
    while True:
        kind, payload = frame()
        if kind in (8, None):
            reason = "" if len(payload) < 2 else "%d %s" % (struct.unpack(">H", payload[:2])[0], payload[2:].decode())
            return say("rosbridge " + reason, time.time())
threads = [threading.Thread(target=of_api), threading.Thread(target=of_rosbridge)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"#;

pub fn certificates_renew_themselves_and_end_while_the_robot_is_off() -> Verdict {
    let good_for = format!("robot_certificates = \"{}s\"\n", scale_seconds(6));
    let daemon = secure_setup("renewing", &good_for).start()?;
    let deployer = daemon.deployer();
    deployer.push(TELLER.name, TELLER.arguments)?.expect_success()?;
    let robot = PairedRobot::new()?;
    robot.pair(&pairing_line(&daemon, &["rover1"])?)?.expect_success()?;
    let site = Site::new()?;
    let mut stub = robot.start_stub(&site, &daemon, NODE)?;
    stub.wait_for_output("linked to wss://")?;
    // After the first certificate has expired the link still works.
    stub.wait_for_output_times("was renewed", 2)?;
    ensure!(!stub.output().contains("was lost"), "{}", stub.output());
    let renewed = robot.certificate(&daemon.address)?;
    curl(&daemon, "/api/v1/whoami", Some((&renewed, &robot.key())), &[])?.expect_success()?;
    wait_for_audit(&daemon, "renewed its certificate")?;
    // Switched off for longer than that.
    stub.signal(nix::sys::signal::Signal::SIGINT)?;
    stub.wait_for_exit()?;
    wait_until("the certificate's end", || {
        let pairings = deployer.run_json(&["pair", "--list"])?;
        let end = pairings[0]["expires"].as_u64().context("an end")?;
        Ok(if unix_millis()? >= end { Ok(()) } else { Err(pairings.to_string()) })
    })?;
    let late = robot.start_stub(&site, &daemon, NODE)?;
    late.wait_for_output("certificate has expired")?;
    late.wait_for_output("cloudroidctl pair ROBOT")?;
    // The operator of the server is informed.
    wait_for_audit(&daemon, "presented a certificate that was refused")?;
    // The same key is paired again, and the robot works.
    let key = std::fs::read(robot.key())?;
    robot.pair(&pairing_line(&daemon, &["rover1"])?)?.expect_success()?;
    ensure!(std::fs::read(robot.key())? == key, "another key was made");
    let stub = robot.start_stub(&site, &daemon, NODE)?;
    stub.wait_for_output("linked to wss://")?;
    Ok(())
}

pub fn what_cannot_be_paired_is_said() -> Verdict {
    let daemon = secure_setup("unpaired", "").start()?;
    let deployer = daemon.deployer();
    let robot = PairedRobot::new()?;
    let refused = |line: &str, words: &[&str]| -> Verdict {
        robot.pair(line)?.expect_failure(words)?;
        Ok(())
    };
    let good = pairing_line(&daemon, &["rover1"])?;
    let code = good.rsplit('=').next().context("a code")?.to_owned();
    // Errors before anything is sent.
    for (wrong, words) in [
        (good.replace("robot=rover1", "robot=rover\u{7}1"), "control characters"),
        (good.replace("robot=rover1", "robot=a\nb"), "control characters"),
        (good[..good.len() - 1].to_owned(), "25 characters"),
        (good[..good.len() - 40].to_owned(), "not a pairing line"),
    ] {
        refused(&wrong, &[words, "cloudroidctl pair ROBOT"])?;
    }
    ensure!(!robot.key().exists(), "a key was made for nothing");
    // A machine in the middle, or a server that was set up anew.
    let at = good.find("SHA256:").context("a fingerprint")? + 7;
    let digit = if &good[at..=at] == "0" { "1" } else { "0" };
    let other = format!("{}{digit}{}", &good[..at], &good[at + 1..]);
    refused(&other, &["the connection may be intercepted", "SHA256:"])?;
    // Invalid codes.
    refused(&good.replace(&code, &"a".repeat(26)), &["not known", "401"])?;
    refused(&good.replace("robot=rover1", "robot=rover2"), &["for another robot"])?;
    // A key that others can read.
    let key = robot.key();
    std::fs::set_permissions(&key, PermissionsExt::from_mode(0o644))?;
    let command = format!("chmod 600 {}", key.display());
    refused(&good, &["other users can read", &command])?;
    std::fs::set_permissions(&key, PermissionsExt::from_mode(0o600))?;
    let second = pairing_line(&daemon, &["rover1"])?;
    refused(&good, &["replaced by a newer one"])?;
    deployer.run(&["pair", "rover1", "--cancel"])?.expect_success()?;
    refused(&second, &["cancelled"])?;
    let short = pairing_line(&daemon, &["rover1", "--ttl", "1s"])?;
    wait_until("the code's end", || {
        let left = deployer.run_json(&["pair", "--list"])?;
        Ok(if left.as_array().is_some_and(Vec::is_empty) { Ok(()) } else { Err(left.to_string()) })
    })?;
    refused(&short, &["has expired"])?;
    let once = pairing_line(&daemon, &["rover1"])?;
    robot.pair(&once)?.expect_success()?;
    refused(&once, &["already used"])?;
    // Invalid requests, or requests for another name, with a valid code: the code stays valid.
    let code = pairing_line(&daemon, &["rover3"])?;
    let code = code.rsplit('=').next().context("a code")?;
    let place = world().directory("requests")?;
    let made = run(Command::new("sh").args(["-euc", REQUESTS]).current_dir(place.path()))?;
    made.expect_success()?;
    let asks = |file: &str, text: &str| -> anyhow::Result<CommandOutcome> {
        let body = place.path().join(file);
        let json = serde_json::json!({"robot": "rover3", "code": code, "request": text});
        std::fs::write(&body, json.to_string())?;
        let data = format!("@{}", body.display());
        curl(&daemon, "/api/v1/pair", None, &["--data-binary", &data])
    };
    let made = |name: &str| std::fs::read_to_string(place.path().join(name));
    for (text, words, status) in [
        ("rubbish".to_owned(), "not a certificate request", "400"),
        (String::new(), "not a certificate request", "400"),
        ("A".repeat(5000), "at most 4096 bytes", "413"),
        (made("other.csr")?, "robot:rover4", "400"),
        (made("rsa.csr")?, "P-256 or Ed25519", "400"),
        (made("curve.csr")?, "P-256 or Ed25519", "400"),
        (made("ca.pem")?, "not a certificate request", "400"),
    ] {
        let answer = asks("body", &text)?.expect_success()?;
        ensure!(answer.stdout.contains(words) && answer.stdout.ends_with(status), "{words}: {}", answer.output());
    }
    let answer = asks("body", &made("good.csr")?)?.expect_success()?;
    ensure!(answer.stdout.ends_with("200"), "{}", answer.output());
    // Unknown robots, and robots outside of their services.
    for (arguments, words) in [
        (&["pair", "a b"][..], "robot"),
        (&["pair", "root"], "is a reserved name"),
        (&["pair", "r", "--ttl", "8d"], "at most 7d"),
        (&["pair", "r", "--address", "nowhere"], "--address HOST:PORT"),
        (&["pair", "r", "--own-certificate"], "client_authorities"),
        (&["pair", "r", "--cancel"], "no pending pairing code"),
    ] {
        deployer.run(arguments)?.expect_failure(&[words])?;
    }
    // Pairing is not possible in plain text.
    let plain = world().setup("unpaired-plain").start()?;
    plain.deployer().run(&["pair", "rover1"])?.expect_failure(&["over TLS", "serve = \"tls\""])?;
    let (status, body) = plain.request("POST", "/api/v1/pair", &[])?;
    ensure!(status == 400 && body.contains("over TLS"), "{status} {body}");
    Ok(())
}

/// Requests created by another program, and a certificate instead of one.
const REQUESTS: &str = r#"
ec="-newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -keyout key"
openssl req -new $ec -subj /CN=robot:rover3 -out good.csr
openssl req -new $ec -subj /CN=robot:rover4 -out other.csr
openssl req -new -newkey rsa:1024 -nodes -keyout key -subj /CN=robot:rover3 -out rsa.csr
openssl req -new -newkey ec -pkeyopt ec_paramgen_curve:P-384 -nodes -keyout key -subj /CN=robot:rover3 -out curve.csr
openssl req -x509 $ec -subj /CN=robot:rover3 -out ca.pem
"#;

pub fn a_labs_own_authority_speaks_for_its_robots() -> Verdict {
    let place = world().directory("authority")?;
    run(Command::new("sh").args(["-euc", AUTHORITY]).current_dir(place.path()))?.expect_success()?;
    let at = |name: &str| place.path().join(name);
    let named = format!("client_authorities = {:?}\n", at("lab.pem"));
    let daemon = secure_setup("lab", &named).start()?;
    let deployer = daemon.deployer();
    let asks = |name: &str| {
        let (certificate, key) = (at(&format!("{name}.pem")), at(&format!("{name}.key")));
        curl(&daemon, "/api/v1/whoami", Some((&certificate, &key)), &[])
    };
    let says = |name: &str, words: &str, status: &str| -> Verdict {
        let answer = asks(name)?.expect_success()?;
        ensure!(
            answer.stdout.contains(words) && answer.stdout.ends_with(status),
            "{name}, {words}: {}",
            answer.output()
        );
        Ok(())
    };
    says("r1", "robot r1 is not paired", "401")?;
    deployer.run(&["pair", "r1", "--services", "det*", "--own-certificate"])?.expect_success()?;
    says("r1", "\"robot\":\"r1\"", "200")?;
    says("person", "names no robot", "401")?;
    // With the corresponding TLS alert (RFC 8446, section 6.2).
    for (name, alert) in [("stranger", "unknown ca"), ("over", "certificate expired")] {
        let refused = asks(name)?;
        ensure!(refused.status != 0 && refused.stderr.to_lowercase().contains(alert), "{name}: {}", refused.output());
    }
    let listed = deployer.run(&["pair", "--list"])?.expect_success()?;
    ensure!(listed.stdout.contains("own certificate"), "{}", listed.output());
    deployer.run(&["unpair", "r1"])?.expect_success()?;
    says("r1", "robot r1 was unpaired", "401")
}

/// Creates two authorities, certificates of one of which are to be accepted, one of them expired from the start.
const AUTHORITY: &str = r#"
new="-newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes"
for name in lab foreign; do
  openssl req -x509 $new -keyout $name.key -out $name.pem -days 2 -subj /CN=$name -addext keyUsage=keyCertSign
done
signs() {
  openssl req $new -keyout $2.key -out csr -subj "$3"
  echo extendedKeyUsage=clientAuth > extensions
  openssl x509 -req -in csr -CA $1.pem -CAkey $1.key -CAcreateserial -days $4 -extfile extensions -out $2.pem
}
signs lab r1 /CN=robot:r1 2
signs lab person /CN=alice 2
signs lab over /CN=robot:r1 0
signs foreign stranger /CN=robot:r1 2
# It is good to the end of its last second.
end=$(date -d "$(openssl x509 -enddate -noout -in over.pem | cut -d = -f 2)" +%s)
while [ "$(date +%s)" -le "$end" ]; do sleep 0.1; done
"#;

pub fn a_stub_is_installed_and_paired_by_one_line() -> Verdict {
    let daemon = secure_setup("installed", "").start()?;
    let deployer = daemon.deployer();
    deployer.push(TELLER.name, TELLER.arguments)?.expect_success()?;
    let place = world().directory("stub")?;
    deployer.run(&["stub", "teller_py", "-o", path_str(place.path())])?.expect_success()?;
    let machine = Machine::new()?;
    machine.unpack(&place.path().join("teller_py.tar.gz"))?;
    let line = pairing_line(&daemon, &["rover1"])?;
    // The key in the line is checked before anything from the archive is executed.
    let at = line.find("key=").context("a key")? + 30;
    let letter = if &line[at..=at] == "A" { "B" } else { "A" };
    let other = format!("{}{letter}{}", &line[..at], &line[at + 1..]);
    machine
        .run_script("sh", &format!("sh teller_py-stub/install.sh --pair '{other}'"))?
        .expect_failure(&["another key than the one this robot knows"])?;
    let unlike = machine.run_script("sh", "sh teller_py-stub/install.sh --pair 'https://x'")?;
    unlike.expect_failure(&["--pair", "cloudroid://"])?;
    let script = format!(
        r#"set -e
sh teller_py-stub/install.sh --pair '{line}'
stat -c '%a %n' .config/cloudroid/robot.key
cat /opt/cloudroid/share/teller_py/stub.toml
. /opt/cloudroid/setup.sh
/opt/cloudroid/lib/teller_py/cloudroid-stub doctor --only server"#
    );
    let outcome = machine.run_script("bash", &script)?.expect_success()?;
    for words in [
        "This robot is paired with",
        "600 .config/cloudroid/robot.key",
        "server = \"wss://127.0.0.1",
        "this robot is paired as rover1",
    ] {
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    // The key from the archive was not asked about.
    ensure!(!outcome.stderr.contains("trusting the key that came"), "{}", outcome.output());
    Ok(())
}
