//! A tar archive that is pushed.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(image, archive);
