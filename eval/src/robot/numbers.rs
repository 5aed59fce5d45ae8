//! Numbers of requests, which are their stamps.

/// Stamps of measured requests are greater than this number.
pub const FIRST: u32 = 1000;
/// Warm-up requests, which are not counted: after them everything is connected and running.
pub const WARM_UP: usize = 3;
