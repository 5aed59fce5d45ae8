//! Package sources. No mirror is hard-coded in this repository: the address is the host's own, mmdebstrap's default, or
//! set by the administrator.

use std::fs;
use std::path::{Path, PathBuf};

use crate::apt::Sources;
use crate::base::Base;
use crate::error::{Error, IoContext};
use crate::process;

/// Returns the sources.list for a base.
pub(crate) async fn source_lines(sources: &Sources, base: &Base, scratch: &Path) -> Result<String, Error> {
    if let Some(lines) = sources.0.get(&base.name) {
        return Ok(lines.join("\n") + "\n");
    }
    let own = host_sources(Path::new("/etc/apt"), &base.suite)?;
    if own.is_empty() { mmdebstrap_default_sources(&base.suite, scratch).await } else { Ok(own) }
}

/// Returns the host's apt sources of this release (and its updates and security), as one-line entries. Empty if the
/// host has another release.
fn host_sources(etc: &Path, suite: &str) -> Result<String, Error> {
    let mut files = vec![etc.join("sources.list")];
    let parts = etc.join("sources.list.d");
    let mut more: Vec<PathBuf> =
        fs::read_dir(&parts).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
    more.sort();
    files.extend(more);
    let mut lines = Vec::new();
    for file in files.iter().filter(|file| file.is_file()) {
        let of_kind = |kind: &str| file.extension().is_some_and(|extension| extension == kind);
        if of_kind("sources") {
            let text = fs::read_to_string(file).io_context("reading", file)?;
            lines.extend(text.split("\n\n").flat_map(|stanza| stanza_lines(stanza, suite)));
        } else if of_kind("list") {
            let text = fs::read_to_string(file).io_context("reading", file)?;
            lines.extend(text.lines().filter(|line| is_entry_of_suite(line, suite)).map(|line| line.trim().to_owned()));
        }
    }
    // Updates alone are not sufficient: the release itself must be included.
    let release = lines.iter().any(|line| line.split_whitespace().any(|word| word == suite));
    Ok(if release { lines.join("\n") + "\n" } else { String::new() })
}

fn is_suite_word(word: &str, suite: &str) -> bool {
    word == suite || word.strip_prefix(suite).is_some_and(|rest| rest.starts_with(['-', '/']))
}

/// Returns whether an entry `deb [options] URI SUITE COMPONENT…` is of this release.
fn is_entry_of_suite(line: &str, suite: &str) -> bool {
    let line = line.split('#').next().unwrap_or("").trim();
    let Some(rest) = line.strip_prefix("deb ") else {
        return false;
    };
    let rest = match rest.trim_start().strip_prefix('[') {
        Some(options) => options.split_once(']').map_or("", |(_, rest)| rest),
        None => rest,
    };
    rest.split_whitespace().nth(1).is_some_and(|word| is_suite_word(word, suite))
}

/// Converts a deb822 stanza to one-line entries (sources.list(5)).
fn stanza_lines(stanza: &str, suite: &str) -> Vec<String> {
    let field = |name: &str| -> String {
        let mut lines = stanza
            .lines()
            .filter(|line| !line.starts_with('#'))
            .skip_while(|line| !line.split_once(':').is_some_and(|(key, _)| key.trim().eq_ignore_ascii_case(name)));
        let first = lines.next().and_then(|line| line.split_once(':')).map_or("", |(_, value)| value.trim());
        let more = lines.take_while(|line| line.starts_with([' ', '\t']));
        std::iter::once(first).chain(more).collect::<Vec<_>>().join(" ")
    };
    let enabled = !field("Enabled").trim().eq_ignore_ascii_case("no");
    if !enabled || !field("Types").split_whitespace().any(|kind| kind == "deb") {
        return Vec::new();
    }
    let mut options = Vec::new();
    let signed_by = field("Signed-By");
    // A key may also be embedded in the file; one-line entries cannot express that.
    if signed_by.trim_start().starts_with('/') {
        options.push(format!("signed-by={}", signed_by.split_whitespace().collect::<Vec<_>>().join(",")));
    }
    let architectures = field("Architectures");
    if !architectures.trim().is_empty() {
        options.push(format!("arch={}", architectures.split_whitespace().collect::<Vec<_>>().join(",")));
    }
    let options = if options.is_empty() { String::new() } else { format!("[{}] ", options.join(" ")) };
    let (uris, suites, components) = (field("URIs"), field("Suites"), field("Components"));
    let components = components.split_whitespace().collect::<Vec<_>>().join(" ");
    let mut lines = Vec::new();
    for uri in uris.split_whitespace() {
        for word in suites.split_whitespace().filter(|word| is_suite_word(word, suite)) {
            lines.push(format!("deb {options}{uri} {word} {components}").trim_end().to_owned());
        }
    }
    lines
}

/// Returns the default sources of mmdebstrap: it is started, and stopped once it has written its list.
async fn mmdebstrap_default_sources(suite: &str, scratch: &Path) -> Result<String, Error> {
    let target = tempfile::tempdir_in(scratch).io_context("creating a directory in", scratch)?;
    let list = target.path().join("sources.list");
    let mut ask = process::command("mmdebstrap");
    ask.env("LIST", &list).args(["--mode=root", "--variant=custom", "--format=directory"]);
    ask.arg("--setup-hook=cat \"$1/etc/apt/sources.list\" > \"$LIST\"; exit 1");
    ask.arg(suite).arg(target.path().join("root"));
    let result = process::run_in_namespaces(ask, "mmdebstrap", |_, _| {}).await;
    match (fs::read_to_string(&list), result) {
        (Ok(text), _) if !text.trim().is_empty() => Ok(text),
        (_, Err(error)) => Err(error),
        (Err(source), Ok(())) => Err(Error::io("reading", &list, source)),
        (Ok(_), Ok(())) => Err(Error::Program {
            program: "mmdebstrap".into(),
            status: "done".into(),
            last_lines: format!("it has no mirror of {suite}: name one in the configuration"),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_entries_of_the_release_are_taken() {
        let etc = tempfile::tempdir().expect("a directory");
        let parts = etc.path().join("sources.list.d");
        fs::create_dir(&parts).expect("made");
        fs::write(
            parts.join("debian.sources"),
            "Types: deb\n# a note\nURIs: http://example.invalid/debian\nSuites: bookworm bookworm-updates trixie\n\
             Components: main\nSigned-By: /usr/share/keyrings/x.gpg\n\n\
             Types: deb\nEnabled: no\nURIs: http://example.invalid/off\nSuites: bookworm\nComponents: main\n",
        )
        .expect("written");
        fs::write(
            parts.join("other.list"),
            "deb [arch=amd64] http://example.invalid/tool stable main\n#deb http://x bookworm main\n\
             deb [arch=amd64 signed-by=/k] http://example.invalid/sec bookworm-security main\n",
        )
        .expect("written");
        fs::write(parts.join("gone.list.disabled"), "deb http://example.invalid bookworm main\n").expect("written");
        let lines = host_sources(etc.path(), "bookworm").expect("read");
        assert_eq!(
            lines,
            "deb [signed-by=/usr/share/keyrings/x.gpg] http://example.invalid/debian bookworm main\n\
             deb [signed-by=/usr/share/keyrings/x.gpg] http://example.invalid/debian bookworm-updates main\n\
             deb [arch=amd64 signed-by=/k] http://example.invalid/sec bookworm-security main\n"
        );
        assert_eq!(host_sources(etc.path(), "noble").expect("read"), "");
    }
}
