//! Control records of a link, of either end.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(link, orders);
