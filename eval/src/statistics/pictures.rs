//! Errors of images.

/// Peak signal-to-noise ratio of two images of 8-bit samples in dB: 10 lg(255² / mean squared error) (ITU-T J.340).
/// Infinite for equal images; NaN for images of different sizes, or without samples.
pub fn psnr(a: &[u8], b: &[u8]) -> f64 {
    if a.len() != b.len() || a.is_empty() {
        return f64::NAN;
    }
    let squares: u64 = a
        .iter()
        .zip(b)
        .map(|(one, other)| u64::from(one.abs_diff(*other)).pow(2))
        .sum();
    let error = squares as f64 / a.len() as f64;
    10.0 * (255.0 * 255.0 / error).log10()
}

#[cfg(test)]
mod tests {
    use super::super::assert_near;
    use super::*;

    #[test]
    fn noise_is_in_decibels() {
        // Mean squared error (1 + 9) / 2 = 5: 10 lg(65025 / 5) = 41.1411 dB.
        assert!((psnr(&[10, 20], &[11, 17]) - 41.1411).abs() < 1e-3);
        assert_near(psnr(&[0, 0], &[255, 255]), 0.0);
        assert_eq!(psnr(&[1, 2], &[1, 2]), f64::INFINITY);
        assert!(psnr(&[1], &[1, 2]).is_nan() && psnr(&[], &[]).is_nan());
    }
}
