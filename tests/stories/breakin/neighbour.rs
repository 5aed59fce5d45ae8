//! Another computer in the network, which reaches the portal's port and has no token.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::daemon::Daemon;
use support::deployer::{CommandOutcome, path_str, run};
use support::patience::tell_patience;
use support::world::world;
use support::{Verdict, binaries};

use super::scene::server_state;
use crate::access::create_token;
use crate::people::{self, PASSWORD};
use crate::tokens::read_routes;

/// A network namespace connected to this machine's own, until drop.
struct NeighbourNetwork {
    name: String,
    /// Device of this machine, and its address.
    end: String,
    address: String,
}

impl NeighbourNetwork {
    fn new() -> anyhow::Result<NeighbourNetwork> {
        let id = std::process::id();
        // From a range for documentation (RFC 5737) that no other story uses.
        let low = id % 60 * 4;
        let network = NeighbourNetwork {
            name: format!("cloudroid-neighbour-{id}"),
            end: format!("cn{id}"),
            address: format!("198.51.100.{}", low + 1),
        };
        let there = format!("ct{id}");
        let (name, end) = (network.name.as_str(), network.end.as_str());
        let (own, theirs) = (format!("{}/30", network.address), format!("198.51.100.{}/30", low + 2));
        for words in [
            &["netns", "add", name][..],
            &["link", "add", end, "type", "veth", "peer", "name", &there, "netns", name],
            &["addr", "add", &own, "dev", end],
            &["link", "set", end, "up"],
            &["-n", name, "addr", "add", &theirs, "dev", &there],
            &["-n", name, "link", "set", &there, "up"],
        ] {
            run(Command::new("ip").args(words))?.expect_success()?;
        }
        Ok(network)
    }

    /// Runs a program in the namespace.
    fn run(&self, program: &Path, arguments: &[&str]) -> anyhow::Result<CommandOutcome> {
        run(tell_patience(&mut Command::new("ip")).args(["netns", "exec", &self.name]).arg(program).args(arguments))
    }
}

impl Drop for NeighbourNetwork {
    fn drop(&mut self) {
        let _ = run(Command::new("ip").args(["link", "del", &self.end]));
        let _ = run(Command::new("ip").args(["netns", "del", &self.name]));
    }
}

/// Creates certificates that are not trusted, each with its key: signed by another authority, by itself, and by a
/// robot's certificate.
const CERTIFICATES: &str = r#"
new="-newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes"
openssl req -x509 $new -keyout self.key -out self.pem -days 2 -subj /CN=robot:rover1 -addext subjectAltName=URI:robot:rover1
openssl req -x509 $new -keyout ca.key -out ca.pem -days 2 -subj "$AUTHORITY" -addext keyUsage=keyCertSign
echo 'subjectAltName=URI:robot:rover1' > names
for by in ca robot; do
  openssl req $new -keyout $by-other.key -out $by.csr -subj /CN=robot:rover1
  openssl x509 -req -in $by.csr -CA $by.pem -CAkey $by.key -CAcreateserial -days 2 -extfile names -out $by-leaf.pem
  cat $by-leaf.pem $by.pem > $by-other.pem
done
"#;

/// Pairs robot rover2; returns its certificate and key, and forged ones, by name.
fn make_certificates(daemon: &Daemon, place: &Path) -> anyhow::Result<Value> {
    let made = daemon.deployer().run_json(&["pair", "rover2", "--services", "none_*"])?;
    let line = made["line"].as_str().context("a line")?;
    let own = place.join("own");
    run(Command::new(binaries::path("stubs/x86_64/cloudroid-stub"))
        .args(["pair", line])
        .env("CLOUDROID_IDENTITY", &own))?
    .expect_success()?;
    let kept = std::fs::read_dir(own.join("paired"))?.next().context("a pairing")??;
    let text = std::fs::read_to_string(kept.path())?.replace("\\n", "\n");
    let begin = text.find("-----BEGIN").context("a certificate")?;
    let end = text.find("-----END CERTIFICATE-----").context("its end")?;
    std::fs::write(place.join("robot.pem"), format!("{}-----END CERTIFICATE-----\n", &text[begin..end]))?;
    std::fs::copy(own.join("robot.key"), place.join("robot.key"))?;
    // The other authority has the same name as the daemon's.
    let issuer = run(Command::new("openssl")
        .args(["x509", "-noout", "-issuer", "-nameopt", "compat", "-in"])
        .arg(place.join("robot.pem")))?
    .expect_success()?;
    let authority = issuer.stdout.trim().trim_start_matches("issuer=").trim().to_owned();
    run(Command::new("sh")
        .args(["-euc", CERTIFICATES])
        .env("AUTHORITY", if authority.starts_with('/') { authority } else { "/CN=authority".to_owned() })
        .current_dir(place))?
    .expect_success()?;
    let pair = |certificate: &str, key: &str| -> [PathBuf; 2] { [place.join(certificate), place.join(key)] };
    Ok(json!({
        "that signs itself": pair("self.pem", "self.key"),
        "of another authority": pair("ca-other.pem", "ca-other.key"),
        "of another authority, alone": pair("ca-leaf.pem", "ca-other.key"),
        "that another robot's has signed": pair("robot-other.pem", "robot-other.key"),
        "that another robot's has signed, alone": pair("robot-leaf.pem", "robot-other.key"),
        "of an authority itself": pair("ca.pem", "ca.key"),
    }))
}

/// Returns the daemon's listening sockets by protocol and address: lines of the kernel's tables (proc(5)) that belong
/// to its descriptors.
fn listening_addresses(pid: i32) -> anyhow::Result<BTreeSet<String>> {
    let mut own = BTreeSet::new();
    for entry in std::fs::read_dir(format!("/proc/{pid}/fd"))?.flatten() {
        if let Ok(link) = std::fs::read_link(entry.path()) {
            own.insert(link.display().to_string());
        }
    }
    let mut found = BTreeSet::new();
    for table in ["tcp", "tcp6", "udp", "udp6", "udplite", "raw", "raw6"] {
        let text = std::fs::read_to_string(format!("/proc/{pid}/net/{table}")).unwrap_or_default();
        for line in text.lines().skip(1) {
            let fields: Vec<&str> = line.split_whitespace().collect();
            let (local, state, inode) = (fields[1], fields[3], fields[9]);
            let waits = !table.starts_with("tcp") || state == "0A";
            if waits && own.contains(&format!("socket:[{inode}]")) {
                found.insert(format!("{table} {local}"));
            }
        }
    }
    Ok(found)
}

/// Returns whether `came` is an acceptable result of an attempt; for attempts without a rule, anything but the
/// requested data is.
fn is_allowed_outcome(name: &str, came: &str) -> bool {
    let refused = came.starts_with("refused") || came == "ended";
    match name.split(' ').next().unwrap_or_default() {
        "plain" => came == "400",
        "certificate" => refused || came == "401",
        "version" | "ciphers" => came.starts_with("refused"),
        "header" => came == "401" || came == "400",
        "name" => came == "401",
        "protocols" => refused || came == "401",
        // A TLS alert, or the remark that the port speaks https.
        "bytes" => refused || came == "400" || came.starts_with("15"),
        "renegotiation" => refused,
        "health" => came == "200",
        "guesses" => came == "429",
        _ => came == "401",
    }
}

/// Routes that answer everyone.
const OPEN: [(&str, &str); 10] = [
    ("ANY /", "200"),
    ("GET /", "200"),
    ("GET /healthz", "200"),
    ("GET /assets/x", "404"),
    ("GET /api/v1/session", "200"),
    ("POST /api/v1/session", "400"),
    ("POST /api/v1/pair", "400"),
    // No identity provider is configured.
    ("GET /api/v1/oidc/login", "404"),
    ("GET /api/v1/oidc/callback", "404"),
    ("GET /no_such_service", "401"),
];

pub fn a_neighbour_gets_no_further_than_the_door() -> Verdict {
    let network = NeighbourNetwork::new()?;
    let daemon = world()
        .setup("breakin-neighbour")
        .listen(&format!("{}:0", network.address))
        .config("tokens = [\"open sesame\"]\n[tls]\nserve = \"tls\"\n[portal]\nhandshake = \"5s\"\n")
        .start()?;
    create_token(&daemon, &["chief", "--role", "admin"])?;
    people::run_account(&daemon, &["create", "alice", "--role", "admin"], PASSWORD)?.expect_success()?;
    let place = world().directory("neighbour")?;
    let certificates = make_certificates(&daemon, place.path())?;
    let before = server_state(&daemon)?;
    let (host, port) = daemon.address.rsplit_once(':').context("a port")?;
    let routes: Vec<_> = read_routes()?
        .into_iter()
        .map(|(method, path)| (if method == "ANY" { "GET".to_owned() } else { method }, path))
        .collect();
    let asked = json!({
        "host": host,
        "port": port.parse::<u16>()?,
        "routes": routes,
        "token": "open sesame",
        "certificates": certificates,
    });
    let script = binaries::checkout().join("tests/stories/breakin/neighbour.py");
    let told = network.run(&binaries::python(), &[path_str(&script), &asked.to_string()])?.expect_success()?;
    let mut tried = 0;
    for line in told.stdout.lines() {
        let one: Value = serde_json::from_str(line).with_context(|| line.to_owned())?;
        let (name, came) = (one["name"].as_str().unwrap_or_default(), one["came"].as_str().unwrap_or_default());
        let open = OPEN.contains(&(name, came));
        ensure!(open || is_allowed_outcome(name, came), "{name}: {came}");
        tried += 1;
    }
    ensure!(server_state(&daemon)? == before, "{before:#}");
    // There is no other listening socket.
    let doors = listening_addresses(daemon.pid())?;
    ensure!(doors.len() == 1 && doors.iter().all(|door| door.starts_with("tcp ")), "{doors:?}");
    println!("{tried} attempts");
    ensure!(tried > 180, "{tried}: {}", told.output());
    Ok(())
}
