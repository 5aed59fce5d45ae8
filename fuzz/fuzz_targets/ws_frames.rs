//! Bytes received on a WebSocket.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ws, frames);
