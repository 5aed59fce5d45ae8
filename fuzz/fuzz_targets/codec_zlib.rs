//! RFC 1950.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, zlib);
