//! An identity provider (npm `oidc-provider`, tests/robots/identity_provider.mjs), and browsers of people who sign in by it.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};

use anyhow::{Context, ensure};
use serde_json::{Value, json};

use crate::binaries;
use crate::daemon::{Daemon, Setup};
use crate::deployer::{path_str, run};
use crate::machine::free_port;
use crate::patience::patience;
use crate::world::{Directory, world};

/// What it shares with the daemon.
pub const SECRET: &str = "forty-two-white-elephants-in-a-row";

/// What its groups may do, unless a story says something else.
pub const ROLES: &str = "robot-admins = \"admin\", builders = { role = \"deployer\", services = [\"build_*\"] }, \
                         students = { role = \"viewer\", services = [\"lab_*\"] }";

/// A provider for one daemon: the address of each is the other's configuration.
pub struct Provider {
    port: u16,
    daemon: u16,
    /// Where the portal answers.
    portal: String,
    place: Directory,
    running: Option<Child>,
    /// Which key it signs by.
    key: u32,
    claims_in: &'static str,
    secrets: Arc<Mutex<Vec<String>>>,
}

impl Provider {
    /// One that answers, and tells what it knows of people where it is asked for (userinfo).
    pub fn start() -> anyhow::Result<Provider> {
        let mut provider = Provider::that_is_down()?;
        provider.comes_up()?;
        Ok(provider)
    }

    /// One that tells it in the ID token.
    pub fn with_claims_in_the_token() -> anyhow::Result<Provider> {
        let mut provider = Provider::that_is_down()?;
        provider.claims_in = "token";
        provider.comes_up()?;
        Ok(provider)
    }

    /// One of a portal that speaks TLS.
    pub fn of_a_portal_with_tls() -> anyhow::Result<Provider> {
        let mut provider = Provider::that_is_down()?;
        provider.portal = format!("https://localhost:{}", provider.daemon);
        provider.comes_up()?;
        Ok(provider)
    }

    /// One that is not there yet.
    pub fn that_is_down() -> anyhow::Result<Provider> {
        let daemon = free_port()?;
        Ok(Provider {
            port: free_port()?,
            portal: format!("http://127.0.0.1:{daemon}"),
            daemon,
            place: Directory::new("provider")?,
            running: None,
            key: 1,
            claims_in: "userinfo",
            secrets: Arc::default(),
        })
    }

    /// Where it answers. By another name than the portal: to browsers they are two sites.
    pub fn issuer(&self) -> String {
        format!("http://localhost:{}", self.port)
    }

    /// Where the portal answers.
    pub fn portal(&self) -> String {
        self.portal.clone()
    }

    /// Starts it.
    pub fn comes_up(&mut self) -> anyhow::Result<()> {
        let mut child = Command::new("node")
            .arg(binaries::checkout().join("tests/robots/identity_provider.mjs"))
            .arg(self.port.to_string())
            .arg(self.issuer())
            .arg(format!("{}/api/v1/oidc/callback", self.portal()))
            .arg(SECRET)
            .arg(self.place.path().join(format!("key-{}.pem", self.key)))
            .env("NODE_PATH", binaries::node_modules())
            .env("CLAIMS_IN", self.claims_in)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .context("node, which make deps installs")?;
        let said = child.stdout.take().context("piped")?;
        self.running = Some(child);
        let mut lines = BufReader::new(said).lines();
        let ready = lines.any(|line| line.is_ok_and(|line| line == "ready"));
        ensure!(ready, "the provider ended before it was ready");
        let secrets = Arc::clone(&self.secrets);
        std::thread::spawn(move || {
            for line in lines.map_while(Result::ok) {
                if let (Some(secret), Ok(mut all)) = (line.strip_prefix("secret "), secrets.lock())
                {
                    all.push(secret.to_owned());
                }
            }
        });
        Ok(())
    }

    /// Ends it.
    pub fn goes_down(&mut self) {
        if let Some(mut child) = self.running.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }

    /// Comes up with another key.
    pub fn signs_by_another_key(&mut self) -> anyhow::Result<()> {
        self.goes_down();
        self.key += 1;
        self.comes_up()
    }

    fn turns(&self, knobs: &Value) -> anyhow::Result<()> {
        let url = format!("{}/knobs", self.issuer());
        let turned = Command::new("curl")
            .args(["--silent", "--fail", "--data", &knobs.to_string(), &url])
            .status()?;
        ensure!(turned.success(), "the provider's knobs: {turned}");
        Ok(())
    }

    /// Who signs in next.
    pub fn knows(&self, who: &str) -> anyhow::Result<()> {
        self.turns(&json!({"who": who, "wrong": ""}))
    }

    /// What is wrong from now on.
    pub fn does_wrong(&self, wrong: &str) -> anyhow::Result<()> {
        self.turns(&json!({"wrong": wrong}))
    }

    /// Tokens that it has given out.
    pub fn secrets(&self) -> Vec<String> {
        self.secrets
            .lock()
            .map(|all| all.clone())
            .unwrap_or_default()
    }

    /// A daemon whose people it knows, with these roles.
    pub fn setup(&self, name: &str, roles: &str) -> anyhow::Result<Setup> {
        self.setup_with(world().own(name), roles)
    }

    /// The same, of a home that there is.
    pub fn setup_with(&self, setup: Setup, roles: &str) -> anyhow::Result<Setup> {
        let secret = self.place.path().join("secret");
        std::fs::write(&secret, format!("{SECRET}\n"))?;
        let closed = std::os::unix::fs::PermissionsExt::from_mode(0o600);
        std::fs::set_permissions(&secret, closed)?;
        Ok(setup
            .listen(&format!("127.0.0.1:{}", self.daemon))
            .config(&format!(
                "[oidc]\nissuer = \"{}\"\nname = \"Lab login\"\nclient_id = \"cloudroid\"\nclient_secret_file = \"{}\"\n\
                 redirect = \"{}\"\nscopes = [\"profile\", \"groups\"]\nroles = {{ {roles} }}\n",
                self.issuer(),
                path_str(&secret),
                self.portal(),
            )))
    }

    /// A browser that has been nowhere yet.
    pub fn browser(&self, name: &str) -> Browser {
        Browser {
            jar: self.place.path().join(format!("jar-{name}")),
            portal: self.portal(),
            authority: None,
        }
    }
}

impl Drop for Provider {
    fn drop(&mut self) {
        self.goes_down();
    }
}

/// What keeps cookies and follows redirects (curl).
pub struct Browser {
    jar: PathBuf,
    portal: String,
    /// By which the portal's certificate is checked.
    authority: Option<PathBuf>,
}

/// What a browser has come to.
#[derive(Debug)]
pub struct Visit {
    /// Status of the last answer.
    pub status: u16,
    /// Where it would send the browser on.
    pub onward: String,
    /// Its text.
    pub body: String,
}

impl Visit {
    /// The same, if it was refused with these words.
    pub fn refused(self, status: u16, words: &[&str]) -> anyhow::Result<Visit> {
        ensure!(self.status == status, "not {status}: {self:?}");
        for word in words {
            ensure!(self.body.contains(word), "{word:?} is not in {self:?}");
        }
        Ok(self)
    }
}

impl Browser {
    /// The same, which trusts a certificate.
    pub fn trusting(self, authority: &Path) -> Browser {
        Browser {
            authority: Some(authority.to_owned()),
            ..self
        }
    }

    /// What it keeps, as curl writes it.
    pub fn cookies(&self) -> anyhow::Result<String> {
        Ok(std::fs::read_to_string(&self.jar)?)
    }

    /// Asks as a browser does.
    pub fn asks(&self, more: &[&str], url: &str) -> anyhow::Result<Visit> {
        let jar = path_str(&self.jar);
        let authority = self.authority.as_deref().map(path_str);
        let trusts = authority.map(|path| ["--cacert", path]);
        let outcome = run(Command::new("curl")
            .args(["--silent", "--show-error", "--max-time"])
            .arg(patience().as_secs().to_string())
            .args(["--cookie", jar, "--cookie-jar", jar])
            .args(["--write-out", "\n%{http_code} %{redirect_url}"])
            .args(trusts.iter().flatten())
            .args(more)
            .arg(url))?
        .succeeded()?;
        let (body, last) = outcome.stdout.rsplit_once('\n').context("a status")?;
        let (status, onward) = last.split_once(' ').context("an address")?;
        Ok(Visit {
            status: status.parse()?,
            onward: onward.to_owned(),
            body: body.to_owned(),
        })
    }

    /// Goes somewhere, and on to where it is sent.
    pub fn goes(&self, path: &str) -> anyhow::Result<Visit> {
        let html = "Accept: text/html,application/xhtml+xml";
        let url = format!("{}{path}", self.portal);
        self.asks(&["--location", "-H", html], &url)
    }

    /// Signs in by the provider.
    pub fn signs_in(&self) -> anyhow::Result<Visit> {
        self.goes("/api/v1/oidc/login")
    }

    /// Signs in, up to where the provider sends it back: that address, to which it does not go.
    pub fn signs_in_half(&self) -> anyhow::Result<String> {
        let mut url = format!("{}/api/v1/oidc/login", self.portal);
        for _ in 0..10 {
            let visit = self.asks(&[], &url)?;
            ensure!(visit.status == 302 || visit.status == 303, "{visit:?}");
            url = visit.onward;
            if url.contains("/api/v1/oidc/callback") {
                return Ok(url);
            }
        }
        anyhow::bail!("the provider sends the browser to and fro: {url}")
    }

    /// Who is signed in.
    pub fn session(&self) -> anyhow::Result<Value> {
        let visit = self.goes("/api/v1/session")?;
        ensure!(visit.status == 200, "{visit:?}");
        Ok(serde_json::from_str(&visit.body)?)
    }

    /// Who is signed in, by name and role.
    pub fn is(&self, name: &str, role: &str) -> anyhow::Result<Value> {
        let session = self.session()?;
        ensure!(
            session["name"] == name && session["role"] == role,
            "{session}"
        );
        Ok(session)
    }

    /// Whether nobody is.
    pub fn is_signed_out(&self) -> anyhow::Result<bool> {
        Ok(self.session()?["name"].is_null())
    }

    /// Changes something, as the page does.
    pub fn changes(&self, method: &str, path: &str) -> anyhow::Result<Visit> {
        let csrf = self.session()?["csrf"]
            .as_str()
            .unwrap_or_default()
            .to_owned();
        let origin = format!("Origin: {}", self.portal);
        let csrf = format!("X-CSRF-Token: {csrf}");
        let url = format!("{}{path}", self.portal);
        self.asks(&["-X", method, "-H", &origin, "-H", &csrf], &url)
    }

    /// What of its cookies is secret.
    pub fn secrets(&self) -> anyhow::Result<Vec<String>> {
        let jar = self.cookies()?;
        let ours = jar.lines().filter(|line| line.contains("cloudroid"));
        let values = ours.filter_map(|line| line.rsplit('\t').next());
        Ok(values.map(str::to_owned).collect())
    }
}

/// Whether any of these stands in what a daemon has written.
pub fn finds_no_secret(daemon: &Daemon, secrets: &[String]) -> anyhow::Result<()> {
    let read = |path: &Path| -> anyhow::Result<String> {
        Ok(String::from_utf8_lossy(&std::fs::read(path)?).into_owned())
    };
    let audited = daemon
        .deployer()
        .types(&["--format", "json", "audit"])?
        .succeeded()?
        .stdout;
    let texts = [
        ("audit log", audited),
        ("log", read(&daemon.home.join("daemon.log"))?),
        ("database", read(&daemon.home.join("cloudroid.db"))?),
    ];
    for secret in secrets.iter().filter(|secret| !secret.is_empty()) {
        for (name, text) in &texts {
            ensure!(!text.contains(secret.as_str()), "the {name} has {secret}");
        }
    }
    Ok(())
}
