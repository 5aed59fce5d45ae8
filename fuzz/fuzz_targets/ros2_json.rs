//! JSON for a message of ROS 2.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ros2, json);
