//! A datagram of RTPS.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(rtps, datagram);
