//! The link between stubs and the cloud: its frames, their records, hellos and orders.

use std::fmt::Debug;

use ::link::control::{FromCloud, FromRobot, Hello, Welcome};
use ::link::frame::Frame;
use ::link::record::Record;
use bytes::Bytes;
use serde::Serialize;
use serde::de::DeserializeOwned;

/// Frames and their records. Whatever is read is written again and must be read as the same.
pub fn frame(data: &[u8]) {
    let Ok(frame) = Frame::decode(Bytes::copy_from_slice(data)) else {
        return;
    };
    let again = Frame::decode(frame.encode());
    assert_eq!(again.expect("its own frame"), frame);
    let Frame::Whole { record, .. } = frame else {
        return;
    };
    if let Ok(record) = Record::decode(record) {
        let (head, payload) = record.to_parts();
        let again = Record::decode([&head[..], &payload].concat().into());
        assert_eq!(again.expect("its own record"), record);
    }
}

/// Opening frames of either end.
pub fn hello(data: &[u8]) {
    check_json_round_trip::<Hello>(data);
    check_json_round_trip::<Welcome>(data);
}

/// Control records of either end.
pub fn orders(data: &[u8]) {
    check_json_round_trip::<FromRobot>(data);
    check_json_round_trip::<FromCloud>(data);
}

/// Checks that the JSON written from what was read is read as the same.
fn check_json_round_trip<T: DeserializeOwned + Serialize + PartialEq + Debug>(data: &[u8]) {
    let Ok(told) = serde_json::from_slice::<T>(data) else {
        return;
    };
    let written = serde_json::to_vec(&told).expect("it can be written");
    let again = serde_json::from_slice::<T>(&written);
    assert_eq!(again.expect("its own JSON"), told);
}
