//! The configuration file: TOML, every key optional, unknown keys refused by name.
//! `systemd/cloudroid.example.toml` shows each key with its default.

mod acme;
mod archives;
mod black_box;
mod class;
mod doubts;
mod oidc;
mod options;
mod people;
mod time;
mod tls;
mod words;

use std::collections::BTreeMap;
use std::fmt;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail};
use api::{Limits, Size};
use choreographer::limits::check as check_limits;
use portal::{Proxies, Tokens};
use serde::Deserialize;
use servant::local::grants::Allow;
use servant::quotas::Quotas;

use crate::machine;

pub use self::oidc::Oidc;
pub use acme::Acme;
pub use archives::Archives;
pub use black_box::BlackBox;
pub use class::Class;
pub use people::People;
pub use time::Time;
pub use tls::Tls;

/// Everything that can be configured.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Address and port of the portal.
    pub listen: SocketAddr,
    /// Bearer tokens, or `sha256:HEX` of them. They, or an identity provider, are needed to listen beyond loopback.
    pub tokens: Vec<String>,
    /// Name or number of the group whose members are admins at `admin_socket`; `cloudroid` by default, where there is such a group.
    pub admin_group: Option<String>,
    /// A socket for them; below the directory that systemd makes for the service by default, else none.
    pub admin_socket: Option<PathBuf>,
    /// Name or number of the user whose rights to files the threads have that read what strangers send.
    pub portal_user: Option<String>,
    /// Web origins besides this machine's own whose pages may use the portal without a token.
    pub origins: Vec<String>,
    /// Addresses and networks of proxies in front of the portal that are believed for whom they ask.
    pub trusted_proxies: Vec<String>,
    /// Where a plain `ws://host:9090` goes.
    pub default_service: Option<String>,
    /// The robot that a plain `ws://host:9090` is taken for; one of its own each when not set.
    pub default_robot: Option<String>,
    /// What to do on a machine that cannot set the limits.
    pub isolation: IsolationMode,
    /// Servants outlive the daemon. Under systemd by default, else not.
    pub keep_servants: Option<bool>,
    /// Directory of base image definitions, searched before those built in.
    pub definitions: Option<PathBuf>,
    /// Where the packages of bases come from.
    pub archives: Archives,
    /// Limits of a servant where its push says nothing.
    pub limits: Limits,
    /// Classes that robots may name; `default` is that of robots that name none.
    pub class: BTreeMap<String, Class>,
    /// How many servants fit.
    #[serde(alias = "room")]
    pub capacity: Capacity,
    /// The life of a servant.
    pub servant: Servant,
    /// Where TLS is spoken.
    pub tls: Tls,
    /// How people's sessions last.
    pub people: People,
    /// An identity provider that knows people.
    pub oidc: Option<Oidc>,
    /// What clients may do.
    pub portal: Portal,
    /// Limits of memory outside of servants' containers.
    pub memory: Memory,
    /// What of servants is kept for when something goes wrong.
    pub black_box: BlackBox,
    /// Limits of pushes.
    pub push: Push,
    /// What pushes may ask for beyond a container.
    pub allow: Allow,
}

/// Whether limits that cannot be set are an error.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum IsolationMode {
    /// Refuse to run without every limit.
    Require,
    /// Say so and run.
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

/// What of this machine may be promised to servants.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Capacity {
    /// Cores to promise; all of the machine's by default.
    pub cpus: Option<f64>,
    /// How often each core may be promised, on the average. Memory is promised once.
    pub overcommit: f64,
    /// Whether cores are moved between servants while they work.
    pub controller: Controller,
    /// Memory to promise; nine tenths of the machine's by default.
    pub memory: Option<Size>,
    /// Robots that may wait for capacity.
    pub queue: usize,
    /// How long each may wait.
    pub deadline: Time,
}

/// Whether the controller works.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Controller {
    /// Those near what their robots accept at most get what others do not need.
    On,
    /// Limits stay as they were asked for.
    Off,
}

/// The life of a servant.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Servant {
    /// Cores promised to a servant whose push asked for none.
    pub reserve_cpus: f64,
    /// Memory promised to a servant whose push asked for none.
    pub reserve_memory: Size,
    /// How long a servant may take from its request to ready.
    pub start: Time,
    /// How long a robot's servant is kept after its last connection.
    pub grace: Time,
    /// The same for connections that named no robot.
    pub anonymous_grace: Time,
    /// Most services, those used last, that have containers made before a robot asks; how many each has is decided from the
    /// robots that come.
    #[serde(alias = "spares")]
    pub warm_pool: usize,
    /// Memory that all of those may take.
    pub warm_memory: Size,
    /// Most of them in which the nodes run, too.
    pub warm_nodes: usize,
    /// What is done about nodes that are given inputs and answer none.
    pub hung: Hung,
    /// They hang that answer nothing for so many times the T_max that their robot stated.
    pub hung_after: f64,
    /// Bytes of each file system that a servant writes; half of its memory by default.
    pub scratch: Option<Size>,
    /// Files, directories and links in each of them.
    pub inodes: u64,
    /// Bytes a second of its log, on the average.
    pub log_rate: Size,
}

/// What is done about nodes that hang.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Hung {
    /// Hung nodes are left alone, and no event says so.
    Ignore,
    /// An event says so.
    Report,
    /// An event says so, and the nodes are started again.
    Restart,
}

/// What JSON has no word for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NonFinite {
    /// `null`, which every parser accepts.
    Null,
    /// `"NaN"`, `"Infinity"`, `"-Infinity"`.
    Text,
    /// `NaN`, `Infinity`, `-Infinity`: Python's words, refused by strict parsers.
    Bare,
}

/// What clients may do to the port.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Portal {
    /// Biggest WebSocket message, its frames together.
    pub max_message: Size,
    /// Biggest WebSocket frame.
    pub max_frame: Size,
    /// Time between pings; 0: none are sent.
    pub ping: Time,
    /// A connection from which nothing came for so long, not even a pong, is closed; 0: never.
    pub idle: Time,
    /// Bytes of JSON or CBOR that one message of a servant may become; a bigger one is not sent.
    pub max_encoded: Size,
    /// How NaN and infinities are written in JSON.
    pub non_finite: NonFinite,
    /// How long a request's header may take, and the `auth` message where one is awaited.
    pub handshake: Time,
    /// How long connections may take to end when the daemon ends.
    pub drain: Time,
}

/// Limits of memory outside of servants' containers: in the daemon, and in shims.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Memory {
    /// All clients and servants together, in the daemon; by default a quarter of the machine's memory, at most 1G.
    pub daemon: Option<Size>,
    /// One client: its unfinished messages, and bodies of its requests.
    pub client: Size,
    /// One servant: unfinished messages of its nodes and links, and JSON or CBOR made of its messages.
    pub servant: Size,
    /// Time from the first byte of a message, frame or body to its last.
    pub unfinished: Time,
    /// Memory of one servant's shim, in a cgroup of its own.
    pub shim: Size,
    /// Cores of one servant's shim; limited to its servant's, but never to less than 0.1.
    pub shim_cpus: f64,
}

/// How big pushes may be, and what building them may take.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Push {
    /// Bytes of the archive as sent.
    pub archive: Size,
    /// Bytes of the files in it, unpacked.
    pub unpacked: Size,
    /// How many files the archive may have.
    pub entries: u64,
    /// How long the nodes may take to show their interface.
    pub probe: Time,
    /// How long the archive may pause while it is sent.
    pub stall: Time,
    /// Bytes of the archive that must come in a second, on the average over times of `stall`; 0 for any.
    pub min_rate: Size,
    /// Pushes that are built at once; others wait.
    pub at_once: usize,
    /// Pushes that may wait.
    pub queue: usize,
    /// Time from the start of a push's build (after waiting) to its end.
    pub time: Time,
    /// Bytes of a push's files while it is built; each file counts at least 4 KiB.
    pub disk: Size,
    /// Cores of each container of a build; as many as servants leave when not set.
    pub cpus: Option<f64>,
    /// Memory of each; half of the machine's when not set.
    pub memory: Option<Size>,
    /// Processes and threads of each.
    pub pids: u64,
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
            definitions: None,
            archives: Archives::default(),
            limits: Limits {
                cpus: Some(machine::cores()),
                cpu_weight: Some(100),
                memory: Some(Size(1 << 30)),
                pids: Some(512),
                ..Limits::default()
            },
            class: BTreeMap::new(),
            capacity: Capacity::default(),
            servant: Servant::default(),
            tls: Tls::default(),
            people: People::default(),
            oidc: None,
            portal: Portal::default(),
            memory: Memory::default(),
            black_box: BlackBox::default(),
            push: Push::default(),
            allow: Allow::default(),
        }
    }
}

impl Default for Capacity {
    fn default() -> Self {
        Capacity {
            cpus: None,
            overcommit: 1.0,
            controller: Controller::On,
            memory: None,
            queue: 64,
            deadline: Time::seconds(10),
        }
    }
}

impl Default for Servant {
    fn default() -> Self {
        Servant {
            reserve_cpus: 0.01,
            reserve_memory: Size(64 << 20),
            start: Time::seconds(30),
            grace: Time::seconds(60),
            anonymous_grace: Time::seconds(0),
            warm_pool: 8,
            warm_memory: Size(1 << 30),
            warm_nodes: 0,
            hung: Hung::Report,
            hung_after: 10.0,
            scratch: None,
            inodes: Quotas::default().inodes,
            log_rate: Size(Quotas::default().log_rate),
        }
    }
}

impl Default for Portal {
    fn default() -> Self {
        Portal {
            max_message: Size(64 << 20),
            max_frame: Size(64 << 20),
            max_encoded: Size(64 << 20),
            ping: Time::seconds(15),
            idle: Time::seconds(90),
            non_finite: NonFinite::Null,
            handshake: Time::seconds(10),
            drain: Time::seconds(10),
        }
    }
}

impl Default for Memory {
    fn default() -> Self {
        Memory {
            daemon: None,
            client: Size(256 << 20),
            servant: Size(256 << 20),
            unfinished: Time::seconds(300),
            shim: Size(256 << 20),
            shim_cpus: 0.5,
        }
    }
}

impl Default for Push {
    fn default() -> Self {
        Push {
            archive: Size(2 << 30),
            unpacked: Size(8 << 30),
            entries: 500_000,
            probe: Time::seconds(30),
            stall: Time::seconds(60),
            min_rate: Size(1 << 10),
            at_once: 2,
            queue: 16,
            time: Time::seconds(2 * 3600),
            disk: Size(20 << 30),
            cpus: None,
            memory: None,
            pids: 4096,
        }
    }
}

impl Capacity {
    /// Beyond this nobody has what was promised.
    const MOST_OVERCOMMIT: f64 = 100.0;

    fn check(&self) -> anyhow::Result<()> {
        let most = Self::MOST_OVERCOMMIT;
        if !(1.0..=most).contains(&self.overcommit) {
            bail!(
                "overcommit = {} is not between 1 and {most}; 1 promises each core once, 1.5 promises half of them twice",
                self.overcommit
            );
        }
        Ok(())
    }

    /// Cores that there are for servants.
    pub fn cores(&self) -> f64 {
        self.cpus.unwrap_or_else(machine::cores)
    }
}

impl Push {
    fn check(&self) -> anyhow::Result<()> {
        if self.at_once == 0 {
            bail!("at_once = 0 would let no push be built; write at least 1");
        }
        if self.disk.0 == 0 || self.time.0.is_zero() || self.stall.0.is_zero() {
            bail!("a disk, time or stall of 0 would end every push");
        }
        let sent = [self.archive.0, self.unpacked.0, self.entries];
        if sent.contains(&0) || self.probe.0.is_zero() {
            bail!("an archive, unpacked, entries or probe of 0 would refuse every push");
        }
        Ok(check_limits(&Limits {
            cpus: self.cpus,
            memory: self.memory,
            pids: Some(self.pids),
            ..Limits::default()
        })?)
    }
}

impl Config {
    /// Reads `path`; without one, everything is as by default.
    pub fn read(path: Option<&Path>) -> anyhow::Result<Config> {
        let Some(path) = path else {
            return Ok(Config::default());
        };
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read the configuration {}", path.display()))?;
        Config::parse(&text)
            .with_context(|| format!("cannot use the configuration {}", path.display()))
    }

    fn parse(text: &str) -> anyhow::Result<Config> {
        let defaults = Config::default();
        let read = toml::from_str(text).map_err(|error| anyhow!(words::plain(&error.to_string())));
        let mut config: Config = read?;
        config.limits = config.limits.or(defaults.limits);
        Ok(config)
    }

    /// Whose rights to files the portal's threads have.
    pub fn account(&self) -> anyhow::Result<privilege::Account> {
        match &self.portal_user {
            Some(written) => Ok(privilege::Account::find(written)?),
            None => Ok(privilege::Account::default()),
        }
    }

    /// Refuses what cannot work together, before anything is started.
    pub fn check(&self) -> anyhow::Result<()> {
        self.account()?;
        Tokens::new(&self.tokens)?;
        if !self.listen.ip().is_loopback() && self.tokens.is_empty() && self.oidc.is_none() {
            bail!(
                "listening on {} lets everyone on the network in; \
                 put a token into the configuration (tokens = [\"…\"]) or listen on 127.0.0.1:{}",
                self.listen,
                self.listen.port()
            );
        }
        self.proxies()
            .context("trusted_proxies of the configuration")?;
        self.tls.check().context("[tls] of the configuration")?;
        self.people
            .check()
            .context("[people] of the configuration")?;
        if let Some(oidc) = &self.oidc {
            oidc.check().context("[oidc] of the configuration")?;
        }
        check_limits(&self.limits).context("[limits] of the configuration")?;
        if !(self.servant.hung_after >= 1.0 && self.servant.hung_after <= 1e6) {
            bail!(
                "[servant] hung_after = {} in the configuration is no number of times; write one from 1 to 1000000, such as 10",
                self.servant.hung_after
            );
        }
        // To the kernel, none is no limit.
        let Servant {
            scratch,
            inodes,
            log_rate,
            ..
        } = self.servant;
        if scratch.is_some_and(|scratch| scratch.0 < 1 << 20)
            || inodes < 256
            || log_rate.0 < 1 << 10
        {
            bail!(
                "[servant] of the configuration: programs need a scratch of at least 1M, 256 inodes, and a log_rate of at least 1K"
            );
        }
        for (name, class) in &self.class {
            class
                .check(name)
                .with_context(|| format!("[class.{name}] of the configuration"))?;
        }
        reach::egress::check(&self.allow.egress)
            .context("egress in [allow] of the configuration")?;
        self.black_box
            .check(self.memory.servant)
            .context("[black_box] of the configuration")?;
        self.push.check().context("[push] of the configuration")?;
        self.archives
            .check()
            .context("[archives] of the configuration")?;
        self.capacity
            .check()
            .context("[capacity] of the configuration")?;
        if let Some(service) = &self.default_service {
            catalogue::names::service(service).context("default_service of the configuration")?;
        }
        if let Some(robot) = &self.default_robot {
            catalogue::names::robot(robot).context("default_robot of the configuration")?;
        }
        self.memory
            .check()
            .context("[memory] of the configuration")?;
        if self.portal.max_encoded.0 == 0
            || self.portal.max_message.0 == 0
            || self.portal.max_frame.0 == 0
        {
            bail!(
                "[portal] of the configuration: a limit of 0 would refuse every message; write a size such as \"64M\""
            );
        }
        for (key, time, right) in [
            ("[portal] handshake", self.portal.handshake, "10s"),
            ("[servant] start", self.servant.start, "30s"),
        ] {
            if time.0.is_zero() {
                bail!(
                    "{key} = 0 in the configuration would give up before anything has begun; write a time such as \"{right}\""
                );
            }
        }
        Ok(())
    }

    /// The proxies that are believed.
    pub fn proxies(&self) -> Result<Proxies, portal::NoNetwork> {
        let networks = self.trusted_proxies.iter().map(|written| written.parse());
        Ok(Proxies(networks.collect::<Result<_, _>>()?))
    }

    /// Whether servants outlive this daemon when it is ended.
    pub fn keeps_servants(&self) -> bool {
        self.keep_servants
            .unwrap_or_else(|| std::env::var_os("NOTIFY_SOCKET").is_some())
    }
}

impl Memory {
    /// Bytes below which nothing works.
    const LEAST: u64 = 1 << 20;
    const LEAST_FOR_A_SHIM: u64 = 32 << 20;

    fn check(&self) -> anyhow::Result<()> {
        let daemon = ("daemon", self.daemon.unwrap_or(self.client), Self::LEAST);
        let least = Self::LEAST_FOR_A_SHIM;
        for (name, size, least) in [
            daemon,
            ("client", self.client, Self::LEAST),
            ("servant", self.servant, Self::LEAST),
            ("shim", self.shim, least),
        ] {
            if size.0 < least {
                bail!("{name} = {size} is too little; at least {}", Size(least));
            }
        }
        if self.unfinished.0.is_zero() {
            bail!(
                "unfinished = 0 would refuse whatever does not come at once; write a time such as \"5m\""
            );
        }
        if !(self.shim_cpus.is_finite() && (0.1..=64.0).contains(&self.shim_cpus)) {
            bail!("shim_cpus = {} is not between 0.1 and 64", self.shim_cpus);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_written_means_the_defaults() {
        assert_eq!(Config::parse("").expect("empty"), Config::default());
        Config::default()
            .check()
            .expect("the defaults work together");
    }

    #[test]
    fn the_example_says_the_defaults() {
        let example = include_str!("../../../systemd/cloudroid.example.toml");
        assert_eq!(
            Config::parse(example).expect("comments only"),
            Config::default()
        );
        let uncommented: String = example
            .lines()
            .map(|line| line.strip_prefix("#: ").unwrap_or(line))
            .map(|line| format!("{line}\n"))
            .collect();
        let written = Config::parse(&uncommented).expect("every example value is valid");
        assert_eq!(
            written.capacity,
            Capacity {
                cpus: Some(2.0),
                memory: Some(Size(4 << 30)),
                ..Capacity::default()
            }
        );
        let servant = Servant {
            scratch: Some(Size(512 << 20)),
            ..Servant::default()
        };
        assert_eq!(written.servant, servant);
        assert_eq!(written.portal, Portal::default());
        let memory = Memory {
            daemon: Some(Size(1 << 30)),
            ..Memory::default()
        };
        assert_eq!(written.memory, memory);
        assert_eq!(
            written.push,
            Push {
                cpus: Some(2.0),
                memory: Some(Size(4 << 30)),
                ..Push::default()
            }
        );
        assert_eq!(written.limits.memory, Config::default().limits.memory);
    }

    #[test]
    fn what_is_no_proxys_address_is_named() {
        let config =
            Config::parse("trusted_proxies = [\"10.0.0.0/8\", \"proxy.lab\"]").expect("read");
        let refused = format!("{:#}", config.check().expect_err("a name"));
        assert!(
            refused.contains("trusted_proxies") && refused.contains("proxy.lab"),
            "{refused}"
        );
    }

    #[test]
    fn a_misspelt_key_is_named() {
        for (text, key) in [
            ("lsiten = \"127.0.0.1:1\"", "lsiten"),
            ("[servant]\ngarce = \"1s\"", "garce"),
        ] {
            let refused = format!("{:#}", Config::parse(text).expect_err(key));
            assert!(refused.contains(key), "{refused}");
        }
    }

    #[test]
    fn a_quota_that_would_be_none_is_refused() {
        for text in ["scratch = \"0\"", "inodes = 0", "log_rate = \"0\""] {
            let config = Config::parse(&format!("[servant]\n{text}\n")).expect("understood");
            let refused = config.check().expect_err(text).to_string();
            assert!(refused.contains("256 inodes"), "{refused}");
        }
    }

    #[test]
    fn the_network_needs_a_token() {
        let open = Config {
            listen: "0.0.0.0:9090".parse().expect("an address"),
            ..Config::default()
        };
        let refused = open
            .check()
            .expect_err("anyone could drive the robots")
            .to_string();
        assert!(
            refused.contains("0.0.0.0:9090") && refused.contains("tokens ="),
            "{refused}"
        );
        Config {
            tokens: vec!["a-long-secret".into()],
            ..open
        }
        .check()
        .expect("a token is there");
    }

    #[test]
    fn limits_that_no_kernel_takes_are_refused() {
        for text in [
            "cpus = 0.0",
            "cpus = nan",
            "cpu_weight = 0",
            "memory = \"1K\"",
            "pids = 1",
        ] {
            let config = Config::parse(&format!("[limits]\n{text}")).expect("well-formed");
            let refused = format!("{:#}", config.check().expect_err(text));
            assert!(refused.contains("[limits]"), "{refused}");
        }
    }

    #[test]
    fn memory_that_nothing_works_with_is_refused() {
        for text in [
            "client = \"10K\"",
            "servant = 0",
            "daemon = 0",
            "shim = \"4M\"",
            "shim_cpus = 0.0",
            "unfinished = \"0s\"",
        ] {
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
        assert_eq!(
            config.limits,
            Limits {
                memory: Some(Size(2 << 30)),
                ..Config::default().limits
            }
        );
    }
}
