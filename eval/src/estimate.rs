//! Estimate of an evaluation's duration, printed at its beginning: for a machine with two cores and packages compiled
//! earlier. Stored results take no time.

/// Experiments that are measured together, and the seconds of a quick and of a full evaluation.
const SECONDS: [(&[u8], u32, u32); 9] = [
    (&[1], 55, 300),
    (&[2, 4, 5], 20, 540),
    (&[3], 60, 60),
    (&[6], 30, 300),
    (&[7], 10, 365),
    (&[8], 20, 420),
    (&[9], 20, 310),
    (&[10], 15, 110),
    (&[11], 0, 300),
];

/// Returns the seconds of these experiments, or of all if `only` is empty.
fn estimate_seconds(quick: bool, only: &[u8]) -> u32 {
    let wanted = SECONDS.iter().filter(|(numbers, _, _)| {
        only.is_empty() || numbers.iter().any(|number| only.contains(number))
    });
    wanted
        .map(|(_, few, all)| if quick { *few } else { *all })
        .sum()
}

/// Prints the estimate.
pub fn print_estimate(quick: bool, only: &[u8]) {
    eprintln!(
        "this takes about {} min on a machine of two cores, less what was measured before; packages that were never \
         compiled take some minutes more",
        estimate_seconds(quick, only).div_ceil(60)
    );
    eprintln!("min:s  run");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn experiments_that_are_measured_together_count_once() {
        assert_eq!(estimate_seconds(false, &[4, 5]), 540);
        assert_eq!(estimate_seconds(true, &[2, 3]), 80);
        assert!(estimate_seconds(false, &[]) < 75 * 60);
        assert!(estimate_seconds(true, &[1, 2, 4, 5, 7, 8, 10]) <= 2 * 60);
    }
}
