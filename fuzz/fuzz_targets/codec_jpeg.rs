//! `sensor_msgs/Image` as JPEG.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, jpeg);
