//! A file of rules for types of both ROSes.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(translation, rules);
