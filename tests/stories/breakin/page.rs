//! Pages of other sites in the browser of a portal user: a real Chromium, whose pages make every attempt that pages
//! can.
//!
//! ```text
//!  127.0.0.1:PORT    another web server of this machine: same site, and gets the portal's cookie
//!  evil.example:PORT another site
//!  rebound:PORT      a name that resolved to that site and now resolves to the portal: requests for anything
//!                    but the page go there
//! ```

use std::io::Write;
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, mpsc};

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::patience::{self, PatientStream};
use support::world::world;

use super::scene::server_state;
use crate::browser::{ChromiumBrowser, read_request};
use crate::people::{self, PASSWORD};

/// The page moves from one origin to the next and reports the result of each attempt.
const PAGE: &str = include_str!("page.html");
/// Host at which the browser opens it.
const FIRST: &str = "127.0.0.1";
const SITES: [&str; 3] = [FIRST, "evil.example", "rebound.example"];

/// The web server for all three names.
struct HostileSite {
    portal: String,
    cookie: String,
    asked: Value,
    said: mpsc::Sender<Value>,
}

impl HostileSite {
    fn answer(&self, mut stream: TcpStream) -> anyhow::Result<()> {
        let (head, body) = read_request(&stream)?;
        let path = head.split(' ').nth(1).unwrap_or_default();
        let path = path.split('?').next().unwrap_or_default();
        let asked = self.asked.to_string();
        let (kind, answer) = match path {
            "/page" => ("text/html", PAGE),
            "/page/asked" => ("application/json", &*asked),
            "/page/said" => {
                self.said.send(serde_json::from_slice(&body)?)?;
                ("text/plain", "")
            }
            _ if head.to_lowercase().contains("host: rebound.example") => {
                return self.forward_to_portal(stream, &head, &body);
            }
            _ => ("text/plain", "nothing"),
        };
        // As the portal sets it; the browser sends it to all ports of a host.
        let cookie = match path {
            "/page" if head.contains(FIRST) => {
                format!("Set-Cookie: {}; Path=/; HttpOnly; SameSite=Strict\r\n", self.cookie)
            }
            _ => String::new(),
        };
        write!(
            stream,
            "HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\n{cookie}Content-Length: {}\r\nConnection: \
             close\r\n\r\n{answer}",
            answer.len()
        )?;
        Ok(())
    }

    /// Forwards a request to the portal unchanged.
    fn forward_to_portal(&self, stream: TcpStream, head: &str, body: &[u8]) -> anyhow::Result<()> {
        let mut portal = TcpStream::connect(&self.portal)?;
        // One request per connection, because the next one may be for this server.
        let head = head.replace("Connection: keep-alive", "Connection: close");
        portal.write_all(head.as_bytes())?;
        portal.write_all(body)?;
        let (mut from, mut to) = (PatientStream::new(portal.try_clone()?)?, stream.try_clone()?);
        let back = std::thread::spawn(move || {
            let _ = std::io::copy(&mut from, &mut to);
            let _ = to.shutdown(Shutdown::Both);
        });
        let _ = std::io::copy(&mut PatientStream::new(stream)?, &mut portal);
        let _ = portal.shutdown(Shutdown::Both);
        let _ = back.join();
        Ok(())
    }
}

/// Lets the pages make all their attempts against a daemon to which the user is signed in with `cookie`; returns the
/// results.
fn try_from_pages(daemon: &Daemon, cookie: &str) -> anyhow::Result<Vec<Value>> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let port = listener.local_addr()?.port();
    let (sender, said) = mpsc::channel();
    let (_, own) = daemon.address.rsplit_once(':').context("a port")?;
    let sites: Vec<String> = SITES.iter().map(|name| format!("http://{name}:{port}")).collect();
    let site = Arc::new(HostileSite {
        portal: daemon.address.clone(),
        cookie: cookie.to_owned(),
        asked: json!({
            "sites": sites,
            "portals": [format!("http://127.0.0.1:{own}"), format!("http://localhost:{own}")],
        }),
        said: sender,
    });
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let site = Arc::clone(&site);
            std::thread::spawn(move || site.answer(stream));
        }
    });
    let profile = world().directory("profile")?;
    let leads = "--host-resolver-rules=MAP *.example 127.0.0.1";
    let browser = ChromiumBrowser::open(&format!("{}/page?0", sites[0]), profile.path(), &[leads])?;
    let mut all = Vec::new();
    for site in &sites {
        let told = patience::receive(&said);
        let told = told.with_context(|| format!("{site} said nothing"))?;
        let told = told.as_array().with_context(|| format!("{site}: {told}"))?;
        all.extend(told.iter().cloned());
    }
    drop(browser);
    Ok(all)
}

/// Fails if an attempt has succeeded; returns the number of attempts.
fn count_failed(whose: &str, came: &[Value]) -> anyhow::Result<usize> {
    let ended: Vec<&Value> = came.iter().filter(|one| one["failed"] != true).collect();
    ensure!(ended.is_empty(), "{whose}: {ended:#?}");
    Ok(came.len())
}

pub fn a_page_of_another_site_reaches_nothing_in_a_real_browser() -> Verdict {
    // On a machine without principals, where every local client sees everything.
    let open = world().setup("breakin-page-open").start()?;
    let before = server_state(&open)?;
    let mut tried = count_failed("without tokens", &try_from_pages(&open, "cloudroid=none")?)?;
    ensure!(server_state(&open)? == before, "{before:#}");
    drop(open);
    // With a user who is signed in.
    let daemon = world().setup("breakin-page").start()?;
    people::run_account(&daemon, &["create", "alice", "--role", "admin"], PASSWORD)?.expect_success()?;
    let alice = people::SignedInBrowser::sign_in(&daemon, "alice", PASSWORD)?;
    let before = server_state(&daemon)?;
    tried += count_failed("signed in", &try_from_pages(&daemon, &alice.cookie)?)?;
    ensure!(server_state(&daemon)? == before, "{before:#}");
    ensure!(alice.request("GET", "/api/v1/tokens")?.0 == 200, "she is signed in still");
    println!("{tried} attempts");
    ensure!(tried > 1000, "{tried}");
    Ok(())
}
