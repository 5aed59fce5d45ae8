//! A serialized message of one ROS, carried to the other.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(translation, bytes);
