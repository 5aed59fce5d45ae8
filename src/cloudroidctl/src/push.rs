//! `push`: publishes a package as a service.

pub mod archive;
mod ignore;
mod interrupt;
pub mod progress;
mod selection;
mod sending;
mod shared;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use api::push::ParsePairError;
use api::{Caps, Grants, Limits, PushOptions, ServiceDetail, Sla, Span, Volume};

use crate::client::{DaemonClient, RequestBody, percent_encode};
use crate::output::{self, OutputFormat};
use crate::push::shared::SharedFlags;
use crate::rollout::{self, TermFlags};
use crate::services;
use crate::wait::WaitFlag;
use archive::PushSource;
use interrupt::InterruptAnswer;
use progress::PushProgress;
use sending::PushRequest;

/// Largest query in bytes: HTTP servers refuse longer ones.
const LONGEST_QUERY: usize = 60_000;

/// Push a ROS package: build an image, determine its interface and publish it as a service.
///
/// PATH is a package or workspace of ROS 1 (catkin) or ROS 2 (ament), which is compiled on the server, a prebuilt
/// install space, or a tar archive of one. With --apt, a Debian package is used instead.
///
/// Once the package is sent, the push continues on the server even if this command ends; `cloudroidctl pushes` lists,
/// follows and cancels pushes. Ctrl-C asks whether to stop it or to leave it; without a terminal, or pressed twice, it
/// stops it.
#[derive(Debug, Default, clap::Args)]
#[command(group(clap::ArgGroup::new("what").required(true).args(["path", "apt"])))]
pub struct PushArgs {
    /// ROS package, workspace or install space, or a tar archive of one.
    path: Option<PathBuf>,
    /// Packaged ROS package to use instead of a PATH, such as opencv_apps.
    #[arg(long, value_name = "NAME")]
    apt: Option<String>,
    /// Name of the service (default: the package's).
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    /// Launch file to run, as roslaunch or ros2 launch finds it in the package.
    #[arg(long, value_name = "FILE", conflicts_with = "nodes")]
    launch: Option<String>,
    /// Executable to run (EXE, or PACKAGE/EXE) with its arguments, in one pair of quotes: --node 'topic_tools/relay /in
    /// /out'; may be given several times. The node has its program's own name, as under rosrun or ros2 run, unless
    /// __name:=NAME (in ROS 2 also __node:=NAME) sets another. In ROS 2 also the class of a component (talkers::Talker,
    /// or PACKAGE/CLASS), followed by remaps and -p NAME:=VALUE; the component gets a container of its own.
    #[arg(long = "node", value_name = "EXE [ARGS]")]
    nodes: Vec<String>,
    /// Private parameter of the nodes, or a global one (/K=V); K:=V is the same; may be given several times.
    #[arg(long = "param", value_name = "K=V", value_parser = parameter)]
    params: Vec<(String, serde_json::Value)>,
    /// Argument of the launch file; K=V is the same; may be given several times.
    #[arg(long = "arg", value_name = "K:=V", value_parser = argument)]
    args: Vec<(String, String)>,
    /// Remapping of a name; may be given several times.
    #[arg(long = "remap", value_name = "A:=B", value_parser = assignment)]
    remaps: Vec<(String, String)>,
    /// TOML or JSON file with additions to the interface, for what the push cannot determine.
    #[arg(long, value_name = "FILE")]
    interface: Option<PathBuf>,
    /// Input and the output that answers it, instead of what the push determines; may be given several times. If a
    /// robot states times, it measures them from the input to this output. Several outputs: /image=/boxes,/view; also
    /// accepts the syntax of stub.toml: '/image -> /boxes by arrival'.
    #[arg(long = "request", value_name = "INPUT=OUTPUT", value_parser = request)]
    requests: Vec<String>,
    /// Base image definition (default: one that fits the package's ROS).
    #[arg(long, value_name = "BASE")]
    base: Option<String>,
    /// Debian package, or package of the workspace or base, that provides a dependency; KEY= if it needs nothing. May
    /// be given several times.
    #[arg(long = "map", value_name = "KEY=PACKAGE", value_parser = mapping)]
    map: Vec<(String, String)>,
    /// Additional Debian or ROS package, for compiling and running; may be given several times.
    #[arg(long = "with", value_name = "PACKAGE")]
    with: Vec<String>,
    /// Build only this package of the workspace and those that it needs; may be given several times. By default, what
    /// no chosen node or launch file needs is not built.
    #[arg(long = "packages-up-to", value_name = "PKG")]
    packages_up_to: Vec<String>,
    /// Do not build this package of the workspace; may be given several times.
    #[arg(long = "packages-skip", value_name = "PKG")]
    packages_skip: Vec<String>,
    /// Compile and run upon this underlay, as pushed with --as-underlay; may be given several times, or with commas. Of
    /// two, the later one lies above.
    #[arg(long, value_name = "UNDERLAY", value_delimiter = ',')]
    on: Vec<String>,
    /// Publish the workspace as an underlay of this name, for others to compile and run upon, instead of a service.
    #[arg(long = "as-underlay", value_name = "NAME", conflicts_with_all = ["apt", "name", "launch", "nodes"])]
    as_underlay: Option<String>,
    /// Arguments of CMake for the packages of the push: --cmake-args '-DWITH_QT=OFF -DCMAKE_BUILD_TYPE=Release'; may be
    /// given several times.
    #[arg(long = "cmake-args", value_name = "ARGS", allow_hyphen_values = true)]
    cmake_args: Vec<String>,
    /// Answers depend on earlier requests (maps, trackers): a robot's local original takes over only while the link is
    /// down, and hands back. Otherwise both may be asked, and the first answer is used. =false states that answers are
    /// independent, if the push would ask.
    #[arg(long, num_args = 0..=1, require_equals = true, default_missing_value = "true", value_name = "BOOL")]
    stateful: Option<bool>,
    #[command(flatten)]
    shared: SharedFlags,
    #[command(flatten)]
    rollout: TermFlags,
    #[command(flatten)]
    wait: WaitFlag,
    /// Print the number of the push when the package is sent, and end: the server continues.
    #[arg(long, conflicts_with = "wait")]
    detach: bool,
    #[command(flatten)]
    limits: Limits,
    #[command(flatten)]
    caps: Caps,
    /// T_desire for robots that state no times, such as 100ms.
    #[arg(long, value_name = "TIME")]
    rrt: Option<Span>,
    /// T_max for robots that state no times (default: T_desire).
    #[arg(long, value_name = "TIME")]
    max_rrt: Option<Span>,
    /// Device by its name in the machine's CDI specifications, such as nvidia.com/gpu=0; may be given several times.
    #[arg(long = "device", value_name = "VENDOR/CLASS=NAME")]
    devices: Vec<String>,
    /// Directory or file of the server to mount read-only; may be given several times.
    #[arg(long = "volume", value_name = "SOURCE:TARGET", value_parser = volume)]
    volumes: Vec<Volume>,
    /// TCP destination that the nodes may connect to; may be given several times.
    #[arg(long = "egress", value_name = "HOST:PORT")]
    egress: Vec<String>,
}

fn parameter(text: &str) -> anyhow::Result<(String, serde_json::Value)> {
    let (key, value) = key_and_value(text).context("write K=V or K:=V")?;
    let value = serde_json::from_str(value).unwrap_or_else(|_| serde_json::Value::String(value.to_owned()));
    Ok((key.to_owned(), value))
}

fn argument(text: &str) -> anyhow::Result<(String, String)> {
    let (key, value) = key_and_value(text).context("write K:=V or K=V")?;
    Ok((key.to_owned(), value.to_owned()))
}

/// Splits `K=V`, or `K:=V` as ROS writes it; `None` without a key.
fn key_and_value(text: &str) -> Option<(&str, &str)> {
    let (key, value) = text.split_once('=')?;
    let key = key.strip_suffix(':').unwrap_or(key);
    (!key.is_empty()).then_some((key, value))
}

fn assignment(text: &str) -> anyhow::Result<(String, String)> {
    match text.split_once(":=") {
        Some((from, to)) if !from.is_empty() => Ok((from.to_owned(), to.to_owned())),
        _ => bail!("write A:=B"),
    }
}

fn request(text: &str) -> Result<String, ParsePairError> {
    api::push::parse_request(text).map(|pair| pair.to_string())
}

fn volume(text: &str) -> anyhow::Result<Volume> {
    match text.split_once(':') {
        Some((source, target)) if source.starts_with('/') && target.starts_with('/') => {
            Ok(Volume { source: source.to_owned(), target: target.to_owned() })
        }
        _ => bail!("write SOURCE:TARGET, both absolute"),
    }
}

fn mapping(text: &str) -> anyhow::Result<(String, String)> {
    match text.split_once('=') {
        Some((key, package)) if !key.is_empty() => Ok((key.to_owned(), package.to_owned())),
        _ => bail!("write KEY=PACKAGE, or KEY= for a dependency that needs no package"),
    }
}

impl PushArgs {
    /// Creates the push of a file that export has written.
    pub fn from_export(file: PathBuf, name: Option<String>, rollout: TermFlags, wait: WaitFlag) -> PushArgs {
        PushArgs { path: Some(file), name, rollout, wait, ..PushArgs::default() }
    }

    /// Sends the package, prints the progress, and finally the service's address and interface.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let rolls_out = self.rollout.terms().is_some();
        let wait = self.wait;
        let Some(service) = self.publish(client, format, interrupt::ask).await? else {
            return Ok(());
        };
        let name = &service.summary.name;
        let newest = service.revisions.iter().map(|one| one.number).max();
        if let Some(newest) = newest.filter(|newest| rolls_out && *newest != service.summary.revision) {
            output::eprint_line(&format!(
                "revision {newest} is on trial beside the current one, {}, which is described below",
                service.summary.revision
            ));
        }
        if format == OutputFormat::Table {
            services::show(&service)?;
        }
        // The first revision of a service replaces nothing.
        if !rolls_out || service.revisions.len() < 2 {
            return Ok(());
        }
        let rollout = if wait.is_set() {
            rollout::wait_until_over(client, name, wait).await?
        } else {
            client.get(&format!("/api/v1/services/{}/rollout", percent_encode(name))).await?
        };
        if format == OutputFormat::Table {
            output::line("")?;
            rollout::show(&rollout)?;
        }
        if wait.is_set() { rollout::require_promoted(&rollout) } else { Ok(()) }
    }

    /// Publishes the package under another name, without printing the service's address and interface.
    pub async fn publish_as(mut self, name: &str, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        ensure!(!self.detach, "--detach is for push alone: this command needs the result");
        self.name = Some(name.to_owned());
        // What needs the result has no use for a push that is left alone.
        let stop = async |_: u64| InterruptAnswer::Stop;
        self.publish(client, format, stop).await.map(|_| ())
    }

    /// Publishes the package; `None` if the push goes on without this command, and for an underlay. `on_interrupt`
    /// decides what becomes of the push with this number.
    async fn publish(
        self,
        client: &DaemonClient,
        format: OutputFormat,
        on_interrupt: impl AsyncFn(u64) -> InterruptAnswer,
    ) -> anyhow::Result<Option<ServiceDetail>> {
        let mut options = self.options()?;
        let source = match self.path {
            Some(path) => Some(PushSource::open(path).await?),
            None => None,
        };
        options.created = source.as_ref().and_then(PushSource::find_creation_time);
        let query = serde_json::to_string(&options)?;
        let uri = format!("/api/v1/push?options={}", percent_encode(&query));
        if uri.len() > LONGEST_QUERY {
            bail!("the options are too long, {} bytes; shorten --interface or the parameters", uri.len());
        }
        let sent = PushRequest { uri, source, is_detached: self.detach };
        sending::publish(client, sent, PushProgress::new(format), on_interrupt).await
    }

    fn options(&self) -> anyhow::Result<PushOptions> {
        let interface = match &self.interface {
            Some(path) => Some(
                std::fs::read_to_string(path)
                    .with_context(|| format!("cannot read the interface file {}", path.display()))?,
            ),
            None => None,
        };
        let source = match (&self.apt, &self.path) {
            (Some(package), _) => format!("--apt {package}"),
            (None, Some(path)) => path.display().to_string(),
            (None, None) => String::new(),
        };
        Ok(PushOptions {
            name: self.name.clone(),
            apt: self.apt.clone(),
            base: self.base.clone(),
            launch: self.launch.clone(),
            nodes: self.nodes.clone(),
            params: self.params.iter().cloned().collect(),
            args: self.args.iter().cloned().collect(),
            remaps: self.remaps.iter().cloned().collect(),
            interface,
            requests: self.requests.clone(),
            map: self.map.iter().cloned().collect(),
            with: self.with.clone(),
            packages_up_to: self.packages_up_to.clone(),
            packages_skip: self.packages_skip.clone(),
            on: self.on.clone(),
            as_underlay: self.as_underlay.clone(),
            cmake_args: self.cmake_args.iter().flat_map(|text| text.split_whitespace()).map(str::to_owned).collect(),
            limits: self.limits,
            caps: self.caps,
            sla: Sla { rrt: self.rrt, max_rrt: self.max_rrt, ..Sla::default() },
            grants: Grants {
                devices: self.devices.clone(),
                volumes: self.volumes.clone(),
                egress: self.egress.clone(),
            },
            stateful: self.stateful == Some(true),
            stateless: self.stateful == Some(false),
            shared: self.shared.shared_settings(),
            rollout: self.rollout.terms(),
            created: None,
            source,
        })
    }
}

/// Returns a file as the body of a request.
pub fn file_body(path: &Path) -> anyhow::Result<RequestBody> {
    let about = std::fs::metadata(path).with_context(|| format!("cannot read {}", path.display()))?;
    ensure!(about.is_file(), "{} is not a file", path.display());
    // A failed read ends the body with an error.
    Ok(PushSource::Archive(path.to_owned()).into_body().0)
}

/// Returns an image or a root file system as the body of a request: an archive, `-` for standard input, or the
/// directory of an OCI image layout, which is packed.
pub fn image_body(path: &Path) -> anyhow::Result<RequestBody> {
    if path == Path::new("-") {
        return Ok(PushSource::Archive("/dev/stdin".into()).into_body().0);
    }
    let about = match std::fs::metadata(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => bail!(
            "{name} is not a file here; an image of a registry is named docker://HOST/REPOSITORY:TAG, one of podman or \
                docker on this machine is saved first: podman save NAME > image.tar",
            name = path.display()
        ),
        about => about.with_context(|| format!("cannot read {}", path.display()))?,
    };
    if !about.is_dir() {
        return Ok(PushSource::Archive(path.to_owned()).into_body().0);
    }
    ensure!(
        path.join("oci-layout").is_file() && path.join("index.json").is_file(),
        "{name} is a directory without oci-layout and index.json; pack a root file system as root: tar --numeric-owner \
            --one-file-system -C {name} -cf root.tar .",
        name = path.display()
    );
    Ok(PushSource::Layout(path.to_owned()).into_body().0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{CommandFactory, Parser};

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        push: PushArgs,
    }

    fn parse(line: &str) -> Result<PushArgs, clap::Error> {
        Line::try_parse_from(std::iter::once("push").chain(line.split_whitespace())).map(|line| line.push)
    }

    #[test]
    fn everything_that_is_typed_is_sent() {
        let push = parse(
            "--apt opencv_apps --name people --base b --node people_detect --node other/node --param debug_view=false \
             --param /rate=1.5 --param word=hi --param list=[1,2] --remap image:=/camera/image --map \
             eigen=libeigen3-dev \
             --with opencv-data --cpus 1.5 --memory 512M --max-cpus 2 --max-memory 1G \
             --rrt 100ms --max-rrt 0.3 --request /image=/people_detect/found",
        )
        .expect("valid");
        let options = push.options().expect("no file is read");
        let expected = serde_json::json!({
            "apt": "opencv_apps", "name": "people", "base": "b", "nodes": ["people_detect", "other/node"],
            "params": {"debug_view": false, "/rate": 1.5, "word": "hi", "list": [1, 2]},
            "remaps": {"image": "/camera/image"}, "map": {"eigen": "libeigen3-dev"}, "with": ["opencv-data"],
            "requests": ["/image -> /people_detect/found"],
            "limits": {"cpus": 1.5, "memory": 536_870_912},
            "caps": {"cpus": 2.0, "memory": 1_073_741_824}, "sla": {"rrt": "100ms", "max_rrt": "300ms"},
                "source": "--apt opencv_apps"
        });
        assert_eq!(serde_json::to_value(options).expect("plain data"), expected);
    }

    #[test]
    fn whether_answers_depend_on_earlier_ones_may_be_said_or_left_open() {
        for (line, said) in [
            ("./pkg", (false, false)),
            ("--stateful ./pkg", (true, false)),
            ("./pkg --stateful=false", (false, true)),
            ("./pkg --stateful=true", (true, false)),
        ] {
            let options = parse(line).map(|push| push.options().expect("no file is read"));
            let options = options.expect(line);
            assert_eq!((options.stateful, options.stateless), said, "{line}");
        }
        assert_eq!(parse("./pkg --stateful=maybe").expect_err("no").exit_code(), 2);
    }

    #[test]
    fn a_node_takes_arguments() {
        let line = ["push", "--apt", "topic_tools", "--node", "topic_tools/relay /in /out"];
        let push = Line::try_parse_from(line).expect("valid").push;
        let options = push.options().expect("no file is read");
        assert_eq!(options.nodes, ["topic_tools/relay /in /out"]);
    }

    #[test]
    fn a_launch_file_takes_arguments() {
        let push =
            parse("./pkg --launch two.launch --arg word:=bonjour --arg empty:= --arg plain=x:=y").expect("valid");
        let options = push.options().expect("no file is read");
        assert_eq!(options.args["word"], "bonjour");
        assert_eq!(options.args["empty"], "");
        assert_eq!(options.args["plain"], "x:=y");
        assert_eq!(options.source, "./pkg");
    }

    #[test]
    fn parameters_are_written_as_in_ros_or_shorter() {
        for (written, key, value) in [
            ("rate=1.5", "rate", serde_json::json!(1.5)),
            ("rate:=1.5", "rate", serde_json::json!(1.5)),
            ("/lab/word:=a=b", "/lab/word", serde_json::json!("a=b")),
            ("word=:=", "word", serde_json::json!(":=")),
        ] {
            let options = parse(&format!("./pkg --param {written}")).expect(written).options().expect("no file");
            assert_eq!(options.params, [(key.to_owned(), value)].into(), "{written}");
        }
    }

    #[test]
    fn underlays_are_named_one_by_one_or_with_commas() {
        let options = |line: &str| parse(line).expect(line).options().expect("no file is read");
        assert_eq!(options("./ws --on maps,arms --on lab").on, ["maps", "arms", "lab"]);
        let underlay = options("./ws --as-underlay maps --on lab --packages-skip demo");
        assert_eq!((underlay.as_underlay.as_deref(), &underlay.on[..]), (Some("maps"), &["lab".to_owned()][..]));
        for line in
            ["--apt p --as-underlay maps", "./ws --as-underlay maps --node a", "./ws --as-underlay maps --name a"]
        {
            assert_eq!(parse(line).expect_err(line).exit_code(), 2, "{line}");
        }
    }

    #[test]
    fn packages_are_selected_in_colcons_words() {
        let words = [
            "push",
            "./ws",
            "--packages-up-to",
            "a",
            "--packages-skip",
            "b",
            "--packages-skip",
            "c",
            "--cmake-args",
            "-DA=1  -DB=2",
            "--cmake-args=-Wno-dev",
        ];
        let options = Line::try_parse_from(words).expect("valid").push.options().expect("no file is read");
        assert_eq!(options.packages_up_to, ["a"]);
        assert_eq!(options.packages_skip, ["b", "c"]);
        assert_eq!(options.cmake_args, ["-DA=1", "-DB=2", "-Wno-dev"]);
    }

    /// Source of the page's fields, one per line.
    const FIELDS: &str = include_str!("../../../web/src/lib/options.ts");
    /// Source of the form around the fields.
    const FORM: &str = include_str!("../../../web/src/pages/Deploy.svelte");

    /// Returns the text between two others, if both are found.
    fn text_between<'a>(line: &'a str, before: &str, after: &str) -> Option<&'a str> {
        let (_, rest) = line.split_once(before)?;
        Some(rest.split_once(after)?.0)
    }

    /// Returns flag and label of each field of the page.
    fn fields() -> Vec<(&'static str, &'static str)> {
        let field = |line: &'static str| {
            let flag = text_between(line, "flag: '", "'")?;
            let label = text_between(line, "label: '", "', flag: ")
                .or_else(|| text_between(line, "label: \"", "\", flag: "))?;
            Some((flag, label))
        };
        FIELDS.lines().filter_map(field).collect()
    }

    #[test]
    fn the_page_asks_for_all_that_the_command_line_does() {
        let fields = fields();
        assert!(fields.len() > 30, "{fields:?}");
        // Chosen with controls of the form that are not fields.
        let chosen = ["--apt", "--stateful", "--shared", "--idempotent"];
        // The service's own page shows the progress of a rollout while it is open, and a page may always be left.
        // An underlay is no service, which the page is about.
        let needless = ["--wait", "--detach", "--as-underlay"];
        let command = Line::command();
        let flags: Vec<String> =
            command.get_arguments().filter_map(|argument| Some(format!("--{}", argument.get_long()?))).collect();
        for flag in &flags {
            let written = fields.iter().any(|(named, _)| named == flag);
            let is_chosen = chosen.contains(&&**flag) && FORM.contains(&**flag);
            assert!(written || is_chosen || needless.contains(&&**flag), "the page does not ask for {flag}");
        }
        let written = fields.iter().map(|(flag, _)| *flag);
        for flag in written.chain(chosen).chain(needless) {
            assert!(flags.iter().any(|known| known == flag), "there is no {flag}");
        }
    }

    #[test]
    fn the_page_names_the_defaults_that_hold() {
        let (shared, terms) = (api::Shared::default(), api::rollout::RolloutTerms::default());
        let hold = [
            ("--min", f64::from(shared.min)),
            ("--max", f64::from(shared.max)),
            ("--replicas", f64::from(shared.replicas)),
            ("--calls", f64::from(shared.calls)),
            ("--bound", terms.bound),
            ("--samples", f64::from(terms.samples)),
            // Default of the kernel (cgroup-v2.rst).
            ("--cpu-weight", 100.0),
        ];
        let named = |label: &str| {
            let (_, default) = label.split_once("default: ")?;
            let end = default.find(|c: char| !c.is_ascii_digit() && c != '.');
            default[..end.unwrap_or(default.len())].parse::<f64>().ok()
        };
        let fields = fields();
        for (flag, holds) in hold {
            let label = fields.iter().find(|(named, _)| *named == flag);
            let label = label.map(|(_, label)| *label).unwrap_or_default();
            assert_eq!(named(label), Some(holds), "{flag}: {label:?}");
        }
        for (flag, label) in fields {
            let known = hold.iter().any(|(known, _)| *known == flag);
            assert!(known || named(label).is_none(), "{flag}: {label:?}");
        }
    }

    #[test]
    fn what_makes_no_sense_is_a_usage_error() {
        for line in [
            "",
            "./pkg --apt opencv_apps",
            "./pkg --launch a.launch --node b",
            "./pkg --detach --canary 1 --wait",
            "./pkg --param novalue",
            "./pkg --param =v",
            "./pkg --param :=v",
            "./pkg --arg a",
            "./pkg --remap a",
            "./pkg --map key",
            "./pkg --map =deb",
            "./pkg --request /image",
            "./pkg --request image=/boxes",
            "./pkg --cpus none",
            "./pkg --cpus 0",
            "./pkg --max-cpus 0",
            "./pkg --max-memory lots",
            "./pkg --rrt soon",
            "./pkg --memory lots",
        ] {
            assert_eq!(parse(line).expect_err(line).exit_code(), 2, "{line}");
        }
    }
}
