//! An OpenID identity provider (npm `oidc-provider`, tests/robots/identity_provider.mjs), and browsers that sign in
//! through it.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};

use anyhow::{Context, ensure};
use serde_json::{Value, json};

use crate::binaries;
use crate::daemon::{Daemon, DaemonSetup};
use crate::deployer::{path_str, run};
use crate::machine::free_port;
use crate::patience::patience;
use crate::world::{Directory, world};

/// Client secret shared with the daemon.
pub const SECRET: &str = "forty-two-white-elephants-in-a-row";

/// Default roles of its groups.
pub const ROLES: &str = "robot-admins = \"admin\", builders = { role = \"deployer\", services = [\"build_*\"] }, \
                         students = { role = \"viewer\", services = [\"lab_*\"] }";

/// A provider for one daemon; each is configured with the other's address.
pub struct StoryIdentityProvider {
    port: u16,
    daemon: u16,
    /// URL of the portal.
    portal: String,
    place: Directory,
    running: Option<Child>,
    /// Number of its current signing key.
    key: u32,
    claims_in: &'static str,
    secrets: Arc<Mutex<Vec<String>>>,
}

impl StoryIdentityProvider {
    /// Starts a provider that returns claims from the userinfo endpoint.
    pub fn start() -> anyhow::Result<StoryIdentityProvider> {
        let mut provider = StoryIdentityProvider::new_stopped()?;
        provider.bring_up()?;
        Ok(provider)
    }

    /// Starts a provider that returns claims in the ID token.
    pub fn with_token_claims() -> anyhow::Result<StoryIdentityProvider> {
        let mut provider = StoryIdentityProvider::new_stopped()?;
        provider.claims_in = "token";
        provider.bring_up()?;
        Ok(provider)
    }

    /// Starts a provider for a portal with TLS.
    pub fn for_tls_portal() -> anyhow::Result<StoryIdentityProvider> {
        let mut provider = StoryIdentityProvider::new_stopped()?;
        provider.portal = format!("https://localhost:{}", provider.daemon);
        provider.bring_up()?;
        Ok(provider)
    }

    /// Creates a provider that is not running.
    pub fn new_stopped() -> anyhow::Result<StoryIdentityProvider> {
        let daemon = free_port()?;
        Ok(StoryIdentityProvider {
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

    /// Returns its URL. The host name differs from the portal's, so that browsers treat them as two sites.
    pub fn issuer(&self) -> String {
        format!("http://localhost:{}", self.port)
    }

    /// Returns the URL of the portal.
    pub fn portal(&self) -> String {
        self.portal.clone()
    }

    /// Starts it.
    pub fn bring_up(&mut self) -> anyhow::Result<()> {
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
                if let (Some(secret), Ok(mut all)) = (line.strip_prefix("secret "), secrets.lock()) {
                    all.push(secret.to_owned());
                }
            }
        });
        Ok(())
    }

    /// Stops it.
    pub fn shut_down(&mut self) {
        if let Some(mut child) = self.running.take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }

    /// Restarts it with another signing key.
    pub fn restart_with_new_key(&mut self) -> anyhow::Result<()> {
        self.shut_down();
        self.key += 1;
        self.bring_up()
    }

    fn set_knobs(&self, knobs: &Value) -> anyhow::Result<()> {
        let url = format!("{}/knobs", self.issuer());
        let turned = Command::new("curl").args(["--silent", "--fail", "--data", &knobs.to_string(), &url]).status()?;
        ensure!(turned.success(), "the provider's knobs: {turned}");
        Ok(())
    }

    /// Sets the user who signs in next.
    pub fn set_user(&self, who: &str) -> anyhow::Result<()> {
        self.set_knobs(&json!({"who": who, "wrong": ""}))
    }

    /// Sets the fault that it shows from now on.
    pub fn set_fault(&self, wrong: &str) -> anyhow::Result<()> {
        self.set_knobs(&json!({"wrong": wrong}))
    }

    /// Returns the tokens that it has issued.
    pub fn secrets(&self) -> Vec<String> {
        self.secrets.lock().map(|all| all.clone()).unwrap_or_default()
    }

    /// Returns a new daemon setup that uses this provider, with these roles.
    pub fn setup(&self, name: &str, roles: &str) -> anyhow::Result<DaemonSetup> {
        self.setup_with(world().setup(name), roles)
    }

    /// Extends a daemon setup to use this provider, with these roles.
    pub fn setup_with(&self, setup: DaemonSetup, roles: &str) -> anyhow::Result<DaemonSetup> {
        let secret = self.place.path().join("secret");
        std::fs::write(&secret, format!("{SECRET}\n"))?;
        let closed = std::os::unix::fs::PermissionsExt::from_mode(0o600);
        std::fs::set_permissions(&secret, closed)?;
        Ok(setup.listen(&format!("127.0.0.1:{}", self.daemon)).config(&format!(
            "[oidc]\nissuer = \"{}\"\nname = \"Lab login\"\nclient_id = \"cloudroid\"\nclient_secret_file \
                 = \"{}\"\n\
                 redirect = \"{}\"\nscopes = [\"profile\", \"groups\"]\nroles = {{ {roles} }}\n",
            self.issuer(),
            path_str(&secret),
            self.portal(),
        )))
    }

    /// Returns a browser without cookies.
    pub fn browser(&self, name: &str) -> CookieBrowser {
        CookieBrowser { jar: self.place.path().join(format!("jar-{name}")), portal: self.portal(), authority: None }
    }
}

impl Drop for StoryIdentityProvider {
    fn drop(&mut self) {
        self.shut_down();
    }
}

/// A browser that keeps cookies and follows redirects (curl).
pub struct CookieBrowser {
    jar: PathBuf,
    portal: String,
    /// CA certificate for the portal.
    authority: Option<PathBuf>,
}

/// Response to a browser's request.
#[derive(Debug)]
pub struct PageVisit {
    /// Status of the last response.
    pub status: u16,
    /// Target of its redirect.
    pub onward: String,
    /// Body of the last response.
    pub body: String,
}

impl PageVisit {
    /// Returns the response if it was refused with this status and these words, otherwise an error.
    pub fn expect_refusal(self, status: u16, words: &[&str]) -> anyhow::Result<PageVisit> {
        ensure!(self.status == status, "not {status}: {self:?}");
        for word in words {
            ensure!(self.body.contains(word), "{word:?} is not in {self:?}");
        }
        Ok(self)
    }
}

impl CookieBrowser {
    /// Returns a browser that trusts a CA certificate.
    pub fn with_authority(self, authority: &Path) -> CookieBrowser {
        CookieBrowser { authority: Some(authority.to_owned()), ..self }
    }

    /// Returns the cookies in curl's format.
    pub fn cookies(&self) -> anyhow::Result<String> {
        Ok(std::fs::read_to_string(&self.jar)?)
    }

    /// Sends a request.
    pub fn request(&self, more: &[&str], url: &str) -> anyhow::Result<PageVisit> {
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
        .expect_success()?;
        let (body, last) = outcome.stdout.rsplit_once('\n').context("a status")?;
        let (status, onward) = last.split_once(' ').context("an address")?;
        Ok(PageVisit { status: status.parse()?, onward: onward.to_owned(), body: body.to_owned() })
    }

    /// Opens a path of the portal and follows redirects.
    pub fn visit(&self, path: &str) -> anyhow::Result<PageVisit> {
        let html = "Accept: text/html,application/xhtml+xml";
        let url = format!("{}{path}", self.portal);
        self.request(&["--location", "-H", html], &url)
    }

    /// Signs in through the provider.
    pub fn sign_in(&self) -> anyhow::Result<PageVisit> {
        self.visit("/api/v1/oidc/login")
    }

    /// Signs in up to the redirect back to the portal; returns its URL without opening it.
    pub fn sign_in_until_callback(&self) -> anyhow::Result<String> {
        let mut url = format!("{}/api/v1/oidc/login", self.portal);
        for _ in 0..10 {
            let visit = self.request(&[], &url)?;
            ensure!(visit.status == 302 || visit.status == 303, "{visit:?}");
            url = visit.onward;
            if url.contains("/api/v1/oidc/callback") {
                return Ok(url);
            }
        }
        anyhow::bail!("the provider sends the browser to and fro: {url}")
    }

    /// Returns the session.
    pub fn session(&self) -> anyhow::Result<Value> {
        let visit = self.visit("/api/v1/session")?;
        ensure!(visit.status == 200, "{visit:?}");
        Ok(serde_json::from_str(&visit.body)?)
    }

    /// Returns the session if this user with this role is signed in, otherwise an error.
    pub fn expect_user(&self, name: &str, role: &str) -> anyhow::Result<Value> {
        let session = self.session()?;
        ensure!(session["name"] == name && session["role"] == role, "{session}");
        Ok(session)
    }

    /// Returns whether nobody is signed in.
    pub fn is_signed_out(&self) -> anyhow::Result<bool> {
        Ok(self.session()?["name"].is_null())
    }

    /// Sends a request that changes something, as the page does.
    pub fn send_change(&self, method: &str, path: &str) -> anyhow::Result<PageVisit> {
        let csrf = self.session()?["csrf"].as_str().unwrap_or_default().to_owned();
        let origin = format!("Origin: {}", self.portal);
        let csrf = format!("X-CSRF-Token: {csrf}");
        let url = format!("{}{path}", self.portal);
        self.request(&["-X", method, "-H", &origin, "-H", &csrf], &url)
    }

    /// Returns the secret values of its cookies.
    pub fn secrets(&self) -> anyhow::Result<Vec<String>> {
        let jar = self.cookies()?;
        let ours = jar.lines().filter(|line| line.contains("cloudroid"));
        let values = ours.filter_map(|line| line.rsplit('\t').next());
        Ok(values.map(str::to_owned).collect())
    }
}

/// Fails if any of the secrets occurs in files or output of a daemon.
pub fn expect_no_secret(daemon: &Daemon, secrets: &[String]) -> anyhow::Result<()> {
    let read =
        |path: &Path| -> anyhow::Result<String> { Ok(String::from_utf8_lossy(&std::fs::read(path)?).into_owned()) };
    let audited = daemon.deployer().run(&["--format", "json", "audit"])?.expect_success()?.stdout;
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
