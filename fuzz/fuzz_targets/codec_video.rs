//! `sensor_msgs/Image` as H.264.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, video);
