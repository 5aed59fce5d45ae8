//! Likeness of names, for suggestions.

/// Shortest name that is compared; of shorter ones every other one is similar.
const SHORTEST: usize = 4;
/// Longest name that is compared, in bytes.
const LONGEST: usize = 64;

/// Returns the number of slips between two names: letters that are added, left out, replaced or swapped with a
/// neighbour. Signs do not count. `None` if there are more than one per four letters, at most two.
pub(crate) fn slips(one: &str, other: &str) -> Option<usize> {
    let letters = |name: &str| -> String {
        name.chars().filter(char::is_ascii_alphanumeric).map(|letter| letter.to_ascii_lowercase()).collect()
    };
    let (one, other) = (letters(one), letters(other));
    let shortest = one.len().min(other.len());
    let allowed = (shortest / 4).min(2);
    if shortest < SHORTEST || one.len().max(other.len()) > LONGEST || one.len().abs_diff(other.len()) > allowed {
        return None;
    }
    let found = strsim::osa_distance(&one, &other);
    (found <= allowed).then_some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slips_are_counted() {
        for (one, other, count) in [
            ("cv_bridge", "cv_bridge", Some(0)),
            ("cv-bridge", "cv_bridge", Some(0)),
            ("cv_brigde", "cv_bridge", Some(1)),
            ("cv_brdge", "cv_bridge", Some(1)),
            ("cv_bridgee", "cv_bridge", Some(1)),
            ("sensor_mgs", "sensor_msgs", Some(1)),
            ("sensr_mgs", "sensor_msgs", Some(2)),
            ("nav_msgs", "map_msgs", None),
            ("tf", "tf2", None),
            ("", "", None),
        ] {
            assert_eq!(slips(one, other), count, "{one} {other}");
        }
    }
}
