//! Predictions of a sample from its neighbours, and their residuals.

use crate::Error;

/// The predictors; the letters are those of [`crate::padded`].
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
#[repr(u8)]
pub(crate) enum Kind {
    /// Always zero: the samples are differences already.
    Zero = 0,
    /// The left neighbour, a.
    West = 1,
    /// The upper neighbour, b.
    North = 2,
    /// The mean of a and b, corrected by a quarter of the slope above.
    Slope = 3,
    /// a + b - c: exact on planes.
    Plane = 4,
    /// The median of a, b and a + b - c (Martucci's median edge detector).
    Median = 5,
    /// The median of a, b, a + b - c, a + d - b and `Slope`.
    Middle = 6,
    /// 2a - b: a straight line through a sequence.
    Line = 7,
}

impl Kind {
    pub(crate) const ALL: [Self; 8] =
        [Self::Zero, Self::West, Self::North, Self::Slope, Self::Plane, Self::Median, Self::Middle, Self::Line];

    pub(crate) fn read(byte: u8) -> Result<Self, Error> {
        Self::ALL.get(usize::from(byte)).copied().ok_or(Error::Corrupt("an unknown predictor"))
    }
}

/// A predictor known at compile time, so that inner loops hold no branch.
pub(crate) trait Predictor {
    const KIND: Kind;
}

macro_rules! predictors {
    ($($name:ident),*) => {$(
        pub(crate) struct $name;
        impl Predictor for $name {
            const KIND: Kind = Kind::$name;
        }
    )*};
}
predictors!(Zero, West, North, Slope, Plane, Median, Middle, Line);

/// Calls a function that is generic over a [`Predictor`] with the one that `$kind` names.
macro_rules! with_predictor {
    ($kind:expr, $function:ident $(::<$($extra:ty),+>)? ($($argument:expr),* $(,)?)) => {
        match $kind {
            $crate::predict::Kind::Zero => $function::<$crate::predict::Zero $(, $($extra),+)?>($($argument),*),
            $crate::predict::Kind::West => $function::<$crate::predict::West $(, $($extra),+)?>($($argument),*),
            $crate::predict::Kind::North => $function::<$crate::predict::North $(, $($extra),+)?>($($argument),*),
            $crate::predict::Kind::Slope => $function::<$crate::predict::Slope $(, $($extra),+)?>($($argument),*),
            $crate::predict::Kind::Plane => $function::<$crate::predict::Plane $(, $($extra),+)?>($($argument),*),
            $crate::predict::Kind::Median => $function::<$crate::predict::Median $(, $($extra),+)?>($($argument),*),
            $crate::predict::Kind::Middle => $function::<$crate::predict::Middle $(, $($extra),+)?>($($argument),*),
            $crate::predict::Kind::Line => $function::<$crate::predict::Line $(, $($extra),+)?>($($argument),*),
        }
    };
}
pub(crate) use with_predictor;

/// A sample of 16 or 32 bits.
pub(crate) trait PlaneSample: Copy + Default + Eq {
    /// Returns the zigzag code of the sample minus its prediction.
    fn residual<P: Predictor>(self, a: Self, b: Self, c: Self, d: Self) -> u32;
    /// Returns the sample whose [`PlaneSample::residual`] is `residual`.
    fn restore<P: Predictor>(residual: u32, a: Self, b: Self, c: Self, d: Self) -> Self;
    /// Returns the part of the activity that does not depend on a.
    fn ease<P: Predictor>(b: Self, c: Self, d: Self) -> u32;
    /// Returns the activity ("unease") of the neighbourhood: the sum of differences between neighbours.
    fn unease<P: Predictor>(ease: u32, a: Self, c: Self) -> u32;
    /// Returns the context of an activity, below [`EASE`].
    fn context(unease: u32) -> u16;
    /// Returns [`PlaneSample::context`], in arithmetic that the vectoriser can use.
    fn branchless_context(unease: u32) -> u16;
    /// Mask of the bits that residuals can have.
    const RESIDUAL: u32;
    fn widen(self) -> u32;
}

#[inline(always)]
fn median_of_five(v: [i32; 5]) -> i32 {
    // Drop the smallest and the largest of two pairs; the median of five is the median of the three left.
    let [a, b, c, d, e] = v;
    let (low_ab, high_ab) = (a.min(b), a.max(b));
    let (low_cd, high_cd) = (c.min(d), c.max(d));
    let low = low_ab.max(low_cd);
    let high = high_ab.min(high_cd);
    let (low, high) = (low.min(high), low.max(high));
    e.clamp(low, high)
}

/// Returns the prediction in 32-bit arithmetic, for samples that leave room in it.
#[inline(always)]
pub(crate) fn guess<P: Predictor>(a: i32, b: i32, c: i32, d: i32) -> i32 {
    match P::KIND {
        Kind::Zero => 0,
        Kind::West => a,
        Kind::North => b,
        Kind::Slope => ((a + b) >> 1) + ((d - c) >> 2),
        Kind::Plane => a + b - c,
        Kind::Median => (a + b - c).clamp(a.min(b), a.max(b)),
        Kind::Middle => median_of_five([a, b, a + b - c, a + d - b, ((a + b) >> 1) + ((d - c) >> 2)]),
        Kind::Line => 2 * a - b,
    }
}

#[inline(always)]
pub(crate) fn zigzag(value: i32) -> u32 {
    ((value << 1) ^ (value >> 31)) as u32
}

#[inline(always)]
pub(crate) fn unzigzag(value: u32) -> i32 {
    (value >> 1) as i32 ^ -((value & 1) as i32)
}

/// The first context that does not stand for activity.
pub(crate) const EASE: u16 = 29;

/// Returns the context of an activity, with two contexts per octave.
const fn half_octave(unease: u32) -> u8 {
    if unease < 4 {
        return unease as u8;
    }
    let octave = unease.ilog2();
    let context = 2 * octave + ((unease >> (octave - 1)) & 1);
    if context < EASE as u32 { context as u8 } else { EASE as u8 - 1 }
}

/// Returns the binary logarithm of a number, times 2^`fraction`, rounded down; any value for zero. The first bits of a
/// float are one, without a branch.
#[inline(always)]
pub(crate) fn scaled_log(value: u32, fraction: u32) -> u32 {
    // Of two bits four apart one is cleared, so that rounding does not carry into the significant bits (three at most).
    let value = value & !(value >> 4);
    ((value as f32).to_bits() >> (23 - fraction)).wrapping_sub(127 << fraction)
}

/// Lookup table of [`half_octave`] for small numbers.
const HALF_OCTAVES: [u8; 1024] = {
    let mut contexts = [0; 1024];
    let mut unease = 0;
    while unease < contexts.len() {
        contexts[unease] = half_octave(unease as u32);
        unease += 1;
    }
    contexts
};

impl PlaneSample for u16 {
    #[inline(always)]
    fn residual<P: Predictor>(self, a: Self, b: Self, c: Self, d: Self) -> u32 {
        zigzag(i32::from(self) - guess::<P>(a.into(), b.into(), c.into(), d.into()))
    }

    #[inline(always)]
    fn restore<P: Predictor>(residual: u32, a: Self, b: Self, c: Self, d: Self) -> Self {
        guess::<P>(a.into(), b.into(), c.into(), d.into()).wrapping_add(unzigzag(residual)) as u16
    }

    #[inline(always)]
    fn ease<P: Predictor>(b: Self, c: Self, d: Self) -> u32 {
        if matches!(P::KIND, Kind::Zero) {
            return b.into();
        }
        u32::from(c.abs_diff(b)) + u32::from(b.abs_diff(d))
    }

    #[inline(always)]
    fn unease<P: Predictor>(ease: u32, a: Self, c: Self) -> u32 {
        let left = if matches!(P::KIND, Kind::Zero) { a } else { a.abs_diff(c) };
        ease + u32::from(left)
    }

    #[inline(always)]
    fn context(unease: u32) -> u16 {
        match HALF_OCTAVES.get(unease as usize) {
            Some(&context) => context.into(),
            None => half_octave(unease).into(),
        }
    }

    #[inline(always)]
    fn branchless_context(unease: u32) -> u16 {
        let unease = unease.min(1 << (EASE / 2));
        let context = if unease < 2 { unease } else { scaled_log(unease, 1) };
        context as u16
    }

    const RESIDUAL: u32 = (1 << 19) - 1;

    #[inline(always)]
    fn widen(self) -> u32 {
        self.into()
    }
}

impl PlaneSample for u32 {
    #[inline(always)]
    fn residual<P: Predictor>(self, a: Self, b: Self, c: Self, d: Self) -> u32 {
        zigzag(self.wrapping_sub(wide_guess::<P>(a, b, c, d)) as i32)
    }

    #[inline(always)]
    fn restore<P: Predictor>(residual: u32, a: Self, b: Self, c: Self, d: Self) -> Self {
        wide_guess::<P>(a, b, c, d).wrapping_add(unzigzag(residual) as u32)
    }

    #[inline(always)]
    fn ease<P: Predictor>(b: Self, c: Self, d: Self) -> u32 {
        if matches!(P::KIND, Kind::Zero) { b } else { c.abs_diff(b).saturating_add(b.abs_diff(d)) }
    }

    #[inline(always)]
    fn unease<P: Predictor>(ease: u32, a: Self, c: Self) -> u32 {
        ease.saturating_add(if matches!(P::KIND, Kind::Zero) { a } else { a.abs_diff(c) })
    }

    #[inline(always)]
    fn context(unease: u32) -> u16 {
        ((32 - unease.leading_zeros()) as u16).min(EASE - 1)
    }

    #[inline(always)]
    fn branchless_context(unease: u32) -> u16 {
        let context = if unease == 0 { 0 } else { scaled_log(unease, 0) + 1 };
        (context as u16).min(EASE - 1)
    }

    const RESIDUAL: u32 = u32::MAX;

    #[inline(always)]
    fn widen(self) -> u32 {
        self
    }
}

/// Returns the prediction modulo 2^32.
#[inline(always)]
fn wide_guess<P: Predictor>(a: u32, b: u32, c: u32, d: u32) -> u32 {
    let mean = || (a & b).wrapping_add((a ^ b) >> 1);
    let quarter = || ((d.wrapping_sub(c) as i32) >> 2) as u32;
    match P::KIND {
        Kind::Zero => 0,
        Kind::West => a,
        Kind::North => b,
        Kind::Slope => mean().wrapping_add(quarter()),
        Kind::Plane => a.wrapping_add(b).wrapping_sub(c),
        Kind::Median | Kind::Middle => {
            let (low, high) = (a.min(b), a.max(b));
            if c >= high {
                low
            } else if c <= low {
                high
            } else {
                a.wrapping_add(b).wrapping_sub(c)
            }
        }
        Kind::Line => a.wrapping_mul(2).wrapping_sub(b),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn there_and_back<P: Predictor>() {
        let samples = [0u32, 1, 5, 200, 65_535, 65_536, 1 << 31, u32::MAX];
        for &v in &samples {
            for &a in &samples {
                for &b in &samples {
                    for &c in &samples {
                        let d = a ^ b;
                        assert_eq!(u32::restore::<P>(v.residual::<P>(a, b, c, d), a, b, c, d), v);
                        let [v, a, b, c, d] = [v, a, b, c, d].map(|sample| sample as u16);
                        assert_eq!(u16::restore::<P>(v.residual::<P>(a, b, c, d), a, b, c, d), v);
                        let unease = u16::unease::<P>(u16::ease::<P>(b, c, d), a, c);
                        assert!(u16::context(unease) < EASE && u32::context(u32::MAX - unease) < EASE);
                    }
                }
            }
        }
    }

    #[test]
    fn every_residual_restores_its_sample() {
        for kind in Kind::ALL {
            assert_eq!(Kind::read(kind as u8).unwrap(), kind);
            with_predictor!(kind, there_and_back());
        }
        assert!(Kind::read(8).is_err());
    }

    #[test]
    fn contexts_of_many_are_as_those_of_one() {
        let edges = (2..32).flat_map(|bit| [(1u32 << bit) - 1, 1 << bit, 3 << (bit - 1)]);
        for unease in (0..300_000).chain(edges).chain([u32::MAX]) {
            assert_eq!(u16::branchless_context(unease), u16::context(unease), "{unease}");
            assert_eq!(u32::branchless_context(unease), u32::context(unease), "{unease}");
        }
    }

    #[test]
    fn the_middle_of_five_is_the_median() {
        for permutation in 0..120 {
            let mut left: Vec<i32> = (1..=5).collect();
            let mut code = permutation;
            let drawn: [i32; 5] = std::array::from_fn(|index| {
                let choice = code % (5 - index);
                code /= 5 - index;
                left.remove(choice)
            });
            assert_eq!(median_of_five(drawn), 3);
        }
    }
}
