//! JSON of Foxglove's protocol.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(viewer, json);
