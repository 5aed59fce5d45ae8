//! Certificates that connections have shown.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(authority, certificate);
