//! cloudroidd

fn main() {}
