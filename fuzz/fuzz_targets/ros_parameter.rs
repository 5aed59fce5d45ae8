//! A parameter in JSON.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ros, parameter);
