//! Payloads of discovery samples for participants and endpoints.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(rtps, discovery);
