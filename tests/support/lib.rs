//! What stories are told with: a daemon of their own or the one they share, a deployer who types commands, a
//! robot on a WebSocket, and an eye for what is left behind.

pub mod binaries;
pub mod burglar;
pub mod burglary;
pub mod cable;
pub mod cutter;
pub mod daemon;
pub mod deployer;
pub mod freezer;
pub mod grants;
pub mod leftovers;
pub mod machine;
pub mod people;
pub mod procfs;
pub mod robot;
pub mod shaper;
pub mod site;
pub mod tls;
pub mod world;

/// What a story ends with: an error is told with all its causes.
pub type Told = anyhow::Result<()>;
