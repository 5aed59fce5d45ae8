//! TLS: the daemon's own, and that of a proxy in front with an authority of the owner.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, ensure};
use support::daemon::Daemon;
use support::deployer::{CommandOutcome, run};
use support::machine::{Machine, free_port};
use support::patience::{PatientStream, connect, patience};
use support::site::Site;
use support::tls::TlsProxy;
use support::world::{ADDER, TELLER, world};
use support::{Verdict, binaries, wait_until};

pub fn a_robot_works_through_tls() -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    let proxy = TlsProxy::start(&daemon.address)?;
    let machine = Machine::with_stub(&daemon, "teller_py")?;
    machine.install_file(&proxy.authority(), "/root/authority.pem", 0o644)?;
    let install = format!("sh teller_py-stub/install.sh --robot secure --server wss://localhost:{}", proxy.port);
    // This machine has no certificate authorities installed.
    machine.run_script("sh", &install)?.expect_failure(&[
        "no certificate authorities are installed on this robot",
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
timeout "$PATIENCE" rostopic echo -n 1 -p /teller/told
cat said"#
    );
    let outcome = machine.run_script("bash", &script)?.expect_success()?;
    for words in ["ok    server     wss://localhost", "ok    service", "life 1 of /teller", "linked to wss://localhost"]
    {
        ensure!(outcome.stdout.contains(words), "{words}: {}", outcome.output());
    }
    Ok(())
}

pub fn what_stands_against_tls_is_said() -> Verdict {
    let daemon = world().daemon_with(TELLER)?;
    let proxy = TlsProxy::start(&daemon.address)?;
    let site = Site::new()?;
    let other = TlsProxy::start(&daemon.address)?;
    let authority = format!("ca_file = {:?}\n", proxy.authority());
    let stranger = format!("ca_file = {:?}\n", other.authority());
    let mistaken = TlsProxy::with_ca_certificate(&daemon.address)?;
    let itself = format!("ca_file = {:?}\n", mistaken.authority());
    let mistaken = format!("127.0.0.1:{}", mistaken.port);
    let plain = daemon.address.clone();
    let secure = format!("127.0.0.1:{}", proxy.port);
    for (server, authority, words) in [
        (&secure, "ca_file = \"/nowhere.pem\"\n", "/nowhere.pem"),
        (&secure, "ca_file = \"/dev/null\"\n", "it should be a PEM file"),
        (&secure, &*stranger, "install.sh --ca FILE"),
        (&mistaken, &*itself, "issue a server certificate with it"),
        // Another name of the same machine, which is not in the certificate.
        (&format!("127.0.0.2:{}", proxy.port), &*authority, "it belongs to another server"),
        (&plain, &*authority, "try ws:// instead of wss://"),
    ] {
        let toml = format!(
            "server = \"wss://{server}\"\nservice = \"teller_py\"\nrobot = \"insecure\"\nlocal = \"none\"\n{authority}"
        );
        let stub = site.start_stub_with_config(&toml, "teller_py", "teller.py", &[])?;
        stub.wait_for_output(words)?;
    }
    Ok(())
}

const TOKENS: &str = "tokens = [\"open sesame\"]\n";

/// Requests a URL with curl, trusting the daemon's self-signed certificate.
fn curl(daemon: &Daemon, url: &str) -> anyhow::Result<CommandOutcome> {
    let own = daemon.home.join("tls/own.pem");
    run(Command::new("curl")
        .args(["--silent", "--show-error", "--max-time"])
        .arg(patience().as_secs().to_string())
        .args(["--write-out", "\n%{http_code}", "--cacert"])
        .arg(own)
        .args(["-H", "Authorization: Bearer open sesame", url]))
}

fn port(daemon: &Daemon) -> anyhow::Result<&str> {
    daemon.address.rsplit(':').next().context("a port")
}

pub fn beyond_loopback_nothing_is_answered_in_plain_text() -> Verdict {
    let daemon = world().setup("secured").config(TOKENS).listen("0.0.0.0:0").start()?;
    let port = port(&daemon)?;
    for (path, words) in [("/healthz", "ok"), ("/api/v1/services", "[]")] {
        let answer = curl(&daemon, &format!("https://localhost:{port}{path}"))?.expect_success()?;
        ensure!(answer.stdout.contains(words) && answer.stdout.ends_with("\n200"), "{path}: {}", answer.output());
        let refused = curl(&daemon, &format!("http://localhost:{port}{path}"))?.expect_success()?;
        let instead = format!("use https://localhost:{port}{path}");
        ensure!(refused.stdout.contains(&instead) && refused.stdout.ends_with("\n400"), "{path}: {}", refused.output());
    }
    // Its fingerprint is printed, and others cannot read the key.
    let shown = fingerprint(&daemon.home.join("tls/own.pem"))?;
    ensure!(daemon.log_tail().contains(&shown), "{shown}: {}", daemon.log_tail());
    let status = daemon.deployer().run(&["status"])?.expect_success()?;
    let words = format!("certificate {shown}");
    ensure!(status.stdout.contains(&words), "{}", status.output());
    // Connections that send nothing, or neither TLS nor HTTP, are closed.
    let connects = || -> anyhow::Result<PatientStream<TcpStream>> { connect(&format!("127.0.0.1:{port}")) };
    let (mut silent, mut garbled) = (connects()?, connects()?);
    garbled.write_all(&[22, 3, 1, 0, 5, 255, 255, 255, 255, 255])?;
    garbled.read_to_end(&mut Vec::new())?;
    ensure!(silent.read(&mut [0])? == 0, "who says nothing is kept");
    Ok(())
}

pub fn robots_of_all_kinds_come_through_the_daemons_tls() -> Verdict {
    let daemon = world().setup("secure-robots").config("[tls]\nserve = \"tls\"\n").start()?;
    let deployer = daemon.deployer();
    deployer.push("adder_py", ADDER.arguments)?.expect_success()?;
    let port = port(&daemon)?;
    let own = daemon.home.join("tls/own.pem");
    let url = format!("wss://localhost:{port}/{}?robot=secure", ADDER.name);
    let mut robot = Command::new(binaries::python());
    robot.arg("-c").arg(ROSLIBPY).arg(&url);
    robot.arg(patience().as_secs().to_string());
    let outcome = run(&mut robot)?.expect_success()?;
    ensure!(outcome.stdout.contains("42"), "{}", outcome.output());
    let site = Site::new()?;
    let toml = format!(
        "server = \"wss://localhost:{port}\"\nservice = \"no_such\"\nrobot = \"stub\"\nlocal = \"none\"\nca_file = \
         {own:?}\n"
    );
    let stub = site.start_stub_with_config(&toml, "no_such", "node", &[])?;
    // It got as far as an error of the portal.
    stub.wait_for_output("404")?;
    // The archive of a stub contains the certificate's fingerprint, so its robot need not trust on first use.
    let place = world().directory("archive")?;
    let archive = place.path().join("stub.tar.gz");
    let url = format!("https://localhost:{port}/stubs/{}.tar.gz", ADDER.name);
    let fetched = run(Command::new("curl")
        .args(["--silent", "--show-error", "--fail", "--cacert"])
        .arg(&own)
        .arg("--output")
        .arg(&archive)
        .arg(&url))?;
    fetched.expect_success()?;
    let settings =
        run(Command::new("tar").args(["--wildcards", "-xzOf"]).arg(&archive).arg("*/stub.toml"))?.expect_success()?;
    let server = format!("server = \"wss://localhost:{port}\"");
    let fingerprint = format!("fingerprint = \"{}\"", fingerprint(&own)?);
    for line in [&server, &fingerprint] {
        ensure!(settings.stdout.contains(line), "{line}: {}", settings.output());
    }
    // A robot that was installed before the server had TLS, and one that trusted another certificate, follow the
    // change.
    let machine = Machine::new()?;
    machine.unpack(&archive)?;
    let name = ADDER.name;
    let share = format!("/opt/cloudroid/share/{name}");
    let other = format!("SHA256:{}", "0".repeat(64));
    for (before, words) in [
        (
            format!("server = \"ws://localhost:9090\"\nservice = \"{name}\"\nmax = 0.4"),
            format!("wss://localhost:{port} instead of ws://localhost:9090"),
        ),
        (
            format!("server = \"wss://localhost:{port}\"\nservice = \"{name}\"\nfingerprint = \"{other}\"\nmax = 0.4"),
            format!("instead of {other}"),
        ),
    ] {
        let script = format!(
            "set -e\nmkdir -p {share}\ntouch {share}/revision.toml\necho '{before}' > {share}/stub.toml\n\
             sh {name}-stub/install.sh\ncat {share}/stub.toml"
        );
        let outcome = machine.run_script("sh", &script)?.expect_success()?;
        for line in [&server, &fingerprint, "max = 0.4"] {
            ensure!(outcome.stdout.contains(line), "{line}: {}", outcome.output());
        }
        ensure!(outcome.stderr.contains(&words), "{words}: {}", outcome.output());
    }
    Ok(())
}

/// Returns the fingerprint of a certificate, computed by openssl.
fn fingerprint(certificate: &Path) -> anyhow::Result<String> {
    let shown =
        run(Command::new("openssl").args(["x509", "-noout", "-fingerprint", "-sha256", "-in"]).arg(certificate))?
            .expect_success()?;
    let digits = shown.stdout.rsplit('=').next().unwrap_or_default();
    let digits = digits.trim().replace(':', "").to_lowercase();
    Ok(format!("SHA256:{digits}"))
}

pub fn a_certificate_is_remembered_and_no_other_is_taken_for_it() -> Verdict {
    let setup = world().setup("pinned").config(TOKENS);
    let daemon = setup.clone().listen("0.0.0.0:0").start()?;
    let port = port(&daemon)?.to_owned();
    let place = world().directory("user")?;
    let site = Site::new()?;
    let types = |arguments: &[&str]| {
        run(Command::new(binaries::path("cloudroidctl"))
            .args(["--token", "open sesame"])
            .args(arguments)
            .env("XDG_CONFIG_HOME", place.path()))
    };
    let server = format!("https://localhost:{port}");
    let known = place.path().join("stubs/known_servers");
    let stub = || {
        let toml = format!(
            "server = \"wss://localhost:{port}\"\nservice = \"none\"\nrobot = \"pinned\"\nlocal = \"none\"\ntoken \
             = \"open sesame\"\nknown_servers = {known:?}\n"
        );
        site.start_stub_with_config(&toml, "none", "node", &[])
    };
    let asks = ["--server", &server, "services"];
    let first = fingerprint(&daemon.home.join("tls/own.pem"))?;
    let outcome = types(&asks)?.expect_success()?;
    for words in ["first connection to", &first, "cloudroid/known_servers"] {
        ensure!(outcome.stderr.contains(words), "{words}: {}", outcome.output());
    }
    ensure!(types(&asks)?.expect_success()?.stderr.is_empty(), "known by now");
    let plain = format!("http://localhost:{port}");
    types(&["--server", &plain, "services"])?.expect_failure(&["this port requires https", &server])?;
    stub()?.wait_for_output("404")?;
    ensure!(std::fs::read_to_string(&known)?.contains(&first));
    let address = daemon.address.clone();
    daemon.stop()?;
    // Another server, or the same one with a new certificate: only the operator can tell.
    std::fs::remove_file(setup.home().join("tls/own.pem"))?;
    let daemon = setup.listen(&address).start()?;
    let other = fingerprint(&daemon.home.join("tls/own.pem"))?;
    ensure!(first != other);
    let accept = format!("cloudroidctl trust {server} {other}");
    types(&asks)?.expect_failure(&[&first, &other, &accept])?;
    stub()?.wait_for_output(&format!("install.sh --fingerprint {other}"))?;
    types(&["trust", &server, &other])?.expect_success()?;
    types(&asks)?.expect_success()?;
    Ok(())
}

pub fn a_certificate_is_read_again_when_it_changes() -> Verdict {
    let place = world().directory("certificates")?;
    let at = |name: &str| place.path().join(name);
    let makes = |name: &str| {
        run(Command::new("openssl")
            .args(["req", "-x509", "-newkey", "ec", "-pkeyopt"])
            .args(["ec_paramgen_curve:P-256", "-nodes", "-days", "2"])
            .args(["-subj", "/CN=server", "-addext", "subjectAltName=DNS:localhost"])
            .args(["-keyout", &format!("{name}.key"), "-out", &format!("{name}.pem")])
            .current_dir(place.path()))?
        .expect_success()
    };
    makes("shown")?;
    makes("next")?;
    let config = format!("[tls]\ncertificate = {:?}\nkey = {:?}\n", at("shown.pem"), at("shown.key"));
    let daemon = world().setup("renewed").config(&config).start()?;
    let port = port(&daemon)?;
    let healthy = |authority: &str| {
        let url = format!("https://localhost:{port}/healthz");
        run(Command::new("curl")
            .args(["--silent", "--show-error", "--fail", "--max-time", &patience().as_secs().to_string(), "--cacert"])
            .arg(at(authority))
            .arg(url))
    };
    std::fs::copy(at("shown.pem"), at("first.pem"))?;
    healthy("first.pem")?.expect_success()?;
    std::fs::write(at("shown.pem"), "no certificate\n")?;
    let refused =
        daemon.wait_for_event("a word about what is there now", |event| event["kind"] == "certificate-refused")?;
    let message = refused["message"].as_str().unwrap_or_default();
    let kept = fingerprint(&at("first.pem"))?;
    for words in ["shown.pem", "PEM file", &kept] {
        ensure!(message.contains(words), "{words}: {message}");
    }
    healthy("first.pem")?.expect_success()?;
    for kind in ["key", "pem"] {
        std::fs::rename(at(&format!("next.{kind}")), at(&format!("shown.{kind}")))?;
    }
    let new = fingerprint(&at("shown.pem"))?;
    daemon.wait_for_event("the new one to be shown", |event| {
        let message = event["message"].as_str().unwrap_or_default();
        event["kind"] == "certificate-shown" && message.contains(&new)
    })?;
    healthy("shown.pem")?.expect_success()?;
    ensure!(healthy("first.pem")?.status != 0, "the first is still shown");
    Ok(())
}

const ROSLIBPY: &str = r#"
import sys
import roslibpy
ros = roslibpy.Ros(sys.argv[1])
patience = float(sys.argv[2])
ros.run(timeout=patience)
adder = roslibpy.Service(ros, "/add_two", "adder_py/AddTwo")
print(adder.call(roslibpy.ServiceRequest({"a": 40, "b": 2}), timeout=patience)["sum"])
ros.terminate()
"#;

pub fn clients_of_a_named_proxy_are_told_apart() -> Verdict {
    let named = "trusted_proxies = [\"127.0.0.1\"]\n";
    let daemon = world().setup("proxied").config(&format!("{TOKENS}{named}")).start()?;
    let asks = |method: &str, path: &str, token: &str, client: &str| {
        let bearer = format!("Bearer {token}");
        let headers = [("Authorization", bearer.as_str()), ("X-Forwarded-For", client), ("X-Forwarded-Proto", "https")];
        daemon.request(method, path, &headers)
    };
    // Each wrong attempt doubles the waiting time: however slow this machine is, one comes too early.
    wait_until("who guesses to be slowed", || {
        let (status, body) = asks("GET", "/api/v1/services", "guess", "192.0.2.1")?;
        ensure!(status == 401 || status == 429, "{status} {body}");
        Ok(match status {
            429 => Ok(()),
            _ => Err(body),
        })
    })?;
    // A client cannot pretend to have another address, and others are not slowed down.
    for client in ["192.0.2.2", "192.0.2.1, 192.0.2.3"] {
        let (status, body) = asks("GET", "/api/v1/services", "guess", client)?;
        ensure!(status == 401, "{client}: {status} {body}");
    }
    let (status, _) = asks("DELETE", "/api/v1/services/none", "open sesame", "192.0.2.4")?;
    ensure!(status == 404, "{status}");
    daemon.wait_for("/api/v1/audit", "the client's address", |records| {
        let text = records.to_string();
        text.contains("192.0.2.4").then_some(())
    })?;
    let two = [("X-Forwarded-For", "192.0.2.5"), ("Forwarded", "for=192.0.2.6")];
    let (status, body) = daemon.request("GET", "/healthz", &two)?;
    ensure!(status == 400 && body.contains("two clients"), "{status} {body}");
    Ok(())
}
