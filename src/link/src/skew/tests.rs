use ros::bus::RosVersion;
use ros::schema::Registry;

use super::*;

const AHEAD: i64 = 120 * SECOND + 7;

fn header() -> Stamps {
    let registry = Registry::new();
    Stamps::of(&registry.message("std_msgs/Header").unwrap())
}

fn stamped(seconds: u32, nanoseconds: u32) -> Bytes {
    let mut message = vec![9, 0, 0, 0];
    message.extend(seconds.to_le_bytes());
    message.extend(nanoseconds.to_le_bytes());
    message.extend([0; 4]);
    message.into()
}

fn measured(offset: i64, delay: i64) -> Sample {
    Sample { offset, delay }
}

fn ahead() -> Skew {
    let skew = Skew::default();
    skew.measured(measured(AHEAD, 2_000_000));
    skew
}

#[test]
fn a_robot_s_stamps_become_ours_and_come_back() {
    let skew = ahead();
    let sent = stamped(1_700_000_120, 7);
    let here = skew.apply(Direction::In, &header(), sent.clone());
    assert_eq!(here, stamped(1_700_000_000, 0));
    assert_eq!(skew.apply(Direction::Out, &header(), here), sent);
    // And what the node made up itself.
    let made = stamped(1_700_000_500, 999_999_999);
    let there = skew.apply(Direction::Out, &header(), made.clone());
    assert_eq!(there, stamped(1_700_000_621, 6));
    assert_eq!(skew.apply(Direction::In, &header(), there), made);
}

#[test]
fn a_stamp_comes_back_as_it_was_though_the_difference_was_measured_anew() {
    let skew = ahead();
    let sent = stamped(1_700_000_120, 7);
    let here = skew.apply(Direction::In, &header(), sent.clone());
    skew.measured(measured(AHEAD + 50_000_000, 100_000));
    assert_eq!(skew.difference(), AHEAD + 50_000_000);
    assert_eq!(skew.apply(Direction::Out, &header(), here), sent);
    let made = stamped(1_700_000_001, 0);
    let there = skew.apply(Direction::Out, &header(), made.clone());
    skew.measured(measured(AHEAD, 100_000));
    assert_eq!(skew.apply(Direction::In, &header(), there), made);
}

#[test]
fn a_difference_that_nobody_can_tell_is_none() {
    let skew = Skew::default();
    skew.measured(measured(20_000_000, 40_000_000));
    assert_eq!(skew.difference(), 0);
    skew.measured(measured(-900_000, 100));
    assert_eq!(skew.difference(), 0);
    skew.measured(measured(-21_100_000, 40_000_000));
    assert_eq!(skew.difference(), -21_100_000);
    // It stays until another is told from it.
    skew.measured(measured(-20_000_000, 40_000_000));
    assert_eq!(skew.difference(), -21_100_000);
}

#[test]
fn what_no_clock_shows_stays() {
    let skew = ahead();
    for (seconds, nanoseconds) in [(0, 0), (5, 1_000_000_000), (60, 0), (0, 1)] {
        let message = stamped(seconds, nanoseconds);
        assert_eq!(
            skew.apply(Direction::In, &header(), message.clone()),
            message
        );
    }
    let last = stamped(u32::MAX, 999_999_999);
    assert_eq!(skew.apply(Direction::Out, &header(), last.clone()), last);
    // Too short to be one: as it is, for the node to refuse.
    let short = Bytes::from_static(&[0; 11]);
    assert_eq!(skew.apply(Direction::In, &header(), short.clone()), short);
}

#[test]
fn stamps_of_either_order_of_bytes_are_changed_and_meet() {
    let skew = ahead();
    let registry = Registry::of(RosVersion::Two);
    let header = Stamps::of(&registry.message("std_msgs/msg/Header").unwrap());
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
    // A node of a little endian machine copies the stamp, and the clocks have been compared anew meanwhile.
    skew.measured(measured(AHEAD + 50_000_000, 100_000));
    let copied = little(1_700_000_000, 0);
    let there = skew.apply(Direction::Out, &header, copied);
    assert_eq!(there, little(1_700_000_120, 7));
}

#[test]
fn a_message_that_others_hold_is_not_changed_under_them() {
    let skew = ahead();
    let sent = stamped(1_700_000_120, 7);
    let held = sent.clone();
    let here = skew.apply(Direction::In, &header(), sent);
    assert_ne!(here, held);
    assert_eq!(held, stamped(1_700_000_120, 7));
}

#[test]
fn memory_is_bounded() {
    let skew = ahead();
    for second in 0..3 * REMEMBERED {
        let message = stamped(1_700_000_000 + u32::try_from(second).unwrap(), 0);
        skew.apply(Direction::In, &header(), message);
    }
    let known = skew.known.lock();
    assert_eq!(known.robots.found.len(), REMEMBERED);
    assert_eq!(known.robots.order.len(), REMEMBERED);
}
