//! A page in a real browser (Chromium), with roslib in it, that shows a token in each way that a page can.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, mpsc};

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::patience::{self, Patient};
use support::world::world;
use support::{Verdict, binaries};

use crate::access::{daemon, pushes_adder, token};

/// Adds two numbers over connections that show the token in the way that each is named by, and tells what came of it.
const PAGE: &str = r#"<!doctype html>
<title>A robot's page</title>
<script>
// roslib cannot be told of subprotocols: those that are offered next.
let offered;
window.WebSocket = new Proxy(window.WebSocket, {
  construct: (Native, [url]) => offered ? new Native(url, offered) : new Native(url),
});
</script>
<script src="/roslib.js"></script>
<script>
const adds = (url, prepare, protocols) => new Promise((resolve) => {
  offered = protocols;
  const ros = new ROSLIB.Ros();
  ros.on('error', () => resolve('refused'));
  ros.on('close', () => resolve('closed'));
  ros.on('connection', () => {
    prepare(ros);
    const adder = new ROSLIB.Service({ ros, name: '/add_two', serviceType: 'adder_py/AddTwo' });
    adder.callService({ a: 40, b: 2 }, (answer) => { resolve(answer.sum); ros.close(); }, resolve);
  });
  ros.connect(url);
});
(async () => {
  const asked = await (await fetch('/asked')).json();
  const said = {};
  for (const [whose, token] of Object.entries(asked.tokens)) {
    const { url } = asked;
    said[whose] = {
      query: await adds(`${url}&token=${token}`, () => {}),
      auth: await adds(url, (ros) => ros.authenticate(token, 'page', 'portal', 'x', 0, 'robot', 0)),
      subprotocol: await adds(url, () => {}, ['rosbridge', `bearer.${token}`]),
    };
  }
  await fetch('/said', { method: 'POST', body: JSON.stringify(said) });
})().catch((error) => fetch('/said', { method: 'POST', body: JSON.stringify(String(error)) }));
</script>
"#;

/// A browser, which ends with this value.
pub struct Browser(Child);

impl Browser {
    /// Opens a page, with more words of its command line.
    pub fn opens(url: &str, profile: &std::path::Path, more: &[&str]) -> anyhow::Result<Browser> {
        let child = Command::new("chromium")
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-dev-shm-usage",
            ])
            .args([
                "--no-first-run",
                "--disable-background-networking",
                "--disable-component-update",
            ])
            .arg(format!("--user-data-dir={}", profile.display()))
            .args(more)
            .arg(url)
            // What it leaves behind goes with the profile.
            .env("TMPDIR", profile)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .context("chromium, which make deps installs")?;
        Ok(Browser(child))
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// What a browser asks a site of a story for: the head of its request, and the body.
pub fn request(stream: &TcpStream) -> anyhow::Result<(String, Vec<u8>)> {
    let mut reader = BufReader::new(Patient::new(stream.try_clone()?)?);
    let (mut head, mut length) = (String::new(), 0);
    while reader.read_line(&mut head)? > 2 {
        let line = head.lines().last().unwrap_or_default().to_lowercase();
        if let Some(value) = line.strip_prefix("content-length:") {
            length = value.trim().parse()?;
        }
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body)?;
    Ok((head, body))
}

/// What the page asks for, and where what it says goes.
struct Site {
    roslib: Vec<u8>,
    asked: String,
    said: mpsc::Sender<Value>,
}

impl Site {
    /// Answers every connection by a thread of its own: browsers open some that they may not use.
    fn serve(self, listener: TcpListener) {
        let site = Arc::new(self);
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let site = Arc::clone(&site);
                std::thread::spawn(move || site.answer(stream));
            }
        });
    }

    fn answer(&self, mut stream: TcpStream) -> anyhow::Result<()> {
        let (head, body) = request(&stream)?;
        let path = head.split(' ').nth(1).unwrap_or_default();
        let (kind, answer) = match path {
            "/" => ("text/html", PAGE.as_bytes()),
            "/roslib.js" => ("text/javascript", &*self.roslib),
            "/asked" => ("application/json", self.asked.as_bytes()),
            _ => ("text/plain", &[][..]),
        };
        if path == "/said" {
            self.said.send(serde_json::from_slice(&body)?)?;
        }
        write!(
            stream,
            "HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
            answer.len()
        )?;
        Ok(stream.write_all(answer)?)
    }
}

pub fn a_page_with_roslib_shows_its_token() -> Verdict {
    let daemon = daemon("browser")?;
    let admin = token(&daemon, &["admin", "--role", "admin"])?;
    pushes_adder(&daemon, &admin, &[])?.succeeded()?;
    let robot = |name: &str, service: &str| {
        let words = [
            name,
            "--role",
            "robot",
            "--robot",
            name,
            "--service",
            service,
        ];
        token(&daemon, &words)
    };
    let (page, other) = (robot("page", "adder_py")?, robot("other", "other_*")?);
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let port = listener.local_addr()?.port();
    let (sender, said) = mpsc::channel();
    let asked = json!({
        "url": daemon.url("adder_py?robot=page"),
        "tokens": {"own": page, "another's": other, "unknown": "0".repeat(52)},
    });
    let site = Site {
        roslib: std::fs::read(binaries::node_modules().join("roslib/build/roslib.min.js"))?,
        asked: asked.to_string(),
        said: sender,
    };
    site.serve(listener);
    let profile = world().directory("profile")?;
    let browser = Browser::opens(&format!("http://127.0.0.1:{port}/"), profile.path(), &[])?;
    let said = patience::receive(&said);
    drop(browser);
    let said = said.context("the page said nothing")?;
    for way in ["query", "auth", "subprotocol"] {
        ensure!(said["own"][way] == 42, "{way}: {said}");
        for whose in ["another's", "unknown"] {
            let came = &said[whose][way];
            ensure!(
                came == "refused" || came == "closed",
                "{whose} {way}: {said}"
            );
        }
    }
    Ok(())
}
