//! JSON for a message.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ros, json);
