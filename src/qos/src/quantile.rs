//! Exact quantiles of sorted values.

/// Returns the `percent`-th percentile of `sorted` (ascending) by nearest rank; `None` if it is empty.
pub fn nearest_rank<T: Copy>(sorted: &[T], percent: usize) -> Option<T> {
    let rank = (sorted.len() * percent).div_ceil(100).max(1);
    sorted.get(rank - 1).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_are_the_nearest_above() {
        let forty: Vec<u32> = (1..=40).collect();
        for (percent, is) in [(0, 1), (1, 1), (50, 20), (51, 21), (95, 38), (100, 40)] {
            assert_eq!(nearest_rank(&forty, percent), Some(is), "{percent}");
        }
        assert_eq!(nearest_rank(&[7], 95), Some(7));
        assert_eq!(nearest_rank::<u32>(&[], 50), None);
    }
}
