//! `nav_msgs/OccupancyGrid`.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, grid);
