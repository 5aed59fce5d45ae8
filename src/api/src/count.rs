//! Numbers of things in words.

/// Returns a number with its noun, such as `1 servant` or `2 servants`.
pub fn count(number: impl TryInto<u64>, noun: &str) -> String {
    // A number beyond 64 bits is many as well.
    let number = number.try_into().unwrap_or(u64::MAX);
    // A day has days, an entry has entries.
    let stem = noun.strip_suffix('y').filter(|stem| !stem.ends_with(['a', 'e', 'o', 'u']));
    match (number, stem) {
        (1, _) => format!("1 {noun}"),
        (_, Some(stem)) => format!("{number} {stem}ies"),
        (_, None) => format!("{number} {noun}s"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_is_no_plural() {
        let counts = [count(1u32, "servant"), count(0usize, "servant"), count(2u64, "entry"), count(2u64, "day")];
        assert_eq!(counts, ["1 servant", "0 servants", "2 entries", "2 days"]);
        assert_eq!(count(1u64, "entry"), "1 entry");
    }
}
