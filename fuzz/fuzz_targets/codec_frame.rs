//! Frames of any codec, tag and version included.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, frame);
