//! `sensor_msgs/Image`, lossless.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, image);
