//! Frames of a link, and the records in them.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(link, frame);
