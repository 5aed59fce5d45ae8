//! A package.xml.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(package, manifest);
