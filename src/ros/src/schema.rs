//! Definitions of messages, services and actions.
