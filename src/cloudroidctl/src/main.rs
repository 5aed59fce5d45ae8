//! cloudroidctl

fn main() {}
