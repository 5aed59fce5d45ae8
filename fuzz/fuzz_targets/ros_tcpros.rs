//! A TCPROS stream: header and messages.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ros, tcpros);
