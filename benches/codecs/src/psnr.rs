//! How much a lossy codec has changed.

/// Signal to noise of samples of eight bits.
#[derive(Default)]
pub struct Psnr {
    squares: f64,
    samples: f64,
}

impl Psnr {
    /// Takes in decoded samples and what they were.
    pub fn add(&mut self, ours: &[u8], truth: &[u8]) {
        let square = |(&a, &b): (&u8, &u8)| u64::from(a.abs_diff(b)).pow(2);
        self.squares += ours.iter().zip(truth).map(square).sum::<u64>() as f64;
        self.samples += truth.len() as f64;
    }

    /// In dB.
    pub fn decibels(&self) -> f64 {
        10.0 * (255.0 * 255.0 * self.samples / self.squares.max(1e-9)).log10()
    }
}
