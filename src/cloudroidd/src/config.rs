//! The configuration file: TOML, every key optional, unknown keys refused by name. `systemd/cloudroid.example.toml`
//! shows each key with its default.

mod acme;
mod archives;
mod black_box;
mod capacity;
mod class;
mod doubts;
mod logs;
mod memory;
mod oidc;
mod options;
mod people;
mod portal;
mod push;
mod ros;
mod servant;
mod telemetry;
mod time;
mod tls;
mod words;

use std::collections::BTreeMap;
use std::fmt;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use ::portal::{Proxies, Tokens};
use ::servant::local::grants::Allow;
use anyhow::{Context, anyhow, bail};
use api::{Limits, Size};
use serde::Deserialize;

use crate::log::LogFormat;
use crate::machine;

pub use self::oidc::OidcConfig;
pub use self::portal::{LoopbackRobots, NonFinite, PortalConfig};
pub use self::push::PushConfig;
pub use self::ros::RosConfig;
pub use self::servant::{Hung, ServantConfig};
pub use acme::AcmeConfig;
pub use archives::ArchivesConfig;
pub use black_box::BlackBoxConfig;
pub use capacity::{CapacityConfig, Controller};
pub use class::ClassConfig;
pub use logs::LogsConfig;
pub use memory::MemoryConfig;
pub use people::PeopleConfig;
pub use telemetry::TelemetryConfig;
pub use time::Time;
pub use tls::TlsConfig;

/// The daemon's configuration.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Address and port of the portal (default: 127.0.0.1:9090).
    pub listen: SocketAddr,
    /// Bearer tokens, or `sha256:HEX` of them. To listen beyond loopback, tokens or an identity provider are required.
    pub tokens: Vec<String>,
    /// Name or number of the group whose members are admins at `admin_socket` (default: `cloudroid`, if that group
    /// exists).
    pub admin_group: Option<String>,
    /// Path of the admin socket (default: `daemon.sock` in the directory that systemd makes for the service, otherwise
    /// none).
    pub admin_socket: Option<PathBuf>,
    /// Name or number of the user whose file access rights the threads have that read input of strangers.
    pub portal_user: Option<String>,
    /// Web origins whose pages may use the portal without a token, besides this machine's own.
    pub origins: Vec<String>,
    /// Addresses and networks of trusted proxies in front of the portal: the client's address that they forward is
    /// believed.
    pub trusted_proxies: Vec<String>,
    /// Service of a plain `ws://host:9090`.
    pub default_service: Option<String>,
    /// Robot id of connections to a plain `ws://host:9090` (default: each connection is a robot of its own).
    pub default_robot: Option<String>,
    /// Behaviour on a machine that cannot set the limits.
    pub isolation: IsolationMode,
    /// Keep servants when the daemon ends (default: yes under systemd, otherwise no).
    pub keep_servants: Option<bool>,
    /// Format of the log's lines, if the command line names none.
    pub log_format: LogFormat,
    /// Directory of base image definitions, searched before the built-in ones.
    pub definitions: Option<PathBuf>,
    /// Package archives of the bases.
    pub archives: ArchivesConfig,
    /// Limits of a servant whose push sets none.
    pub limits: Limits,
    /// Classes that robots may name; `default` is the class of robots that name none.
    pub class: BTreeMap<String, ClassConfig>,
    /// Capacity that may be promised to servants.
    #[serde(alias = "room")]
    pub capacity: CapacityConfig,
    /// Lifetime and resources of servants.
    pub servant: ServantConfig,
    /// TLS of the portal.
    pub tls: TlsConfig,
    /// Lifetime of people's sessions.
    pub people: PeopleConfig,
    /// Identity provider for people.
    pub oidc: Option<OidcConfig>,
    /// Limits of clients' connections.
    pub portal: PortalConfig,
    /// Memory limits outside of servants' containers.
    pub memory: MemoryConfig,
    /// Traces of robots' requests.
    pub telemetry: Option<TelemetryConfig>,
    /// Recording of the last seconds of servants, kept for when something goes wrong.
    pub black_box: BlackBoxConfig,
    /// Logs that are kept of ended servants.
    pub logs: LogsConfig,
    /// Limits of pushes.
    pub push: PushConfig,
    /// Robots of another ROS than their service.
    pub ros: RosConfig,
    /// Grants beyond a container that pushes may ask for.
    pub allow: Allow,
}

/// Handling of limits that cannot be set.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum IsolationMode {
    /// Refuse to run unless every limit can be set.
    Require,
    /// Run without, and warn.
    #[default]
    BestEffort,
}

impl fmt::Display for IsolationMode {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            IsolationMode::Require => "require",
            IsolationMode::BestEffort => "best-effort",
        })
    }
}

impl Default for Config {
    fn default() -> Self {
        Config {
            listen: SocketAddr::from((Ipv4Addr::LOCALHOST, 9090)),
            tokens: Vec::new(),
            admin_group: None,
            admin_socket: None,
            portal_user: None,
            origins: Vec::new(),
            trusted_proxies: Vec::new(),
            default_service: None,
            default_robot: None,
            isolation: IsolationMode::default(),
            keep_servants: None,
            log_format: LogFormat::default(),
            definitions: None,
            archives: ArchivesConfig::default(),
            limits: Limits {
                cpus: Some(machine::cores()),
                cpu_weight: Some(100),
                memory: Some(Size(1 << 30)),
                pids: Some(512),
                ..Limits::default()
            },
            class: BTreeMap::new(),
            capacity: CapacityConfig::default(),
            servant: ServantConfig::default(),
            tls: TlsConfig::default(),
            people: PeopleConfig::default(),
            oidc: None,
            portal: PortalConfig::default(),
            memory: MemoryConfig::default(),
            telemetry: None,
            black_box: BlackBoxConfig::default(),
            logs: LogsConfig::default(),
            push: PushConfig::default(),
            ros: RosConfig::default(),
            allow: Allow::default(),
        }
    }
}

impl Config {
    /// Reads the file at `path`; without one, returns the defaults.
    pub fn read(path: Option<&Path>) -> anyhow::Result<Config> {
        let Some(path) = path else {
            return Ok(Config::default());
        };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the configuration {}", path.display()))?;
        Config::parse(&text).with_context(|| format!("cannot use the configuration {}", path.display()))
    }

    fn parse(text: &str) -> anyhow::Result<Config> {
        let defaults = Config::default();
        let read = toml::from_str(text).map_err(|error| anyhow!(words::plain(&error.to_string())));
        let mut config: Config = read?;
        config.limits = config.limits.or(defaults.limits);
        Ok(config)
    }

    /// Returns the account whose file access rights the portal's threads have.
    pub fn account(&self) -> anyhow::Result<privilege::Account> {
        match &self.portal_user {
            Some(written) => Ok(privilege::Account::find(written)?),
            None => Ok(privilege::Account::default()),
        }
    }

    /// Checks all values and their combinations before anything is started.
    pub fn check(&self) -> anyhow::Result<()> {
        self.account()?;
        Tokens::new(&self.tokens)?;
        if !self.listen.ip().is_loopback() && self.tokens.is_empty() && self.oidc.is_none() {
            bail!(
                "listening on {} gives everyone on the network access; put a token into the configuration (tokens = \
                    [\"…\"]) or listen on 127.0.0.1:{}",
                self.listen,
                self.listen.port()
            );
        }
        self.proxies().context("trusted_proxies of the configuration")?;
        self.tls.check().context("[tls] of the configuration")?;
        self.people.check().context("[people] of the configuration")?;
        if let Some(oidc) = &self.oidc {
            oidc.check().context("[oidc] of the configuration")?;
        }
        self.limits.check().context("[limits] of the configuration")?;
        self.servant.check()?;
        for (name, class) in &self.class {
            class.check(name).with_context(|| format!("[class.{name}] of the configuration"))?;
        }
        reach::egress::validate(&self.allow.egress).context("egress in [allow] of the configuration")?;
        self.black_box.check(self.memory.servant).context("[black_box] of the configuration")?;
        self.logs.check().context("[logs] of the configuration")?;
        if let Some(telemetry) = &self.telemetry {
            telemetry.check(cfg!(feature = "otel")).context("[telemetry] of the configuration")?;
        }
        self.push.check().context("[push] of the configuration")?;
        self.ros.read_rules().context("[ros] of the configuration")?;
        self.archives.check().context("[archives] of the configuration")?;
        self.capacity.check().context("[capacity] of the configuration")?;
        if let Some(service) = &self.default_service {
            catalogue::names::validate_service(service).context("default_service of the configuration")?;
        }
        if let Some(robot) = &self.default_robot {
            catalogue::names::validate_robot(robot).context("default_robot of the configuration")?;
        }
        self.memory.check().context("[memory] of the configuration")?;
        self.portal.check(!self.trusted_proxies.is_empty())?;
        Ok(())
    }

    /// Returns the trusted proxies.
    pub fn proxies(&self) -> Result<Proxies, ::portal::ParseIpNetworkError> {
        let networks = self.trusted_proxies.iter().map(|written| written.parse());
        Ok(Proxies(networks.collect::<Result<_, _>>()?))
    }

    /// Returns whether servants are kept when this daemon ends.
    pub fn keeps_servants(&self) -> bool {
        self.keep_servants.unwrap_or_else(|| std::env::var_os("NOTIFY_SOCKET").is_some())
    }
}

/// Refuses a duration of zero; `right` is an example of a valid one for the error message.
fn check_nonzero(key: &str, time: Time, right: &str) -> anyhow::Result<()> {
    if time.0.is_zero() {
        bail!("{key} = 0 in the configuration would always time out at once; write a time such as \"{right}\"");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_written_means_the_defaults() {
        assert_eq!(Config::parse("").expect("empty"), Config::default());
        Config::default().check().expect("the defaults work together");
    }

    #[test]
    fn the_example_says_the_defaults() {
        let example = include_str!("../../../systemd/cloudroid.example.toml");
        assert_eq!(Config::parse(example).expect("comments only"), Config::default());
        let uncommented: String = example
            .lines()
            .map(|line| line.strip_prefix("#: ").unwrap_or(line))
            .map(|line| format!("{line}\n"))
            .collect();
        let written = Config::parse(&uncommented).expect("every example value is valid");
        assert_eq!(
            written.capacity,
            CapacityConfig { cpus: Some(2.0), memory: Some(Size(4 << 30)), ..CapacityConfig::default() }
        );
        let servant = ServantConfig { scratch: Some(Size(512 << 20)), ..ServantConfig::default() };
        assert_eq!(written.servant, servant);
        assert_eq!(written.portal, PortalConfig::default());
        assert_eq!(written.logs, LogsConfig::default());
        let memory = MemoryConfig { daemon: Some(Size(1 << 30)), ..MemoryConfig::default() };
        assert_eq!(written.memory, memory);
        assert_eq!(written.push, PushConfig { cpus: Some(2.0), memory: Some(Size(4 << 30)), ..PushConfig::default() });
        assert_eq!(written.limits.memory, Config::default().limits.memory);
    }

    #[test]
    fn what_is_no_proxys_address_is_named() {
        let config = Config::parse("trusted_proxies = [\"10.0.0.0/8\", \"proxy.lab\"]").expect("read");
        let refused = format!("{:#}", config.check().expect_err("a name"));
        assert!(refused.contains("trusted_proxies") && refused.contains("proxy.lab"), "{refused}");
    }

    #[test]
    fn a_log_format_that_does_not_exist_is_refused_with_those_that_do() {
        let refused = Config::parse("log_format = \"xml\"").expect_err("no such format");
        let refused = format!("{refused:#}");
        assert!(refused.contains("text") && refused.contains("json"), "{refused}");
        let config = Config::parse("log_format = \"json\"").expect("a format");
        assert_eq!(config.log_format, LogFormat::Json);
    }

    #[test]
    fn a_misspelt_key_is_named() {
        for (text, key) in [("lsiten = \"127.0.0.1:1\"", "lsiten"), ("[servant]\ngarce = \"1s\"", "garce")] {
            let refused = format!("{:#}", Config::parse(text).expect_err(key));
            assert!(refused.contains(key), "{refused}");
        }
    }

    #[test]
    fn a_quota_that_would_be_none_is_refused() {
        for text in ["scratch = \"0\"", "inodes = 0", "log_rate = \"0\""] {
            let config = Config::parse(&format!("[servant]\n{text}\n")).expect("understood");
            let refused = config.check().expect_err(text).to_string();
            assert!(refused.contains("inodes at least 256"), "{refused}");
        }
    }

    #[test]
    fn the_network_needs_a_token() {
        let open = Config { listen: "0.0.0.0:9090".parse().expect("an address"), ..Config::default() };
        let refused = open.check().expect_err("anyone could drive the robots").to_string();
        assert!(refused.contains("0.0.0.0:9090") && refused.contains("tokens ="), "{refused}");
        Config { tokens: vec!["a-long-secret".into()], ..open }.check().expect("a token is there");
    }

    #[test]
    fn limits_that_no_kernel_takes_are_refused() {
        for text in ["cpus = 0.0", "cpus = nan", "cpu_weight = 0", "memory = \"1K\"", "pids = 1"] {
            let config = Config::parse(&format!("[limits]\n{text}")).expect("well-formed");
            let refused = format!("{:#}", config.check().expect_err(text));
            assert!(refused.contains("[limits]"), "{refused}");
        }
    }

    #[test]
    fn memory_that_nothing_works_with_is_refused() {
        for text in
            ["client = \"10K\"", "servant = 0", "daemon = 0", "shim = \"4M\"", "shim_cpus = 0.0", "unfinished = \"0s\""]
        {
            let config = Config::parse(&format!("[memory]\n{text}")).expect("well-formed");
            let refused = format!("{:#}", config.check().expect_err(text));
            assert!(refused.contains("[memory]"), "{refused}");
        }
    }

    #[test]
    fn times_in_which_nothing_can_happen_are_refused() {
        for (section, key) in [("portal", "handshake"), ("servant", "start")] {
            let config = Config::parse(&format!("[{section}]\n{key} = 0")).expect("well-formed");
            let refused = config.check().expect_err(key).to_string();
            assert!(refused.contains(&format!("[{section}] {key}")), "{refused}");
        }
    }

    #[test]
    fn bounds_that_no_push_could_meet_are_refused() {
        for text in [
            "at_once = 0",
            "archive = 0",
            "unpacked = 0",
            "entries = 0",
            "probe = 0",
            "disk = 0",
            "time = 0",
            "stall = 0",
            "pids = 1",
            "memory = \"1K\"",
        ] {
            let config = Config::parse(&format!("[push]\n{text}")).expect("well-formed");
            let refused = format!("{:#}", config.check().expect_err(text));
            assert!(refused.contains("[push]"), "{refused}");
        }
    }

    #[test]
    fn names_of_earlier_versions_are_read() {
        let config = Config::parse("[room]\nqueue = 3\n[servant]\nspares = 2\n").expect("read");
        assert_eq!((config.capacity.queue, config.servant.warm_pool), (3, 2));
    }

    #[test]
    fn a_limit_not_written_keeps_its_default() {
        let config = Config::parse("[limits]\nmemory = \"2G\"").expect("valid");
        assert_eq!(config.limits, Limits { memory: Some(Size(2 << 30)), ..Config::default().limits });
    }
}
