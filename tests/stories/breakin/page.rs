//! Pages of other sites in the browser of somebody who uses the portal: a real Chromium, whose pages try what pages can.
//!
//! ```text
//!  127.0.0.1:PORT    another web server of this machine: same site, and shown the portal's cookie
//!  evil.example:PORT another site
//!  rebound:PORT      a name that led to that site, and leads to the portal by now: what is not the page's goes there
//! ```

use std::io::Write;
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, mpsc};

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::patience::{self, Patient};
use support::world::world;

use super::scene::state;
use crate::browser::{Browser, request};
use crate::people::{self, PASSWORD};

/// Goes through its positions, from one to the next, and tells what came of each attempt.
const PAGE: &str = include_str!("page.html");
/// Where the browser opens it.
const FIRST: &str = "127.0.0.1";
const SITES: [&str; 3] = [FIRST, "evil.example", "rebound.example"];

/// A site of all three names.
struct Site {
    portal: String,
    cookie: String,
    asked: Value,
    said: mpsc::Sender<Value>,
}

impl Site {
    fn answer(&self, mut stream: TcpStream) -> anyhow::Result<()> {
        let (head, body) = request(&stream)?;
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
                return self.pass_on(stream, &head, &body);
            }
            _ => ("text/plain", "nothing"),
        };
        // As the portal sets it, which the browser keeps for all ports of a host.
        let cookie = match path {
            "/page" if head.contains(FIRST) => format!(
                "Set-Cookie: {}; Path=/; HttpOnly; SameSite=Strict\r\n",
                self.cookie
            ),
            _ => String::new(),
        };
        write!(
            stream,
            "HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\n{cookie}Content-Length: {}\r\nConnection: close\r\n\r\n{answer}",
            answer.len()
        )?;
        Ok(())
    }

    /// Gives a request to the portal as it is.
    fn pass_on(&self, stream: TcpStream, head: &str, body: &[u8]) -> anyhow::Result<()> {
        let mut portal = TcpStream::connect(&self.portal)?;
        // One request for each connection: the next one may be the site's.
        let head = head.replace("Connection: keep-alive", "Connection: close");
        portal.write_all(head.as_bytes())?;
        portal.write_all(body)?;
        let (mut from, mut to) = (Patient::new(portal.try_clone()?)?, stream.try_clone()?);
        let back = std::thread::spawn(move || {
            let _ = std::io::copy(&mut from, &mut to);
            let _ = to.shutdown(Shutdown::Both);
        });
        let _ = std::io::copy(&mut Patient::new(stream)?, &mut portal);
        let _ = portal.shutdown(Shutdown::Both);
        let _ = back.join();
        Ok(())
    }
}

/// Has the pages try all they know at a daemon whose page somebody is signed in to, by `cookie`; gives what came of it.
fn tries(daemon: &Daemon, cookie: &str) -> anyhow::Result<Vec<Value>> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let port = listener.local_addr()?.port();
    let (sender, said) = mpsc::channel();
    let (_, own) = daemon.address.rsplit_once(':').context("a port")?;
    let sites: Vec<String> = SITES
        .iter()
        .map(|name| format!("http://{name}:{port}"))
        .collect();
    let site = Arc::new(Site {
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
    let browser = Browser::opens(&format!("{}/page?0", sites[0]), profile.path(), &[leads])?;
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

/// Refuses what a page has learnt or done.
fn came_to_nothing(whose: &str, came: &[Value]) -> anyhow::Result<usize> {
    let ended: Vec<&Value> = came.iter().filter(|one| one["failed"] != true).collect();
    ensure!(ended.is_empty(), "{whose}: {ended:#?}");
    Ok(came.len())
}

pub fn a_page_of_another_site_reaches_nothing_in_a_real_browser() -> Verdict {
    // On a machine whose configuration names nobody: who asks from here sees everything.
    let open = world().own("breakin-page-open").start()?;
    let before = state(&open)?;
    let mut tried = came_to_nothing("without tokens", &tries(&open, "cloudroid=none")?)?;
    ensure!(state(&open)? == before, "{before:#}");
    drop(open);
    // Where somebody is signed in.
    let daemon = world().own("breakin-page").start()?;
    people::account(&daemon, &["create", "alice", "--role", "admin"], PASSWORD)?.succeeded()?;
    let alice = people::Browser::signs_in(&daemon, "alice", PASSWORD)?;
    let before = state(&daemon)?;
    tried += came_to_nothing("signed in", &tries(&daemon, &alice.cookie)?)?;
    ensure!(state(&daemon)? == before, "{before:#}");
    ensure!(
        alice.asks("GET", "/api/v1/tokens")?.0 == 200,
        "she is signed in still"
    );
    println!("{tried} attempts");
    ensure!(tried > 1000, "{tried}");
    Ok(())
}
