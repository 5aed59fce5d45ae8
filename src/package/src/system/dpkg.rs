//! Packages of the distribution, as dpkg lists them (`/var/lib/dpkg/status`, deb822(5)).

use std::collections::BTreeMap;

use super::SystemError;

/// Maximum number of installed packages; an image with everything for ROS has 3,000.
const MOST_PACKAGES: usize = 20_000;
/// Maximum length of a name or a version in bytes.
const LONGEST_WORD: usize = 256;

/// An installed package.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InstalledPackage {
    /// Name, without architecture.
    pub name: String,
    /// Version as in the archive.
    pub version: String,
    /// Architecture, such as `amd64` or `all`.
    pub architecture: String,
}

/// Returns the installed packages of a status file.
pub fn parse_status(text: &str) -> impl Iterator<Item = InstalledPackage> {
    text.split("\n\n").filter_map(parse_installed)
}

fn parse_installed(text: &str) -> Option<InstalledPackage> {
    let field = |name: &str| text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(": "));
    (field("Status")? == "install ok installed").then_some(())?;
    Some(InstalledPackage {
        name: field("Package")?.to_owned(),
        version: field("Version")?.to_owned(),
        architecture: field("Architecture")?.to_owned(),
    })
}

/// Returns the names and versions in a status file of an untrusted system. What dpkg would not accept as a name or a
/// version is left out.
///
/// # Errors
/// [`SystemError::TooManyPackages`].
pub(super) fn list_installed(text: &str) -> Result<BTreeMap<String, String>, SystemError> {
    let mut all = BTreeMap::new();
    for InstalledPackage { name, version, .. } in parse_status(text).filter(|one| is_name(&one.name)) {
        if is_version(&version) {
            all.insert(name, version);
        }
        if all.len() > MOST_PACKAGES {
            return Err(SystemError::TooManyPackages(MOST_PACKAGES));
        }
    }
    Ok(all)
}

/// Returns whether a text is the name of a package (Debian Policy, section 5.6.7).
fn is_name(text: &str) -> bool {
    is_word(text, |b| b.is_ascii_lowercase() || b.is_ascii_digit() || b"+-.".contains(&b))
}

/// Returns whether a text is a version (Debian Policy, section 5.6.12).
fn is_version(text: &str) -> bool {
    is_word(text, |b| b.is_ascii_alphanumeric() || b".+-:~".contains(&b))
}

fn is_word(text: &str, is_allowed: impl Fn(u8) -> bool) -> bool {
    (1..=LONGEST_WORD).contains(&text.len()) && text.bytes().all(is_allowed)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(name: &str, version: &str) -> String {
        format!(
            "Package: {name}\nStatus: install ok installed\nVersion: {version}\nArchitecture: all\nDescription: x\n\n"
        )
    }

    #[test]
    fn names_and_versions_alone_are_kept() {
        let long = "x".repeat(LONGEST_WORD + 1);
        let gone = "Package: gone\nStatus: deinstall ok config-files\nVersion: 1\nArchitecture: all\n\n";
        let text = [
            &entry("libc6", "2.36-9+deb12u4"),
            gone,
            &entry("g++", "4:12.2.0-3"),
            &entry("Not A Name", "1"),
            &entry(&long, "1"),
            &entry("odd", "1 2"),
            &entry("odder", &long),
        ];
        let found = list_installed(&text.concat()).expect("few");
        let found: Vec<_> = found.iter().map(|(name, version)| format!("{name} {version}")).collect();
        assert_eq!(found, ["g++ 4:12.2.0-3", "libc6 2.36-9+deb12u4"]);
        assert!(list_installed("").expect("none").is_empty());
    }

    #[test]
    fn a_list_that_no_system_has_is_refused() {
        let text: String = (0..=MOST_PACKAGES).map(|number| entry(&format!("p{number}"), "1")).collect();
        let refused = list_installed(&text).expect_err("too many").to_string();
        assert!(refused.contains("more than 20000 packages"), "{refused}");
    }
}
