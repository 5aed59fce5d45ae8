//! Client certificates of connections.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(authority, certificate);
