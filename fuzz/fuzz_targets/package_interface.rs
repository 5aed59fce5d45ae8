//! An interface in TOML.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(package, interface);
