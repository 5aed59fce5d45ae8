//! A serialized message.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ros, bytes);
