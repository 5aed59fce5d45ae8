//! Certificate requests of robots (PKCS #10).
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(authority, request);
