//! What clients and nodes see of a bridge: a real Master, a real node on its own bus, real TCPROS on loopback, and
//! clients that speak WebSocket by another implementation than the bridge's.

mod support;

mod actions;
mod bad_input;
mod manners;
mod memory;
mod publishing;
mod resuming;
mod rosapi;
mod services;
mod subscribing;
mod transforms;
mod waiting;
