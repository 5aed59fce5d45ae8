//! `sensor_msgs/PointCloud2`.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, cloud);
