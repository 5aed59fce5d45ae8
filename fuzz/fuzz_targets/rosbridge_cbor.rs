//! A binary frame.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(rosbridge, cbor);
