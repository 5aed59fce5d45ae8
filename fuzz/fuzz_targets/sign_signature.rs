//! A signature of a stub's archive.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(sign, signature);
