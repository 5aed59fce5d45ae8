//! An XML-RPC document.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(ros, xmlrpc);
