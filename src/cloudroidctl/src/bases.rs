//! `bases`: what images are built upon, and moving it to another server.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use api::bases::{BaseDetail, BaseState, BaseSummary};
use api::{Size, count};
use hyper::body::Incoming;
use hyper::{Method, Response};
use indicatif::{ProgressBar, ProgressStyle};

use crate::account::password::read_existing_password;
use crate::client::{self, DaemonClient, percent_encode};
use crate::output::{self, OutputFormat, Table};
use crate::push;
use crate::registry::{self, Credentials, ImageReference, PullSize};

/// List bases and what each has, move one to another server, and make one of your own image.
///
/// A base is the operating system and ROS below an image. The first push that uses it sets it up and downloads packages
/// for that; a base that another server has exported, and one made of an image, are there at once.
#[derive(Debug, clap::Args)]
pub struct BasesArgs {
    #[command(subcommand)]
    verb: Option<BasesCommand>,
}

#[derive(Debug, clap::Subcommand)]
enum BasesCommand {
    List(ListBases),
    Show(ShowBase),
    Export(ExportBase),
    Import(ImportBase),
    Rm(RemoveBase),
}

/// List bases (the default).
#[derive(Debug, clap::Args)]
struct ListBases {}

/// Show the ROS and Python packages of a base, with their versions.
#[derive(Debug, clap::Args)]
struct ShowBase {
    /// Name of the base.
    name: String,
    /// List the Debian packages, too.
    #[arg(long)]
    all: bool,
}

/// Export a base to a file for another server, where `cloudroidctl base import FILE` takes it.
///
/// The file is a tar archive of an OCI image layout: the layers of the base and, once sources were pushed, of the
/// toolchain, with the index of the package archive.
#[derive(Debug, clap::Args)]
struct ExportBase {
    /// Name of the base.
    name: String,
    /// Output file (default: NAME.oci.tar). An existing file is replaced when the new one is complete.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Import a base: an image, a root file system, or one that `cloudroidctl base export` has written.
///
/// With --from, a new base is made of what a lab has: an image of a registry (docker://HOST/REPOSITORY:TAG), the
/// archive of an image (podman save, docker save, skopeo copy to oci-archive or oci), or the root file system of a
/// robot or of mmdebstrap as tar, gzip or zstd. Its layers are kept as they are; what they hold is found by looking and
/// printed as a table.
///
/// Registries are asked from here, not by the server, and with the password of podman login or docker login unless
/// there is --user.
///
/// Without --from, the server must have the same definition of the base. Packages that need nothing else are pushed
/// without any download.
#[derive(Debug, clap::Args)]
struct ImportBase {
    /// Name of the new base with --from, else the file written by base export.
    #[arg(value_name = "NAME|FILE")]
    what: PathBuf,
    /// Image or root file system: docker://HOST/REPOSITORY:TAG, an archive, the directory of an OCI image layout, or -
    /// for standard input.
    #[arg(long, value_name = "IMAGE")]
    from: Option<PathBuf>,
    /// User name for the registry; its password is asked for.
    #[arg(long, value_name = "NAME", requires = "from")]
    user: Option<String>,
    /// Read the password from the first line of standard input.
    #[arg(long, requires = "user")]
    password_stdin: bool,
    /// Replace an imported base of this name. Services keep the layers that they were built on.
    #[arg(long, requires = "from")]
    replace: bool,
    /// ROS distribution that counts, if there are several or if nothing says which it is, such as jazzy.
    #[arg(long, value_name = "NAME", requires = "from")]
    ros_distro: Option<String>,
}

/// Remove an imported base. If the server has a definition of it, the next push that uses it sets it up.
#[derive(Debug, clap::Args)]
struct RemoveBase {
    /// Name of the base.
    name: String,
}

impl BasesArgs {
    /// Sends the requests and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        match self.verb.unwrap_or(BasesCommand::List(ListBases {})) {
            BasesCommand::List(_) => list(&client.get::<Vec<BaseSummary>>("/api/v1/bases").await?, format),
            BasesCommand::Show(verb) => {
                let path = format!("/api/v1/bases/{}", percent_encode(&verb.name));
                show(&client.get::<BaseDetail>(&path).await?, verb.all, format)
            }
            BasesCommand::Export(verb) => verb.run(client, format).await,
            BasesCommand::Import(verb) => verb.run(client, format).await,
            BasesCommand::Rm(verb) => {
                let path = format!("/api/v1/bases/{}", percent_encode(&verb.name));
                let base: BaseDetail = client.delete(&path).await?;
                match format {
                    OutputFormat::Json => output::json(&base),
                    OutputFormat::Table => output::line(&format!("the imported base {} is removed", verb.name)),
                }
            }
        }
    }
}

impl ExportBase {
    async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let target = self.output.unwrap_or_else(|| PathBuf::from(format!("{}.oci.tar", self.name)));
        let path = format!("/api/v1/bases/{}/archive", percent_encode(&self.name));
        let bytes = client.download(&path, &target).await?;
        match format {
            OutputFormat::Json => output::json(&serde_json::json!({ "path": target, "bytes": bytes })),
            OutputFormat::Table => output::line(&format!("{}: base {}, {}", target.display(), self.name, Size(bytes))),
        }
    }
}

impl ImportBase {
    /// Sends the image or root file system.
    async fn send_image(&self, client: &DaemonClient, path: &str, from: &Path) -> anyhow::Result<Response<Incoming>> {
        let Some(image) = from.to_str().filter(|text| text.starts_with(registry::SCHEME)) else {
            ensure!(self.user.is_none(), "--user is for images of registries, {}HOST/REPOSITORY:TAG", registry::SCHEME);
            return client.send(Method::PUT, path, push::image_body(from)?).await;
        };
        let image: ImageReference = image.parse()?;
        let architecture = find_architecture(client).await?;
        let found = registry::find_image(&image, self.read_credentials(&image)?, &architecture).await?;
        let PullSize { layers, bytes } = found.size();
        output::eprint_line(&format!("pulling {image}: {}, {}", count(layers, "layer"), Size(bytes)));
        let bar = new_bar(bytes);
        let arriving = bar.clone();
        let (body, pulling) = found.into_body(move |bytes| arriving.inc(bytes));
        let answer = client.send(Method::PUT, path, body).await;
        bar.finish_and_clear();
        // Whatever the daemon reports about the truncated archive, that is the cause.
        answer.map_err(|error| pulling.into_error().unwrap_or(error))
    }

    /// Reads the password of the user that was named, if one was.
    fn read_credentials(&self, image: &ImageReference) -> anyhow::Result<Option<Credentials>> {
        let Some(user) = &self.user else {
            return Ok(None);
        };
        let prompt = format!("Password of {user} for {}: ", image.registry);
        let password = read_existing_password(self.password_stdin, &prompt)?;
        Credentials::new(user.clone(), password).map(Some)
    }

    async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let answer = match &self.from {
            Some(from) => {
                let name = self.what.to_str().context("the name of a base is letters, digits, '-', '_' and '.'")?;
                let mut path = format!("/api/v1/bases/{}?replace={}", percent_encode(name), self.replace);
                if let Some(distribution) = &self.ros_distro {
                    path += &format!("&ros_distro={}", percent_encode(distribution));
                }
                self.send_image(client, &path, from).await?
            }
            None => client.send(Method::POST, "/api/v1/bases", push::file_body(&self.what)?).await?,
        };
        let base: BaseDetail = client::read_json(answer).await?;
        match format {
            OutputFormat::Json => output::json(&base),
            OutputFormat::Table => {
                let tools = if base.summary.toolchain { "with" } else { "without" };
                let name = &base.summary.name;
                output::line(&format!("base {name} is imported, {tools} the toolchain for compiling"))?;
                print_findings(&base)
            }
        }
    }
}

/// Returns the architecture of the server in the terms of image registries, which are those of Go.
async fn find_architecture(client: &DaemonClient) -> anyhow::Result<String> {
    let status: api::Status = client.get("/api/v1/status").await?;
    let name = if status.architecture.is_empty() { std::env::consts::ARCH } else { status.architecture.as_str() };
    Ok(match name {
        "x86_64" => "amd64",
        "aarch64" => "arm64",
        other => other,
    }
    .to_owned())
}

/// Shows how much of an image was pulled, on a terminal.
fn new_bar(bytes: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:30} {bytes}/{total_bytes} {bytes_per_sec} {eta}");
    let bar = if std::io::stderr().is_terminal() { ProgressBar::new(bytes) } else { ProgressBar::hidden() };
    match style {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

/// Prints what was found in the image of a base; nothing for other bases.
fn print_findings(base: &BaseDetail) -> anyhow::Result<()> {
    if base.findings.is_empty() {
        return Ok(());
    }
    output::line("")?;
    let mut table = Table::new(&["WHAT", "FOUND", "CONSEQUENCE"]);
    for finding in &base.findings {
        table.row([finding.subject.clone(), finding.found.clone(), finding.consequence.clone()]);
    }
    table.print()?;
    output::line("")
}

fn state_word(state: BaseState) -> &'static str {
    match state {
        BaseState::NotSetUp => "not set up",
        BaseState::Ready => "ready",
        BaseState::Imported => "imported",
    }
}

fn list(all: &[BaseSummary], format: OutputFormat) -> anyhow::Result<()> {
    if format == OutputFormat::Json {
        return output::json(&all);
    }
    let mut table = Table::new(&["NAME", "ROS", "SYSTEM", "STATE", "SIZE", "SUMMARY"]);
    for one in all {
        let size = if one.bytes.0 == 0 { "-".to_owned() } else { one.bytes.to_string() };
        table.row([
            one.name.clone(),
            format!("{} {}", one.ros, one.distribution),
            one.system.clone(),
            state_word(one.state).to_owned(),
            size,
            one.summary.clone(),
        ]);
    }
    table.print_list("no bases")
}

fn show(base: &BaseDetail, all: bool, format: OutputFormat) -> anyhow::Result<()> {
    if format == OutputFormat::Json {
        return output::json(base);
    }
    let about = &base.summary;
    output::line(&format!("{}: {}", about.name, about.summary))?;
    output::line(&format!("ROS {} {} on {}", about.ros, about.distribution, about.system))?;
    if about.state == BaseState::NotSetUp {
        output::line("not set up yet: the first push with it does that, or import it with: cloudroidctl base import")?;
        let includes = base.includes.join(", ");
        return output::line(&format!("it will have these packages and what they depend on: {includes}"));
    }
    let tools = if about.toolchain { "with" } else { "without" };
    output::line(&format!("{}, {}, {tools} the toolchain for compiling\n", state_word(about.state), about.bytes))?;
    print_findings(base)?;
    let kinds = [("ROS PACKAGE", &base.ros_packages), ("PYTHON PACKAGE", &base.python_packages)];
    let debian = all.then_some(("DEBIAN PACKAGE", &base.debian_packages));
    for (title, packages) in kinds.into_iter().chain(debian) {
        print_versions(title, packages)?;
    }
    if all {
        return Ok(());
    }
    output::line(&format!("and {} Debian packages (--all lists them)", base.debian_packages.len()))
}

fn print_versions(title: &str, packages: &BTreeMap<String, String>) -> anyhow::Result<()> {
    if packages.is_empty() {
        return Ok(());
    }
    let mut table = Table::new(&[title, "VERSION"]);
    for (name, version) in packages {
        table.row([name.clone(), version.clone()]);
    }
    table.print()?;
    output::line("")
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        bases: BasesArgs,
    }

    #[test]
    fn without_a_verb_bases_are_listed() {
        let parse = |words: &[&str]| Line::try_parse_from([&["bases"][..], words].concat()).map(|line| line.bases.verb);
        assert!(parse(&[]).expect("valid").is_none());
        assert!(matches!(parse(&["show", "x", "--all"]).expect("valid"), Some(BasesCommand::Show(show)) if show.all));
        assert_eq!(parse(&["show"]).expect_err("no name").exit_code(), 2);
        for alone in [&["import", "x", "--replace"][..], &["import", "x", "--ros-distro", "jazzy"], &["import"]] {
            assert_eq!(parse(alone).expect_err("nothing to make it from").exit_code(), 2);
        }
        for alone in [&["import", "x", "--user", "me"][..], &["import", "x", "--from", "y", "--password-stdin"]] {
            assert_eq!(parse(alone).expect_err("nothing to log in to").exit_code(), 2);
        }
        let import = parse(&["import", "mine", "--from", "image.tar", "--replace"]).expect("valid");
        assert!(matches!(import, Some(BasesCommand::Import(import)) if import.replace));
    }
}
