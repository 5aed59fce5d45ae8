//! A page in a real browser (Chromium) that uses roslib and shows a token in every way that a page can.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, mpsc};

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::patience::{self, PatientStream};
use support::world::world;
use support::{Verdict, binaries};

use crate::access::{create_token, daemon, push_adder};

/// Adds two numbers over connections named after the way in which they show the token, and reports the results.
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

/// A browser, which is killed on drop.
pub struct ChromiumBrowser(Child);

impl ChromiumBrowser {
    /// Opens a page, with further command-line arguments.
    pub fn open(url: &str, profile: &std::path::Path, more: &[&str]) -> anyhow::Result<ChromiumBrowser> {
        let child = Command::new("chromium")
            .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"])
            .args(["--no-first-run", "--disable-background-networking", "--disable-component-update"])
            .arg(format!("--user-data-dir={}", profile.display()))
            .args(more)
            .arg(url)
            // Temporary files are removed together with the profile.
            .env("TMPDIR", profile)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .context("chromium, which make deps installs")?;
        Ok(ChromiumBrowser(child))
    }
}

impl Drop for ChromiumBrowser {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Reads a browser's request: the head and the body.
pub fn read_request(stream: &TcpStream) -> anyhow::Result<(String, Vec<u8>)> {
    let mut reader = BufReader::new(PatientStream::new(stream.try_clone()?)?);
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

/// Files of the page, and the channel for its reports.
struct PageSite {
    roslib: Vec<u8>,
    asked: String,
    said: mpsc::Sender<Value>,
}

impl PageSite {
    /// Answers every connection on a thread of its own, because browsers open connections that they may not use.
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
        let (head, body) = read_request(&stream)?;
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
    let admin = create_token(&daemon, &["admin", "--role", "admin"])?;
    push_adder(&daemon, &admin, &[])?.expect_success()?;
    let robot = |name: &str, service: &str| {
        let words = [name, "--role", "robot", "--robot", name, "--service", service];
        create_token(&daemon, &words)
    };
    let (page, other) = (robot("page", "adder_py")?, robot("other", "other_*")?);
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let port = listener.local_addr()?.port();
    let (sender, said) = mpsc::channel();
    let asked = json!({
        "url": daemon.url("adder_py?robot=page"),
        "tokens": {"own": page, "another's": other, "unknown": "0".repeat(52)},
    });
    let site = PageSite {
        roslib: std::fs::read(binaries::node_modules().join("roslib/build/roslib.min.js"))?,
        asked: asked.to_string(),
        said: sender,
    };
    site.serve(listener);
    let profile = world().directory("profile")?;
    let browser = ChromiumBrowser::open(&format!("http://127.0.0.1:{port}/"), profile.path(), &[])?;
    let said = patience::receive(&said);
    drop(browser);
    let said = said.context("the page said nothing")?;
    for way in ["query", "auth", "subprotocol"] {
        ensure!(said["own"][way] == 42, "{way}: {said}");
        for whose in ["another's", "unknown"] {
            let came = &said[whose][way];
            ensure!(came == "refused" || came == "closed", "{whose} {way}: {said}");
        }
    }
    Ok(())
}
