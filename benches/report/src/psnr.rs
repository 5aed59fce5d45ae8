//! Distortion caused by a lossy codec.

/// Peak signal-to-noise ratio of 8-bit samples.
#[derive(Default)]
pub struct Psnr {
    squares: f64,
    samples: f64,
}

impl Psnr {
    /// Adds decoded samples (`ours`) and the originals (`truth`).
    pub fn add(&mut self, ours: &[u8], truth: &[u8]) {
        let square = |(&a, &b): (&u8, &u8)| u64::from(a.abs_diff(b)).pow(2);
        self.squares += ours.iter().zip(truth).map(square).sum::<u64>() as f64;
        self.samples += truth.len() as f64;
    }

    /// Returns the ratio in dB.
    pub fn decibels(&self) -> f64 {
        10.0 * (255.0 * 255.0 * self.samples / self.squares.max(1e-9)).log10()
    }
}
