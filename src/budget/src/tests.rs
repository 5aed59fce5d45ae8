use super::*;

#[test]
fn a_permit_counts_at_every_level_and_gives_back_at_every_level() {
    let daemon = Budget::new("the daemon", 100);
    let client = daemon.child("client a", 60);
    let permit = client.take(50).expect("it fits");
    assert_eq!((client.used_bytes(), daemon.used_bytes()), (50, 50));
    drop(permit);
    assert_eq!((client.used_bytes(), daemon.used_bytes()), (0, 0));
}

#[test]
fn who_exceeds_its_own_budget_takes_nothing_from_others() {
    let daemon = Budget::new("the daemon", 100);
    let (a, b) = (daemon.child("client a", 60), daemon.child("client b", 60));
    let held = a.take(50).expect("it fits");
    let refused = a.take(11).expect_err("11 more are too many");
    assert_eq!(refused.to_string(), "11 bytes more do not fit into the memory for client a: 50 of 60 bytes are in use");
    assert_eq!((a.refusal_count(), daemon.refusal_count()), (1, 0));
    let other = b.take(50).expect("the other has its own");
    assert_eq!(b.available(), 0, "the daemon's is used up");
    drop((held, other));
    assert_eq!((a.used_bytes(), b.used_bytes(), daemon.used_bytes()), (0, 0, 0));
}

#[test]
fn a_refusal_above_leaves_nothing_below() {
    let daemon = Budget::new("the daemon", 100);
    let (a, b) = (daemon.child("client a", 80), daemon.child("client b", 80));
    let _held = a.take(80).expect("it fits");
    let refused = b.take(30).expect_err("the daemon's is full");
    assert_eq!(refused.name, "the daemon");
    assert_eq!((b.used_bytes(), daemon.used_bytes()), (0, 80));
}

#[test]
fn a_permit_grows_and_shrinks_and_stays_as_it_was_when_refused() {
    let budget = Budget::new("x", 100);
    let mut permit = budget.permit();
    permit.grow_to(70).expect("it fits");
    permit.grow_to(10).expect("less is no change");
    assert_eq!(permit.bytes(), 70);
    permit.resize(101).expect_err("too many");
    assert_eq!((permit.bytes(), budget.used_bytes()), (70, 70));
    permit.resize(20).expect("fewer always fit");
    assert_eq!(budget.used_bytes(), 20);
    assert!(budget.take(usize::MAX).is_err(), "sums do not wrap");
}

#[tokio::test]
async fn who_waits_gets_what_another_gives_back() {
    let daemon = Budget::new("the daemon", 100);
    let budget = daemon.child("x", 100);
    // The bytes are released by another child of the daemon's budget.
    let held = daemon.take(80).expect("it fits");
    let patience = Duration::from_secs(60);
    let waiting = tokio::spawn(async move { budget.wait(30, patience).await });
    tokio::task::yield_now().await;
    assert!(!waiting.is_finished());
    drop(held);
    let permit = waiting.await.expect("no panic").expect("there is room now");
    assert_eq!((permit.bytes(), daemon.used_bytes()), (30, 30));
}

#[tokio::test]
async fn waiting_ends_where_it_is_of_no_use() {
    let budget = Budget::new("x", 100);
    let never = budget.wait(101, Duration::from_secs(3600)).await;
    assert_eq!(never.expect_err("it never fits").limit, 100);
    let _held = budget.take(80).expect("it fits");
    let late = budget.wait(30, Duration::ZERO).await;
    assert_eq!(late.expect_err("nobody gave back").used, 80);
}

#[test]
fn a_name_has_one_share_as_long_as_somebody_holds_it() {
    let daemon = Budget::new("the daemon", 1000);
    let shares = Shares::new(&daemon, "client", 100);
    let (first, again) = (shares.for_name("a"), shares.for_name("a"));
    let _held = first.take(60).expect("it fits");
    assert_eq!(again.used_bytes(), 60, "two connections of one client");
    assert_eq!(again.name(), "client a");
    assert_eq!(shares.for_name("b").used_bytes(), 0);
    drop((first, again));
    assert_eq!(shares.for_name("a").used_bytes(), 60, "a permit keeps it");
    assert_eq!(shares.len(), 1);
}

#[test]
fn many_threads_leave_the_sums_as_they_were() {
    let daemon = Budget::new("the daemon", 50);
    let threads: Vec<_> = (0..4)
        .map(|number| {
            let mine = daemon.child(format!("client {number}"), 30);
            std::thread::spawn(move || {
                for round in 0..10_000 {
                    let permit = mine.take(round % 31);
                    assert!(mine.used_bytes() <= 30, "{mine:?}");
                    drop(permit);
                }
            })
        })
        .collect();
    threads.into_iter().for_each(|thread| thread.join().expect("no panic"));
    assert_eq!(daemon.used_bytes(), 0);
}

#[tokio::test]
async fn whoever_looks_after_all_is_told_who_was_refused_and_once() {
    let (sender, told) = std::sync::mpsc::channel();
    let observer = move |who: &str, full: &Exceeded| {
        sender.send((who.to_owned(), full.name.clone())).expect("heard");
    };
    let daemon = Budget::with_observer("the daemon", 100, Box::new(observer));
    let client = daemon.child("client a", 200);
    client.take(101).expect_err("too many");
    let waited = client.wait(101, Duration::from_secs(60)).await;
    waited.expect_err("it never fits");
    let both: Vec<_> = told.try_iter().collect();
    let one = ("client a".to_owned(), "the daemon".to_owned());
    assert_eq!(both, [one.clone(), one]);
}

#[test]
fn refusals_count_where_there_was_no_room_whatever_budgets_are_called() {
    let outer = Budget::new("same", 100);
    let inner = outer.child("same", 10);
    inner.take(11).expect_err("too many");
    assert_eq!((inner.refusal_count(), outer.refusal_count()), (1, 0));
}

#[test]
fn what_others_have_counted_counts_in_one_budget_alone() {
    let daemon = Budget::new("the daemon", 100);
    let (a, b) = (daemon.child("client a", 60), daemon.child("client b", 60));
    let made = daemon.take(50).expect("it fits");
    let shared = (a.without_parents().take(50), b.without_parents().take(50));
    assert_eq!((a.used_bytes(), b.used_bytes(), daemon.used_bytes()), (50, 50, 50));
    let refused = a.without_parents().take(11).expect_err("60 are for client a");
    assert_eq!(refused.name, "client a");
    drop((made, shared));
    assert_eq!((a.used_bytes(), b.used_bytes(), daemon.used_bytes()), (0, 0, 0));
}

#[test]
fn a_permit_is_divided_between_its_budget_and_those_above() {
    let daemon = Budget::new("the daemon", 100);
    let servant = daemon.child("servant x", 60);
    let (own, above) = servant.take(50).expect("it fits").split();
    assert_eq!((servant.used_bytes(), daemon.used_bytes()), (50, 50));
    drop(own);
    assert_eq!((servant.used_bytes(), daemon.used_bytes()), (0, 50));
    drop(above);
    assert_eq!(daemon.used_bytes(), 0);
    let (own, above) = daemon.take(10).expect("it fits").split();
    assert!(above.is_none());
    assert_eq!(own.bytes(), 10);
}

#[test]
fn bytes_hold_their_permit_as_long_as_a_part_of_them_is_held() {
    let budget = Budget::new("x", 100);
    let whole = budget.take(10).expect("it fits").wrap_bytes(vec![7; 10]);
    let part = whole.slice(8..);
    drop(whole);
    assert_eq!((&part[..], budget.used_bytes()), (&[7, 7][..], 10));
    drop(part);
    assert_eq!(budget.used_bytes(), 0);
}

#[test]
fn queues_count_in_steps_and_not_while_they_are_short() {
    let budget = Budget::new("x", 3 * UNCOUNTED);
    let mut permit = budget.permit();
    for (bytes, counted) in [(0, 0), (UNCOUNTED, 0), (UNCOUNTED + 1, 2), (5, 0)] {
        permit.count(bytes).expect("it fits");
        assert_eq!(budget.used_bytes(), counted * UNCOUNTED);
    }
    permit.count(4 * UNCOUNTED).expect_err("too many");
    permit.count(usize::MAX).expect_err("sums do not wrap");
}
