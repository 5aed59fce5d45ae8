//! Parsers for the output of apt.

use std::collections::BTreeSet;

use crate::debian_package::{Deb, Relations};

/// Parses a line `'https://…/libfoo1_1.2-3_amd64.deb' libfoo1_1%3a1.2-3_amd64.deb 12345 SHA256:…`.
pub(super) fn parse_uri(line: &str) -> Option<Deb> {
    let (_, rest) = line.strip_prefix('\'')?.split_once("' ")?;
    let file = rest.split(' ').next()?.strip_suffix(".deb")?;
    let mut parts = file.splitn(3, '_');
    Some(Deb {
        name: parts.next()?.to_owned(),
        version: parts.next()?.replace("%3a", ":"),
        architecture: parts.next()?.to_owned(),
    })
}

pub(super) fn field(stanza: &str, name: &str) -> Option<String> {
    stanza.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(": ").map(str::to_owned))
}

/// Parses the name and the relations of a stanza.
pub(super) fn parse_relations(stanza: &str) -> Option<(String, Relations)> {
    let names = |name: &str| -> BTreeSet<String> {
        let text = field(stanza, name).unwrap_or_default();
        let items = text.split([',', '|']);
        // `libfoo:any (>= 1.0)`
        let names = items.filter_map(|item| item.split([' ', ':', '(']).find(|name| !name.is_empty()));
        names.map(str::to_owned).collect()
    };
    let name = field(stanza, "Package")?;
    let source = field(stanza, "Source").unwrap_or_else(|| name.clone());
    let about = Relations {
        source: source.split(' ').next().unwrap_or_default().to_owned(),
        needs: names("Depends").into_iter().chain(names("Pre-Depends")).collect(),
        before: names("Pre-Depends"),
        provides: names("Provides"),
    };
    Some((name, about))
}

/// Fields of a stanza that identify a package.
pub(super) const NAMING: [&str; 3] = ["Package: ", "Version: ", "Architecture: "];

/// Parses a stanza of `apt-cache dumpavail`.
pub(super) fn parse_stanza(stanza: &str) -> Option<Deb> {
    let field = |name: &str| field(stanza, name);
    Some(Deb { name: field("Package")?, version: field("Version")?, architecture: field("Architecture")? })
}

/// Extracts the explanation from a failure of apt: its errors, signature problems, and the table of unmet dependencies.
pub(super) fn extract_errors(lines: &str) -> String {
    let mut table = false;
    let mut words = Vec::new();
    for line in lines.lines() {
        if line.starts_with("The following packages have unmet") {
            table = true;
        } else if !line.starts_with(' ') {
            table = false;
        }
        if table || line.starts_with("E:") || line.contains("GPG error") {
            words.push(line.trim());
        }
    }
    if words.is_empty() { lines.to_owned() } else { words.join("; ") }
}

/// Returns the next step after a failure to fetch or verify the lists.
pub(super) fn suggest_next_step(words: &str) -> &'static str {
    let reasons = [
        (
            "NO_PUBKEY",
            "the archive is signed by an unknown key: if the key is right, save its key ring as a file and name it \
                with [signed-by=FILE] under [archives] in the configuration",
        ),
        ("is not signed", "unsigned packages are not installed: take a mirror that has the distribution's InRelease"),
        (
            "Hash Sum mismatch",
            "the lists do not match their signature: the mirror is being updated, or they were tampered with; push \
                again later, or take another mirror",
        ),
    ];
    let known = reasons.iter().find(|(part, _)| words.contains(part));
    known.map_or("push again when this host can reach the archive", |(_, next)| next)
}
