//! Messages to be encoded: whatever their content, every codec restores them. The first byte selects the type.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, message);
