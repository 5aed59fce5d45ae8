//! Likeness of names, for suggestions.

/// Shortest name that is compared; of shorter ones every other one is similar.
const SHORTEST: usize = 4;
/// Longest name that is compared, in bytes.
const LONGEST: usize = 64;

/// Returns the number of slips between two names: letters that are added, left out, replaced or swapped with a
/// neighbour. Signs do not count. `None` if there are more than one per four letters, at most two.
pub(crate) fn slips(one: &str, other: &str) -> Option<usize> {
    let letters = |name: &str| -> Vec<u8> {
        name.bytes().filter(u8::is_ascii_alphanumeric).map(|byte| byte.to_ascii_lowercase()).collect()
    };
    let (one, other) = (letters(one), letters(other));
    let shortest = one.len().min(other.len());
    let allowed = (shortest / 4).min(2);
    if shortest < SHORTEST || one.len().max(other.len()) > LONGEST || one.len().abs_diff(other.len()) > allowed {
        return None;
    }
    let found = distance(&one, &other);
    (found <= allowed).then_some(found)
}

/// Optimal string alignment distance, row by row.
fn distance(one: &[u8], other: &[u8]) -> usize {
    let mut before: Vec<usize> = Vec::new();
    let mut above: Vec<usize> = (0..=other.len()).collect();
    for (row, a) in one.iter().enumerate() {
        let mut current = vec![row + 1];
        for (column, b) in other.iter().enumerate() {
            let replaced = above[column] + usize::from(a != b);
            let mut least = replaced.min(above[column + 1] + 1).min(current[column] + 1);
            if row > 0 && column > 0 && *a == other[column - 1] && one[row - 1] == *b {
                least = least.min(before[column - 1] + 1);
            }
            current.push(least);
        }
        before = std::mem::replace(&mut above, current);
    }
    above.last().copied().unwrap_or_default()
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
