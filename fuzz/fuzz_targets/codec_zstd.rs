//! RFC 8878.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, zstd);
