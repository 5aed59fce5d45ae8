//! Documents of an image that another tool has saved.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(image, saved_image);
