//! The payload of a sample by which participants and their ends are discovered.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(rtps, discovery);
