//! What apt prints, parsed.

use std::collections::BTreeSet;

use super::{Deb, Relations};

/// `'https://…/libfoo1_1.2-3_amd64.deb' libfoo1_1%3a1.2-3_amd64.deb 12345 SHA256:…`
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
    stanza.lines().find_map(|line| {
        line.strip_prefix(name)?
            .strip_prefix(": ")
            .map(str::to_owned)
    })
}

/// A stanza's name, and what it says of others.
pub(super) fn parse_relations(stanza: &str) -> Option<(String, Relations)> {
    let names = |name: &str| -> BTreeSet<String> {
        let text = field(stanza, name).unwrap_or_default();
        let items = text.split([',', '|']);
        // `libfoo:any (>= 1.0)`
        let names =
            items.filter_map(|item| item.split([' ', ':', '(']).find(|name| !name.is_empty()));
        names.map(str::to_owned).collect()
    };
    let name = field(stanza, "Package")?;
    let source = field(stanza, "Source").unwrap_or_else(|| name.clone());
    let about = Relations {
        source: source.split(' ').next().unwrap_or_default().to_owned(),
        needs: names("Depends")
            .into_iter()
            .chain(names("Pre-Depends"))
            .collect(),
        before: names("Pre-Depends"),
        provides: names("Provides"),
    };
    Some((name, about))
}

/// Fields of a stanza that name a package.
pub(super) const NAMING: [&str; 3] = ["Package: ", "Version: ", "Architecture: "];

/// A stanza of `apt-cache dumpavail`.
pub(super) fn parse_stanza(stanza: &str) -> Option<Deb> {
    let field = |name: &str| field(stanza, name);
    Some(Deb {
        name: field("Package")?,
        version: field("Version")?,
        architecture: field("Architecture")?,
    })
}

/// The part of apt's refusal that says why: its errors, and the table of what does not fit together.
pub(super) fn apts_words(lines: &str) -> String {
    let mut table = false;
    let mut words = Vec::new();
    for line in lines.lines() {
        if line.starts_with("The following packages have unmet") {
            table = true;
        } else if !line.starts_with(' ') {
            table = false;
        }
        if table || line.starts_with("E:") {
            words.push(line.trim());
        }
    }
    if words.is_empty() {
        lines.to_owned()
    } else {
        words.join("; ")
    }
}
