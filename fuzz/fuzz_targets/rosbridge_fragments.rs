//! Fragments of several messages, in any order.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(rosbridge, fragments);
