use ros::bus::RosVersion;
use ros::schema::Registry;

use super::*;

const AHEAD: i64 = 120 * SECOND + 7;

fn header() -> Stamps {
    let registry = Registry::new();
    Stamps::for_type(&registry.message("std_msgs/Header").unwrap())
}

fn stamped_message(seconds: u32, nanoseconds: u32) -> Bytes {
    let mut message = vec![9, 0, 0, 0];
    message.extend(seconds.to_le_bytes());
    message.extend(nanoseconds.to_le_bytes());
    message.extend([0; 4]);
    message.into()
}

fn sample(offset: i64, delay: i64) -> ClockSample {
    ClockSample { offset, delay }
}

fn skew_ahead() -> Skew {
    let skew = Skew::default();
    skew.on_clock_sample(sample(AHEAD, 2_000_000));
    skew
}

#[test]
fn stamps_are_converted_and_restored() {
    let skew = skew_ahead();
    let sent = stamped_message(1_700_000_120, 7);
    let here = skew.apply(Direction::In, &header(), sent.clone());
    assert_eq!(here, stamped_message(1_700_000_000, 0));
    assert_eq!(skew.apply(Direction::Out, &header(), here), sent);
    // The same for a stamp that the node created itself.
    let made = stamped_message(1_700_000_500, 999_999_999);
    let there = skew.apply(Direction::Out, &header(), made.clone());
    assert_eq!(there, stamped_message(1_700_000_621, 6));
    assert_eq!(skew.apply(Direction::In, &header(), there), made);
}

#[test]
fn a_stamp_comes_back_as_it_was_though_the_difference_was_measured_anew() {
    let skew = skew_ahead();
    let sent = stamped_message(1_700_000_120, 7);
    let here = skew.apply(Direction::In, &header(), sent.clone());
    skew.on_clock_sample(sample(AHEAD + 50_000_000, 100_000));
    assert_eq!(skew.difference(), AHEAD + 50_000_000);
    assert_eq!(skew.apply(Direction::Out, &header(), here), sent);
    let made = stamped_message(1_700_000_001, 0);
    let there = skew.apply(Direction::Out, &header(), made.clone());
    skew.on_clock_sample(sample(AHEAD, 100_000));
    assert_eq!(skew.apply(Direction::In, &header(), there), made);
}

#[test]
fn a_difference_within_the_measurement_error_is_ignored() {
    let skew = Skew::default();
    skew.on_clock_sample(sample(20_000_000, 40_000_000));
    assert_eq!(skew.difference(), 0);
    skew.on_clock_sample(sample(-900_000, 100));
    assert_eq!(skew.difference(), 0);
    skew.on_clock_sample(sample(-21_100_000, 40_000_000));
    assert_eq!(skew.difference(), -21_100_000);
    // It stays until a measurement is distinguishable from it.
    skew.on_clock_sample(sample(-20_000_000, 40_000_000));
    assert_eq!(skew.difference(), -21_100_000);
}

#[test]
fn what_no_clock_shows_stays() {
    let skew = skew_ahead();
    for (seconds, nanoseconds) in [(0, 0), (5, 1_000_000_000), (60, 0), (0, 1)] {
        let message = stamped_message(seconds, nanoseconds);
        assert_eq!(skew.apply(Direction::In, &header(), message.clone()), message);
    }
    let last = stamped_message(u32::MAX, 999_999_999);
    assert_eq!(skew.apply(Direction::Out, &header(), last.clone()), last);
    // Too short for a stamp: passed on unchanged, for the node to reject.
    let short = Bytes::from_static(&[0; 11]);
    assert_eq!(skew.apply(Direction::In, &header(), short.clone()), short);
}

#[test]
fn stamps_of_either_order_of_bytes_are_changed_and_meet() {
    let skew = skew_ahead();
    let registry = Registry::for_version(RosVersion::Two);
    let header = Stamps::for_type(&registry.message("std_msgs/msg/Header").unwrap());
    let big = |seconds: u32, nanoseconds: u32| -> Bytes {
        let parts = [[0; 4], seconds.to_be_bytes(), nanoseconds.to_be_bytes()];
        let parts = [&parts.concat()[..], &1_u32.to_be_bytes(), &[0; 4]];
        parts.concat().into()
    };
    let little = |seconds: u32, nanoseconds: u32| -> Bytes {
        let parts = [seconds, nanoseconds, 1, 0].map(u32::to_le_bytes);
        [&[0, 1, 0, 0][..], &parts.concat()].concat().into()
    };
    let sent = big(1_700_000_120, 7);
    let here = skew.apply(Direction::In, &header, sent.clone());
    assert_eq!(here, big(1_700_000_000, 0));
    assert_eq!(skew.apply(Direction::Out, &header, here), sent);
    // A node on a little-endian machine copies the stamp; the clocks were compared again in between.
    skew.on_clock_sample(sample(AHEAD + 50_000_000, 100_000));
    let copied = little(1_700_000_000, 0);
    let there = skew.apply(Direction::Out, &header, copied);
    assert_eq!(there, little(1_700_000_120, 7));
}

#[test]
fn a_message_that_others_hold_is_not_changed_under_them() {
    let skew = skew_ahead();
    let sent = stamped_message(1_700_000_120, 7);
    let held = sent.clone();
    let here = skew.apply(Direction::In, &header(), sent);
    assert_ne!(here, held);
    assert_eq!(held, stamped_message(1_700_000_120, 7));
}

#[test]
fn memory_is_bounded() {
    let skew = skew_ahead();
    for second in 0..3 * MAX_STAMPS {
        let message = stamped_message(1_700_000_000 + u32::try_from(second).unwrap(), 0);
        skew.apply(Direction::In, &header(), message);
    }
    let [robots, _] = &*skew.known.lock();
    assert_eq!(robots.found.len(), MAX_STAMPS);
    assert_eq!(robots.order.len(), MAX_STAMPS);
}
