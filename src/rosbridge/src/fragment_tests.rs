use super::*;
use crate::op::tests::{assert_parses, assert_refused, assert_survives_cbor};

fn part(id: &'static str, num: u64, total: u64, data: &'static str) -> Fragment<'static> {
    Fragment { id: id.into(), data: data.into(), num, total }
}

fn limits() -> FragmentLimits {
    FragmentLimits { messages: 2, parts: 100, bytes: 10_000, age: Duration::from_secs(1) }
}

#[test]
fn fragment_is_read_and_checked() {
    assert_parses(r#"{"op":"fragment","id":"a","data":"{\"op\":","num":0,"total":2}"#, part("a", 0, 2, "{\"op\":"));
    assert_survives_cbor(part("a", 0, 2, "x"));
    let index = "the fragment's index, from 0, is expected";
    assert_refused(
        r#"{"op":"fragment","id":"a","data":"x","total":2}"#,
        &format!("fragment: field \"num\" is missing, {index}"),
    );
    assert_refused(
        r#"{"op":"fragment","id":"a","data":"x","num":-1,"total":2}"#,
        &format!("fragment: field \"num\" is -1, {index}"),
    );
    assert_refused(
        r#"{"op":"fragment","data":"x","num":0,"total":2}"#,
        "fragment: field \"id\" is missing, the id common to all fragments of the message is expected",
    );
    assert_refused(
        r#"{"op":"fragment","id":"a","data":"x","num":0,"total":0}"#,
        "fragment: field \"total\" is 0, the number of fragments, 1 or more, is expected",
    );
}

#[test]
fn fragments_in_any_order_make_the_message() {
    let (mut fragments, now) = (Fragments::new(limits()), Instant::now());
    assert_eq!(fragments.add(&part("a", 2, 3, "c"), now), Ok(None));
    assert_eq!(fragments.add(&part("b", 1, 2, "2"), now), Ok(None));
    assert_eq!(fragments.add(&part("a", 0, 3, "a"), now), Ok(None));
    assert_eq!(fragments.add(&part("a", 0, 3, "a"), now), Ok(None));
    assert_eq!(fragments.add(&part("a", 1, 3, "b"), now), Ok(Some("abc".to_owned())));
    assert_eq!(fragments.add(&part("b", 0, 2, "1"), now), Ok(Some("12".to_owned())));
    assert_eq!(fragments.bytes(), 0);
    assert_eq!(fragments.add(&part("c", 0, 1, "alone"), now), Ok(Some("alone".to_owned())));
}

#[test]
fn contradictions_drop_the_message() {
    let (mut fragments, now) = (Fragments::new(limits()), Instant::now());
    assert_eq!(fragments.add(&part("a", 3, 3, ""), now), Err(FragmentError::Index { num: 3, total: 3 }));
    fragments.add(&part("a", 0, 3, "a"), now).unwrap();
    assert_eq!(fragments.add(&part("a", 1, 4, "b"), now), Err(FragmentError::Total { total: 4, earlier: 3 }));
    assert_eq!(fragments.bytes(), 0);
    fragments.add(&part("a", 0, 3, "a"), now).unwrap();
    assert_eq!(fragments.add(&part("a", 0, 3, "b"), now), Err(FragmentError::Doubled(0)));
    assert_eq!(fragments.bytes(), 0);
}

#[test]
fn unfinished_messages_cost_bounded_memory() {
    let (mut fragments, now) = (Fragments::new(limits()), Instant::now());
    let million = 1_000_000;
    assert_eq!(
        fragments.add(&part("a", 0, million, "a"), now),
        Err(FragmentError::Parts { total: million, limit: 100 })
    );
    let kilobyte: &'static str = Box::leak("x".repeat(1000).into_boxed_str());
    let mut refused = 0;
    for num in 0..50 {
        refused += usize::from(fragments.add(&part("a", num, 100, kilobyte), now).is_err());
        assert!(fragments.bytes() <= 10_000);
    }
    assert!(refused > 0);
    for id in ["p", "q", "r", "s"] {
        fragments.add(&part(id, 0, 2, "x"), now).unwrap();
        assert!(fragments.partial.len() <= 2);
    }
    assert_eq!(fragments.forget_old(now + Duration::from_secs(2)), 2);
    assert_eq!(fragments.bytes(), 0);
}

#[test]
fn texts_are_cut_between_characters() {
    let pieces: Vec<_> = split_text("aübe", 2).collect();
    assert_eq!(pieces, ["a", "ü", "be"]);
    assert_eq!(split_text("🤖🤖", 1).collect::<Vec<_>>(), ["🤖", "🤖"]);
    assert_eq!(split_text("abc", 100).collect::<Vec<_>>(), ["abc"]);
    assert_eq!(split_text("", 10).count(), 0);
}
