//! A message definition, and a message of it.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ros, definition);
