//! The opening frames of a link.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(link, hello);
