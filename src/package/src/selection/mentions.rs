//! Names of packages in the files of other packages: in build files, sources, launch files and configuration.

use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::Path;

use foreign::Visit;
use rustix::fs::FileType;

use crate::workspace::Package;

/// Maximum size of a file that is read, in bytes; larger ones are data.
const MAX_BYTES: u64 = 1 << 20;
/// Maximum number of files and bytes that are read of a workspace.
const MAX_FILES: usize = 50_000;
const MAX_TOTAL: u64 = 256 << 20;
/// Directories whose files are not used by a running node.
const EXCLUDED_DIRECTORIES: [&str; 6] = [".git", "doc", "docs", "test", "tests", "__pycache__"];
/// Files that mention packages without using them; of a package.xml the dependencies are known.
const PROSE: [&str; 3] = [".rst", ".md", "package.xml"];

/// Reader of files that looks for the names of packages.
pub(super) struct MentionReader<'a> {
    /// Names of packages and of their Python modules, with their indexes.
    names: BTreeMap<&'a [u8], usize>,
    files: usize,
    bytes: u64,
}

impl<'a> MentionReader<'a> {
    pub(super) fn new(packages: &'a [Package]) -> Self {
        let names = packages.iter().enumerate();
        let names = names.map(|(index, package)| (package.manifest.name.as_bytes(), index));
        let modules = packages.iter().enumerate();
        let modules =
            modules.flat_map(|(index, package)| package.modules.iter().map(move |name| (name.as_bytes(), index)));
        // A package's own name is not that of another one's module.
        let names = modules.chain(names).collect();
        Self { names, files: 0, bytes: 0 }
    }

    /// Returns the packages whose names are words of a text.
    pub(super) fn find_mentions(&self, text: &[u8]) -> BTreeSet<usize> {
        let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || *byte == b'_' || *byte == b'-';
        let mut found = BTreeSet::new();
        for word in text.split(|byte| !is_part(byte)).filter(|word| !word.is_empty()) {
            found.extend(self.names.get(word));
            // A hyphen may be part of a name, or stand beside one.
            if word.contains(&b'-') {
                found.extend(word.split(|byte| *byte == b'-').filter_map(|part| self.names.get(part)));
            }
        }
        found
    }

    /// Returns the packages that the files of a package mention; `None` if they cannot all be read.
    pub(super) fn read_package(&mut self, root: &Path, package: &Package) -> Option<BTreeSet<usize>> {
        let directory = root.join(&package.path).canonicalize().ok()?;
        let mut found = BTreeSet::new();
        let mut is_whole = true;
        let mut text = Vec::new();
        let walked = foreign::walk(&directory, |entry| {
            let name = entry.name().to_string_lossy();
            match entry.kind() {
                FileType::Directory if EXCLUDED_DIRECTORIES.contains(&&*name) => return Ok(Visit::Skip),
                FileType::RegularFile if entry.stat.st_size as u64 <= MAX_BYTES => {}
                _ => return Ok(Visit::Into),
            }
            if PROSE.iter().any(|end| name.ends_with(end)) {
                return Ok(Visit::Into);
            }
            self.files += 1;
            self.bytes += entry.stat.st_size as u64;
            is_whole &= self.files <= MAX_FILES && self.bytes <= MAX_TOTAL;
            if is_whole {
                text.clear();
                is_whole &= entry.open()?.take(MAX_BYTES).read_to_end(&mut text).is_ok();
                found.extend(self.find_mentions(&text));
            }
            Ok::<_, foreign::Error>(Visit::Into)
        });
        (walked.is_ok() && is_whole).then_some(found)
    }
}
