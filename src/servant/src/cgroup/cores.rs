//! Sets of cores in the kernel's notation: `0-2,5`.

/// Formats the set.
pub(super) fn format_cpuset(cores: &[u64; 4]) -> String {
    let has = |core: usize| cores[core / 64] >> (core % 64) & 1 == 1;
    let named: Vec<String> = (0..256)
        .filter(|core| has(*core))
        .map(|core| core.to_string())
        .collect();
    named.join(",")
}

/// Parses a list; `None` if it is malformed, or empty, which means all cores.
pub(super) fn parse_cpuset(text: &str) -> Option<[u64; 4]> {
    let mut cores = [0; 4];
    for part in text.trim().split(',') {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        for core in first.parse::<usize>().ok()?..=last.parse().ok()? {
            *cores.get_mut(core / 64)? |= 1 << (core % 64);
        }
    }
    Some(cores)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_read_and_written() {
        assert_eq!(parse_cpuset("0-2,65\n"), Some([7, 2, 0, 0]));
        assert_eq!(format_cpuset(&[7, 2, 0, 0]), "0,1,2,65");
        for nothing in ["", "a", "1-", "256"] {
            assert_eq!(parse_cpuset(nothing), None, "{nothing}");
        }
    }
}
