//! Requests for robots' certificates (PKCS #10).
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(authority, request);
