//! The built-in table.

use std::sync::LazyLock;

use super::TranslationRules;

/// The built-in table, read from `table.yaml`.
pub(super) static BUILT_IN: LazyLock<TranslationRules> = LazyLock::new(|| {
    // A unit test reads it.
    let table = TranslationRules::empty().with_yaml("the built-in table", include_str!("table.yaml"));
    table.unwrap_or_else(|error| unreachable!("{error}"))
});
