//! `sensor_msgs/LaserScan`.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, scan);
