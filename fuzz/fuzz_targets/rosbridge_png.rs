//! A message packed into a picture.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(rosbridge, png);
