//! RFC 1951.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, deflate);
