//! Rules for pairs of types whose names or fields differ.

/// Rules for pairs of types whose names or fields differ. The default is the built-in table.
#[derive(Debug, Clone, Default)]
pub struct TranslationRules {}

/// An error in a file of rules.
#[derive(Debug, thiserror::Error)]
#[error("{file}")]
pub struct RuleError {
    /// Name of the file.
    pub file: String,
}

impl TranslationRules {
    /// Adds rules in the YAML syntax of ros1_bridge. They win over the rules so far. `file` is named in errors.
    pub fn with_yaml(self, file: &str, yaml: &str) -> Result<TranslationRules, RuleError> {
        let _ = (file, yaml);
        todo!()
    }
}
