//! A message definition of ROS 2, and a message of it.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ros2, definition);
