//! How long an evaluation takes, said at its beginning: of a machine of two cores, packages compiled before. What was measured before takes
//! no time.

/// Experiments that are measured together, and seconds of a quick evaluation and of a whole one.
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

/// Of these experiments, or of all where none is named; seconds.
fn seconds(quick: bool, only: &[u8]) -> u32 {
    let wanted = SECONDS.iter().filter(|(numbers, _, _)| {
        only.is_empty() || numbers.iter().any(|number| only.contains(number))
    });
    wanted
        .map(|(_, few, all)| if quick { *few } else { *all })
        .sum()
}

/// Says it.
pub fn tell(quick: bool, only: &[u8]) {
    eprintln!(
        "this takes about {} min on a machine of two cores, less what was measured before; packages that were never compiled take some minutes more",
        seconds(quick, only).div_ceil(60)
    );
    eprintln!("min:s  run");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn experiments_that_are_measured_together_count_once() {
        assert_eq!(seconds(false, &[4, 5]), 540);
        assert_eq!(seconds(true, &[2, 3]), 80);
        assert!(seconds(false, &[]) < 75 * 60);
        assert!(seconds(true, &[1, 2, 4, 5, 7, 8, 10]) <= 2 * 60);
    }
}
