//! A recording of ROS 1, which is sent to be tried.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ros, bag);
