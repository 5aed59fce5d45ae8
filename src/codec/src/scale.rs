//! Floats that are scaled integers: drivers divide or multiply the sensor's counts.

use crate::Error;

/// The way a float was computed from an integer.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Scale {
    name: u8,
    /// The float is `multiple / divisor`, unless `factor` is not zero.
    divisor: f32,
    /// If not zero, the float is `multiple · factor`.
    factor: f32,
}

/// Scales from coarse to fine, so that the first one that fits gives the smallest numbers. The position is the name on
/// the wire: append only.
const SCALES: [(f32, f32); 26] = [
    (1.0, 0.0),
    (2.0, 0.0),
    (4.0, 0.0),
    (10.0, 0.0),
    (10.0, 0.1),
    (16.0, 0.0),
    (64.0, 0.0),
    (100.0, 0.0),
    (100.0, 0.01),
    (128.0, 0.0),
    (200.0, 0.005),
    (250.0, 0.004),
    (256.0, 0.0),
    (500.0, 0.002),
    (500.0, 0.0),
    (1000.0, 0.0),
    (1000.0, 0.001),
    (1024.0, 0.0),
    (2000.0, 0.0005),
    (4000.0, 0.0),
    (4000.0, 0.00025),
    (5000.0, 0.0),
    (5000.0, 0.0002),
    (10_000.0, 0.0),
    (10_000.0, 0.0001),
    (65_536.0, 0.0),
];

impl Scale {
    /// Value for floats that are no multiple.
    pub(crate) const NONE: i32 = i32::MIN;
    /// Beyond this the product below is no longer accurate to half a multiple.
    const LARGEST: f32 = 4_000_000.0;
    /// Adding this rounds to an integer: the mantissa has no room for fractions.
    const ROUND: f32 = 12_582_912.0;

    pub(crate) fn from_name(name: u8) -> Result<Self, Error> {
        let &(divisor, factor) = SCALES.get(usize::from(name)).ok_or(Error::Corrupt("an unknown scale"))?;
        Ok(Self { name, divisor, factor })
    }

    pub(crate) fn name(self) -> u8 {
        self.name
    }

    /// Returns the float of a multiple, as bits.
    #[inline]
    pub(crate) fn value(self, multiple: i32) -> u32 {
        let multiple = multiple as f32;
        let value = if self.factor == 0.0 { multiple / self.divisor } else { multiple * self.factor };
        value.to_bits()
    }

    /// Returns the multiple whose float has exactly these bits, or [`Scale::NONE`]. Without a branch, for the
    /// vectoriser.
    #[inline(always)]
    pub(crate) fn multiple(self, bits: u32) -> i32 {
        let scaled = f32::from_bits(bits) * self.divisor;
        // NaN fails the comparison, too.
        let near = scaled.abs() <= Self::LARGEST;
        // The sum's last bits are the integer; a conversion would check for values that it cannot convert.
        let multiple = (scaled + Self::ROUND).to_bits().wrapping_sub(Self::ROUND.to_bits()) as i32;
        if near & (self.value(multiple) == bits) { multiple } else { Self::NONE }
    }

    /// Returns [`Scale::multiple`] of each.
    pub(crate) fn multiples(self, bits: &[u32]) -> Vec<i32> {
        let mut multiples = vec![0; bits.len()];
        // Whether to divide or multiply is decided once.
        if self.factor == 0.0 {
            let scale = Self { factor: 0.0, ..self };
            multiples.iter_mut().zip(bits).for_each(|(multiple, &bits)| *multiple = scale.multiple(bits));
        } else {
            multiples.iter_mut().zip(bits).for_each(|(multiple, &bits)| *multiple = self.multiple(bits));
        }
        multiples
    }

    /// Returns the coarsest scale of which nearly all measured floats are multiples.
    pub(crate) fn find(bits: &[u32]) -> Option<Self> {
        // A few are enough: a chance multiple of a coarse scale is one in thousands. The step is odd, so that not all
        // of a pattern's even values are taken.
        let step = (bits.len() / 96) | 1;
        let sample: Vec<u32> = bits
            .iter()
            .step_by(step)
            .copied()
            .filter(|&bits| f32::from_bits(bits).is_finite() && bits << 1 != 0)
            .take(64)
            .collect();
        let misses = sample.len() / 16;
        let fits = |scale: &Self| {
            let unfit = sample.iter().filter(|&&bits| scale.multiple(bits) == Self::NONE);
            unfit.take(misses + 1).count() <= misses
        };
        (0..SCALES.len() as u8).filter_map(|name| Self::from_name(name).ok()).find(fits).filter(|_| !sample.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn multiples_are_found_and_restored() {
        for name in 0..SCALES.len() as u8 {
            let scale = Scale::from_name(name).unwrap();
            for multiple in [-70_000, -1, 1, 2, 3, 1001, 65_537, 1_000_003] {
                assert_eq!(scale.multiple(scale.value(multiple)), multiple, "{scale:?}");
            }
        }
        assert!(Scale::from_name(200).is_err());
    }

    #[test]
    fn the_usual_drivers_are_recognised() {
        let find = |value: fn(u32) -> f32| {
            let bits: Vec<u32> = (500..1500).map(|count| value(count).to_bits()).collect();
            Scale::find(&bits).map(|scale| (scale.divisor, scale.factor))
        };
        assert_eq!(find(|count| count as f32 * 0.001), Some((1000.0, 0.001)));
        assert_eq!(find(|count| count as f32 / 1000.0), Some((1000.0, 0.0)));
        assert_eq!(find(|count| count as f32), Some((1.0, 0.0)));
        assert_eq!(find(|count| count as f32 / 4.0 / 1000.0), Some((4000.0, 0.0)));
        assert_eq!(find(|count| (count as f32).sqrt() / 77.0), None);
        assert_eq!(find(|_| f32::NAN), None);
    }

    #[test]
    fn what_is_no_number_is_no_multiple() {
        let scale = Scale::from_name(0).unwrap();
        for value in [f32::NAN, f32::INFINITY, 0.5, 1e9, -0.0] {
            assert_eq!(scale.multiple(value.to_bits()), Scale::NONE, "{value}");
        }
    }
}
