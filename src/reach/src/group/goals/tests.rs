//! Goals of robots through the topics and services of their actions.

mod services;
mod topics;
