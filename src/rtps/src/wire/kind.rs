//! Submessage ids (9.4.5.1.1).

pub(super) const PAD: u8 = 0x01;
pub(super) const ACKNACK: u8 = 0x06;
pub(super) const HEARTBEAT: u8 = 0x07;
pub(super) const GAP: u8 = 0x08;
pub(super) const INFO_TS: u8 = 0x09;
pub(super) const INFO_SRC: u8 = 0x0c;
pub(super) const INFO_DST: u8 = 0x0e;
pub(super) const NACK_FRAG: u8 = 0x12;
pub(super) const HEARTBEAT_FRAG: u8 = 0x13;
pub(super) const DATA: u8 = 0x15;
pub(super) const DATA_FRAG: u8 = 0x16;
