//! A text frame.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(rosbridge, json);
