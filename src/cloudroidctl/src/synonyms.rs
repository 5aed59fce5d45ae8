//! Verbs as other command lines spell them: `get services`, `delete service NAME`.

use std::ffi::OsString;

/// Words of others, and the verbs that they mean.
const SYNONYMS: [(&[&str], &[&str], &str); 4] = [
    (&["get", "list", "ls", "describe"], &["services", "service"], "services"),
    (&["get", "list", "ls", "describe"], &["servants", "servant"], "servants"),
    (&["delete"], &["services", "service"], "rm"),
    (&["delete"], &["servants", "servant"], "stop"),
];

/// Replaces two words, such as `get services`, by the verb that they mean. Other words stay as they are.
pub fn to_own_words(mut words: Vec<OsString>) -> Vec<OsString> {
    let found = words.windows(2).enumerate().find_map(|(at, pair)| {
        let mut spellings = SYNONYMS.iter();
        let spelling = spellings.find(|(verbs, things, _)| is_one_of(&pair[0], verbs) && is_one_of(&pair[1], things));
        spelling.map(|(_, _, verb)| (at, *verb))
    });
    // Only options and their values may stand before a verb: in `push --name get services` these are no verb, nor are
    // they in `-q exec SERVANT -- get services`, where they are another program's.
    let is_option = |at: usize| words[at].as_encoded_bytes().starts_with(b"-") && words[at] != "--";
    let is_verb = |at: usize| (1..at).all(|before| is_option(before) || is_option(before - 1));
    if let Some((at, verb)) = found.filter(|(at, _)| is_verb(*at)) {
        words.splice(at..at + 2, [OsString::from(verb)]);
    }
    words
}

fn is_one_of(word: &OsString, known: &[&str]) -> bool {
    known.iter().any(|one| word == *one)
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;

    use super::*;

    #[test]
    fn two_words_become_one_verb() {
        for (line, expected) in [
            ("ctl get services", "ctl services"),
            ("ctl get service adder", "ctl services adder"),
            ("ctl -o json list servants", "ctl -o json servants"),
            ("ctl delete service adder --yes", "ctl rm adder --yes"),
            ("ctl delete servant adder-1", "ctl stop adder-1"),
            ("ctl get", "ctl get"),
            ("ctl push --name get services", "ctl push --name get services"),
            ("ctl --server s push --name get services", "ctl --server s push --name get services"),
            ("ctl -o json exec s-1 -- delete service x", "ctl -o json exec s-1 -- delete service x"),
            ("ctl", "ctl"),
        ] {
            let words = line.split(' ').map(OsString::from).collect();
            assert_eq!(to_own_words(words).join(OsStr::new(" ")), OsString::from(expected), "{line}");
        }
    }
}
