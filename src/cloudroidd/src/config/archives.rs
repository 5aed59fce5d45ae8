//! Package archives of the bases, instead of this host's own apt sources.

use std::collections::BTreeMap;

use anyhow::bail;
use serde::Deserialize;

/// Lines of a sources.list (sources.list(5)), by base.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(transparent)]
pub struct ArchivesConfig(BTreeMap<String, Vec<String>>);

/// Options that would make apt accept packages that are unsigned or signed by a weak key.
const INSECURE_OPTIONS: [&str; 4] = ["trusted=", "allow-insecure=", "allow-weak=", "allow-downgrade-to-insecure="];

impl ArchivesConfig {
    pub fn check(&self) -> anyhow::Result<()> {
        for (base, lines) in &self.0 {
            if lines.is_empty() {
                bail!(
                    "{base} = [] names no archive; omit it to use this host's archives, or write lines of a \
                        sources.list"
                );
            }
            for line in lines {
                let whole = line.starts_with("deb ") && !line.contains(['\n', '\r']);
                if !whole {
                    bail!(
                        "{base} = [{line:?}] is not a line of a sources.list; write a line such as \"deb \
                            [signed-by=FILE] ADDRESS SUITE COMPONENT\""
                    );
                }
                if let Some(option) = INSECURE_OPTIONS.iter().find(|option| line.contains(*option)) {
                    bail!("{option} for {base} would accept unsigned packages; name the key ring with signed-by=FILE");
                }
            }
        }
        Ok(())
    }

    /// Returns the sources as the builder takes them.
    pub fn sources(&self) -> rootfs_builder::Sources {
        rootfs_builder::Sources(self.0.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> anyhow::Result<ArchivesConfig> {
        let archives: ArchivesConfig = toml::from_str(text)?;
        archives.check()?;
        Ok(archives)
    }

    #[test]
    fn archives_are_lines_of_a_sources_list_for_a_base() {
        let line = "deb [signed-by=/etc/k.gpg] http://mirror.example/ubuntu noble main";
        let archives = read(&format!("jazzy = [\"{line}\"]")).expect("valid");
        assert_eq!(archives.sources().0["jazzy"], [line]);
    }

    #[test]
    fn what_would_be_taken_without_a_signature_is_refused() {
        for (text, words) in [
            ("a = []", "omit it"),
            ("a = [\"http://mirror.example noble main\"]", "signed-by=FILE"),
            ("a = [\"deb http://x noble main\\ndeb [trusted=yes] http://y noble main\"]", "not a line"),
            ("a = [\"deb [arch=amd64 trusted=yes] http://mirror.example noble main\"]", "trusted="),
            ("a = [\"deb [allow-insecure=yes] http://mirror.example noble main\"]", "allow-insecure="),
        ] {
            let error = read(text).expect_err(text).to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}
