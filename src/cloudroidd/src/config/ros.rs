//! `[ros]`: robots of another ROS than their service.

use std::path::PathBuf;

use serde::Deserialize;
use translation::{RuleError, TranslationRules};

/// Robots of another ROS than their service.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RosConfig {
    /// Files of rules for types whose names or fields differ between the two ROSes, in the syntax of ros1_bridge. Rules
    /// of later files win over those of earlier ones, and all of them over the built-in ones.
    pub translation_rules: Vec<PathBuf>,
}

impl RosConfig {
    /// Reads the built-in rules and those of the files.
    ///
    /// # Errors
    /// The first file that cannot be used, and its rule or line.
    pub fn read_rules(&self) -> Result<TranslationRules, RuleError> {
        let mut files = self.translation_rules.iter();
        files.try_fold(TranslationRules::default(), |rules, path| rules.with_file(path))
    }
}

#[cfg(test)]
mod tests {
    use super::super::Config;

    const GOOD: &str = "- {ros1_package_name: old_msgs, ros2_package_name: new_msgs}\n";

    /// Returns the error for a configuration with these files of rules.
    fn refuse(files: &[(&str, &str)], more: &str) -> Option<String> {
        let place = tempfile::tempdir().expect("a directory");
        for (name, text) in files {
            std::fs::write(place.path().join(name), text).expect("written");
        }
        let names = files.iter().map(|(name, _)| *name).chain((!more.is_empty()).then_some(more));
        let paths: Vec<String> = names.map(|name| format!("{:?}", place.path().join(name))).collect();
        let config = format!("[ros]\ntranslation_rules = [{}]\n", paths.join(", "));
        Config::parse(&config).expect("well-formed").check().err().map(|error| format!("{error:#}"))
    }

    #[test]
    fn rules_that_can_be_used_are_accepted() {
        assert_eq!(refuse(&[("a.yaml", GOOD), ("b.yaml", "")], ""), None);
    }

    #[test]
    fn what_is_no_rule_is_named_with_its_file() {
        let unfinished = format!("{GOOD}- {{ros1_package_name: old_msgs}}\n");
        for (files, more, words) in [
            (&[("a.yaml", GOOD), ("b.yaml", &*unfinished)][..], "", "b.yaml, rule 2 lacks ros2_package_name"),
            (&[("a.yaml", "- ros1_package_name: a\n  ros2_pakage: b\n")], "", "at line 2 column 3"),
            (&[("a.yaml", GOOD)], "nowhere.yaml", "cannot read the rules in"),
        ] {
            let error = refuse(files, more).expect("an error");
            assert!(error.starts_with("[ros] of the configuration: ") && error.contains(words), "{error}");
            assert!(error.contains(if more.is_empty() { ".yaml" } else { more }), "{error}");
        }
    }
}
