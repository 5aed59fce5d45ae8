//! Messages on their way in: whatever they hold, they come back from every codec. The first byte names the type.
#![cfg_attr(fuzzing, no_main)]
fuzz::target!(codec, message);
