//! Max-min fair shares by water filling (Bertsekas and Gallager, Data Networks, 1992, section 6.5.2), above a floor for
//! each claimant.

/// A claim: minimum and usable maximum, in thousandths of a core.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Claim {
    /// Minimum share, as far as it is wanted.
    pub floor: u64,
    /// Maximum share.
    pub wants: u64,
}

impl Claim {
    /// Returns the share at this water level.
    fn share_at(self, level: u64) -> u64 {
        self.wants.min(self.floor.max(level))
    }
}

/// Returns the shares of `capacity`, in the order of the claims. No share exceeds what is wanted, and none is below the
/// floor or what is wanted, even if the floors exceed the capacity. The rest above the floors goes to those with the
/// smallest shares.
pub fn fill_shares(capacity: u64, claims: &[Claim]) -> Vec<u64> {
    let level = water_level(capacity, claims);
    claims.iter().map(|claim| claim.share_at(level)).collect()
}

/// Returns the greatest level at which the shares fit.
fn water_level(capacity: u64, claims: &[Claim]) -> u64 {
    let used = |level: u64| {
        let shares = claims.iter().map(|claim| claim.share_at(level));
        shares.fold(0u64, u64::saturating_add)
    };
    let (mut fits, mut over) = (0, claims.iter().map(|claim| claim.wants).max().unwrap_or(0));
    if used(over) <= capacity {
        return over;
    }
    while over - fits > 1 {
        let middle = fits + (over - fits) / 2;
        if used(middle) <= capacity { fits = middle } else { over = middle }
    }
    fits
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn claim((floor, wants): (u64, u64)) -> Claim {
        Claim { floor, wants }
    }

    #[test]
    fn what_is_left_goes_to_those_who_have_least() {
        for (capacity, claims, expected) in [
            (4000, vec![(0, 1000), (0, 1000)], vec![1000, 1000]),
            (3000, vec![(0, 500), (0, 4000), (0, 4000)], vec![500, 1250, 1250]),
            (3000, vec![(2000, 4000), (0, 4000)], vec![2000, 1000]),
            (3000, vec![(2000, 100), (0, 4000)], vec![100, 2900]),
            // Floors are kept even if they exceed the capacity.
            (1000, vec![(800, 4000), (700, 4000), (0, 9)], vec![800, 700, 0]),
            (1000, vec![], vec![]),
        ] {
            let all: Vec<_> = claims.iter().copied().map(claim).collect();
            assert_eq!(fill_shares(capacity, &all), expected, "{capacity} {claims:?}");
        }
    }

    proptest! {
        #[test]
        fn shares_are_max_min_fair(
            capacity in 0u64..20_000,
            claims in prop::collection::vec((0u64..5000, 0u64..9000).prop_map(claim), 0..12),
        ) {
            let shares = fill_shares(capacity, &claims);
            let floors: u64 = claims.iter().map(|claim| claim.floor.min(claim.wants)).sum();
            let sum: u64 = shares.iter().sum();
            prop_assert!(sum <= capacity.max(floors));
            for (claim, share) in claims.iter().zip(&shares) {
                prop_assert!(*share <= claim.wants && *share >= claim.floor.min(claim.wants));
            }
            // Whoever has less than it wants has at least as much as anyone above its floor, up to indivisible
            // remainders, and nothing is left over.
            for (claim, share) in claims.iter().zip(&shares).filter(|(claim, share)| claim.wants > **share) {
                prop_assert!(sum + claims.len() as u64 >= capacity, "{claim:?} lacks what is left");
                for (other, has) in claims.iter().zip(&shares) {
                    prop_assert!(has <= share || *has <= other.floor);
                }
            }
        }
    }
}
