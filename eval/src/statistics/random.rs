//! A deterministic pseudorandom generator.

/// The generator xorshift64* of Vigna, "An experimental exploration of Marsaglia's xorshift generators, scrambled", ACM
/// Transactions on Mathematical Software 42 (2016).
#[derive(Debug, Clone)]
pub struct Xorshift(u64);

impl Xorshift {
    /// Creates a generator; each seed gives another sequence.
    pub fn new(seed: u64) -> Self {
        // The state must not be zero, and adjacent seeds must not have adjacent states.
        Self((seed + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1)
    }

    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    /// Returns a number below `limit`; the bias is negligible for small limits.
    pub fn index_below(&mut self, limit: usize) -> usize {
        ((u128::from(self.next()) * limit as u128) >> 64) as usize
    }

    /// Returns an exponentially distributed number with this mean, such as a pause between requests.
    pub fn exponential(&mut self, mean: f64) -> f64 {
        // More than 0 and at most 1, in steps that 64 bits can distinguish.
        let share = ((self.next() >> 11) + 1) as f64 / (1u64 << 53) as f64;
        -mean * share.ln()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An exponential distribution has equal mean and standard deviation, and a fraction of 1/e of it lies above them.
    #[test]
    fn pauses_are_exponential() {
        let mut random = Xorshift::new(7);
        let values: Vec<f64> = (0..20_000).map(|_| random.exponential(0.2)).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let above = values.iter().filter(|value| **value > 0.2).count() as f64;
        assert!((mean - 0.2).abs() < 0.006, "{mean}");
        assert!(
            (above / 20_000.0 - (-1.0f64).exp()).abs() < 0.015,
            "{above}"
        );
        assert!(values.iter().all(|value| *value >= 0.0));
    }

    #[test]
    fn seeds_make_other_sequences() {
        let first = |seed| Xorshift::new(seed).next();
        assert_eq!(first(1), first(1));
        assert_ne!(first(1), first(2));
    }
}
