use proptest::prelude::*;

use super::*;

const RULES: Rules = Rules { window: 2, replicas: 1, idempotent: false };

fn group(rules: Rules, members: u64) -> Dispatcher {
    let mut group = Dispatcher::new(rules);
    for member in 1..=members {
        assert_eq!(group.join(member), []);
    }
    group
}

fn call() -> Kind {
    Kind::Call("/work".into())
}

fn goal() -> Kind {
    Kind::Goal("/count".into())
}

#[test]
fn the_servant_with_the_fewest_requests_is_asked() {
    let mut group = group(RULES, 2);
    assert_eq!(group.ask(7, &call()), (1, vec![DispatchOrder::Ask(1, 1)]));
    assert_eq!(group.ask(7, &call()), (2, vec![DispatchOrder::Ask(2, 2)]));
    assert_eq!(group.finish_attempt(2, 2, AttemptOutcome::Answered), (true, vec![]));
    assert_eq!(group.ask(8, &call()), (3, vec![DispatchOrder::Ask(3, 2)]));
    // Of two with equal load, the one that got fewer requests.
    assert_eq!(group.finish_attempt(3, 2, AttemptOutcome::Answered), (true, vec![]));
    assert_eq!(group.finish_attempt(1, 1, AttemptOutcome::Answered), (true, vec![]));
    assert_eq!(group.ask(8, &call()), (4, vec![DispatchOrder::Ask(4, 1)]));
}

#[test]
fn requests_without_a_free_servant_wait_and_robots_take_turns() {
    let mut group = group(RULES, 1);
    for _ in 0..5 {
        group.ask(1, &call());
    }
    group.ask(2, &call());
    let load = GroupLoad { waiting: 4, under_way: 2 };
    assert_eq!(group.load(), load);
    // The third of the greedy robot, then the other robot's, then the rest.
    let next = |group: &mut Dispatcher, ended| group.finish_attempt(ended, 1, AttemptOutcome::Answered).1;
    assert_eq!(next(&mut group, 1), [DispatchOrder::Ask(3, 1)]);
    assert_eq!(next(&mut group, 2), [DispatchOrder::Ask(6, 1)]);
    assert_eq!(next(&mut group, 3), [DispatchOrder::Ask(4, 1)]);
    // An additional servant takes a waiting request.
    assert_eq!(group.join(2), [DispatchOrder::Ask(5, 2)]);
}

#[test]
fn a_servant_carries_out_goals_of_one_robot_at_a_time() {
    let mut group = group(RULES, 2);
    assert_eq!(group.ask(1, &goal()).1, [DispatchOrder::Ask(1, 1)]);
    assert_eq!(group.ask(2, &goal()).1, [DispatchOrder::Ask(2, 2)]);
    assert_eq!(group.ask(3, &goal()).1, []);
    // The robot's next goal goes to the same servant, because the node knows how to treat it.
    assert_eq!(group.ask(2, &goal()).1, [DispatchOrder::Ask(4, 2)]);
    assert_eq!(group.finish_attempt(2, 2, AttemptOutcome::Answered).1, []);
    assert_eq!(group.finish_attempt(4, 2, AttemptOutcome::Answered).1, [DispatchOrder::Ask(3, 2)]);
    // Another action is independent.
    let other = Kind::Goal("/dock".into());
    assert_eq!(group.ask(4, &other).1, [DispatchOrder::Ask(5, 1)]);
}

#[test]
fn a_robot_with_ever_new_goals_does_not_keep_others_from_its_servant() {
    let mut group = group(RULES, 1);
    assert_eq!(group.ask(1, &goal()).1, [DispatchOrder::Ask(1, 1)]);
    // Each replaces the one before, as action servers do.
    let mut before = 1;
    let mut next = |group: &mut Dispatcher| {
        let (ticket, orders) = group.ask(1, &goal());
        let begins = orders == [DispatchOrder::Ask(ticket, 1)];
        if begins {
            assert_eq!(group.finish_attempt(before, 1, AttemptOutcome::Answered).1, []);
            before = ticket;
        }
        (begins, before)
    };
    for _ in 0..100 {
        assert!(next(&mut group).0, "nobody else waits");
    }
    let (other, orders) = group.ask(2, &goal());
    assert_eq!(orders, []);
    let ahead = (0..100).filter(|_| next(&mut group).0).count();
    assert_eq!(ahead, AHEAD);
    let (_, last) = next(&mut group);
    assert_eq!(
        group.finish_attempt(last, 1, AttemptOutcome::Answered).1,
        [DispatchOrder::Ask(other, 1)],
        "the first robot's next ones wait for their turn"
    );
    let first = other + 1 + AHEAD as u64;
    assert_eq!(group.finish_attempt(other, 1, AttemptOutcome::Answered).1.first(), Some(&DispatchOrder::Ask(first, 1)));
}

#[test]
fn requests_of_a_lost_servant_fail_or_are_retried() {
    let mut strict = group(RULES, 2);
    strict.ask(1, &call());
    let orders = strict.leave(1);
    let fails = [DispatchOrder::Drop(1, 1), DispatchOrder::Fail(1, LossReason::NotAskedAgain)];
    assert_eq!(orders, fails);
    assert_eq!(strict.finish_attempt(1, 1, AttemptOutcome::Answered), (false, vec![]), "late");

    let rules = Rules { idempotent: true, ..RULES };
    let mut group = group(rules, 4);
    group.ask(1, &call());
    assert_eq!(group.leave(1), [DispatchOrder::Drop(1, 1), DispatchOrder::Ask(1, 2)]);
    assert_eq!(group.finish_attempt(1, 2, AttemptOutcome::Lost), (false, vec![DispatchOrder::Ask(1, 3)]));
    // This request may be the cause of the crashes.
    let (_, orders) = group.finish_attempt(1, 3, AttemptOutcome::Lost);
    assert_eq!(orders, [DispatchOrder::Fail(1, LossReason::AskedOften)]);
}

#[test]
fn what_was_not_taken_waits_for_a_servant_that_takes_it() {
    let mut group = group(RULES, 2);
    group.ask(1, &call());
    assert_eq!(group.finish_attempt(1, 1, AttemptOutcome::NotTaken).1, [DispatchOrder::Ask(1, 2)]);
    assert_eq!(group.finish_attempt(1, 2, AttemptOutcome::NotTaken).1, []);
    assert_eq!(group.load().waiting, 1);
    // The waiting call blocks no other service, neither for this robot nor for another.
    let other = Kind::Call("/rest".into());
    assert_eq!(group.ask(2, &other).1, [DispatchOrder::Ask(2, 1)]);
    assert_eq!(group.ask(1, &other).1, [DispatchOrder::Ask(3, 2)]);
    assert_eq!(group.resume(1, &other), []);
    assert_eq!(group.resume(1, &call()), [DispatchOrder::Ask(1, 1)]);
}

#[test]
fn a_servant_that_loses_a_request_does_not_get_those_that_follow() {
    let rules = Rules { window: 8, ..RULES };
    let mut group = group(rules, 2);
    for ticket in 1..=4 {
        group.ask(ticket, &call());
    }
    let lost = group.finish_attempt(1, 1, AttemptOutcome::Lost).1;
    assert_eq!(lost, [DispatchOrder::Fail(1, LossReason::NotAskedAgain)]);
    // It now has the fewest requests in progress.
    assert_eq!(group.ask(5, &call()).1, [DispatchOrder::Ask(5, 2)]);
    assert_eq!(group.ask(6, &call()).1, [DispatchOrder::Ask(6, 2)]);
    assert_eq!(group.resume(1, &call()), []);
    assert_eq!(group.ask(7, &call()).1, [DispatchOrder::Ask(7, 1)]);
}

#[test]
fn the_first_answer_of_replicas_wins() {
    let rules = Rules { replicas: 2, ..RULES };
    let mut group = group(rules, 1);
    // There is only one.
    assert_eq!(group.ask(1, &call()).1, [DispatchOrder::Ask(1, 1)]);
    group.join(2);
    let (ticket, orders) = group.ask(1, &call());
    assert_eq!(orders, [DispatchOrder::Ask(ticket, 2), DispatchOrder::Ask(ticket, 1)]);
    let answered = group.finish_attempt(ticket, 1, AttemptOutcome::Answered);
    assert_eq!(answered, (true, vec![DispatchOrder::Drop(ticket, 2)]));
    assert_eq!(group.finish_attempt(ticket, 2, AttemptOutcome::Answered), (false, vec![]));
    // If one is lost the other remains; after that it is retried.
    let (ticket, _) = group.ask(1, &call());
    assert_eq!(group.finish_attempt(ticket, 2, AttemptOutcome::Lost), (false, vec![]));
    assert_eq!(group.finish_attempt(ticket, 1, AttemptOutcome::Lost), (false, vec![]));
    assert_eq!(group.resume(2, &call()), [DispatchOrder::Ask(ticket, 2)]);
}

#[test]
fn a_retired_servant_ends_what_it_has_and_gets_no_more() {
    let mut group = group(RULES, 2);
    group.ask(1, &call());
    assert_eq!(group.retire(1), []);
    assert_eq!(group.ask(1, &call()).1, [DispatchOrder::Ask(2, 2)]);
    assert_eq!(group.ask(1, &call()).1, [DispatchOrder::Ask(3, 2)]);
    assert_eq!(group.ask(1, &call()).1, [], "though it has a place");
    assert_eq!(group.finish_attempt(1, 1, AttemptOutcome::Answered), (true, vec![]));
    assert_eq!(group.member_load(1), 0);
    assert_eq!(group.reinstate(1), [DispatchOrder::Ask(4, 1)]);
}

/// An event in a group. Numbers select one of the existing elements, if there are any.
#[derive(Debug, Clone)]
enum Step {
    Joins,
    Leaves(usize),
    Retires(usize),
    Resumes(usize),
    Asks { robot: RobotNumber, action: usize },
    Ends(usize, AttemptOutcome),
    Withdraws(usize),
}

fn step() -> impl Strategy<Value = Step> {
    let any = 0usize..64;
    let end = prop_oneof![
        6 => Just(AttemptOutcome::Answered),
        1 => Just(AttemptOutcome::NotTaken),
        1 => Just(AttemptOutcome::Lost),
    ];
    prop_oneof![
        2 => Just(Step::Joins),
        1 => any.clone().prop_map(Step::Leaves),
        1 => any.clone().prop_map(Step::Retires),
        1 => any.clone().prop_map(Step::Resumes),
        10 => (0u64..4, 0usize..4).prop_map(|(robot, action)| Step::Asks { robot, action }),
        8 => (any.clone(), end).prop_map(|(which, end)| Step::Ends(which, end)),
        1 => any.prop_map(Step::Withdraws),
    ]
}

/// A request as seen by its robot and the servants.
#[derive(Debug)]
struct TrackedRequest {
    robot: RobotNumber,
    kind: Kind,
    at: BTreeSet<Member>,
    lost: usize,
    over: bool,
}

impl TrackedRequest {
    fn is_call(&self) -> bool {
        matches!(self.kind, Kind::Call(_))
    }
}

/// The environment of a dispatcher.
struct DispatchWorld {
    rules: Rules,
    group: Dispatcher,
    members: BTreeMap<Member, bool>,
    joined: Member,
    paused: BTreeSet<(Member, Kind)>,
    seen: BTreeMap<Ticket, TrackedRequest>,
}

impl DispatchWorld {
    fn apply_orders(&mut self, orders: Vec<DispatchOrder>) {
        for order in orders {
            match order {
                DispatchOrder::Ask(ticket, member) => {
                    assert_eq!(self.members.get(&member), Some(&false), "it is asked");
                    let seen = self.seen.get_mut(&ticket).expect("asked for");
                    let paused = (member, seen.kind.clone());
                    assert!(!self.paused.contains(&paused), "it does not take any");
                    assert!(!seen.over, "{ticket} is over");
                    assert!(seen.at.insert(member), "{ticket} is there already");
                    assert!(seen.lost == 0 || self.rules.idempotent, "asked again");
                    assert!(seen.lost < ATTEMPTS);
                }
                DispatchOrder::Drop(ticket, member) => {
                    self.seen.get_mut(&ticket).expect("asked for").at.remove(&member);
                }
                DispatchOrder::Fail(ticket, why) => {
                    let seen = self.seen.get_mut(&ticket).expect("asked for");
                    assert!(!seen.over && seen.at.is_empty() && seen.lost > 0);
                    assert_eq!(why == LossReason::NotAskedAgain, !self.rules.idempotent);
                    seen.over = true;
                }
            }
        }
    }

    fn apply_step(&mut self, step: Step) {
        match step {
            Step::Joins if self.members.len() < 6 => {
                self.joined += 1;
                self.members.insert(self.joined, false);
                let orders = self.group.join(self.joined);
                self.apply_orders(orders);
            }
            Step::Joins => {}
            Step::Leaves(which) => {
                let Some(member) = nth(self.members.keys(), which) else {
                    return;
                };
                self.members.remove(&member);
                self.paused.retain(|(of, _)| *of != member);
                for seen in self.seen.values_mut().filter(|seen| seen.at.contains(&member)) {
                    seen.lost += 1;
                }
                let orders = self.group.leave(member);
                self.apply_orders(orders);
            }
            Step::Retires(which) => {
                if let Some(member) = nth(self.members.keys(), which) {
                    self.members.insert(member, true);
                    let orders = self.group.retire(member);
                    self.apply_orders(orders);
                }
            }
            Step::Resumes(which) => {
                let which = which % self.paused.len().max(1);
                if let Some((member, kind)) = self.paused.iter().nth(which).cloned() {
                    self.paused.remove(&(member, kind.clone()));
                    let orders = self.group.resume(member, &kind);
                    self.apply_orders(orders);
                }
            }
            Step::Asks { robot, action } => {
                let kind = match action {
                    0 | 1 => Kind::Call(format!("/{action}").into()),
                    number => Kind::Goal(format!("/{number}").into()),
                };
                let (ticket, orders) = self.group.ask(robot, &kind);
                let seen = TrackedRequest { robot, kind, at: BTreeSet::new(), lost: 0, over: false };
                assert!(self.seen.insert(ticket, seen).is_none(), "given twice");
                self.apply_orders(orders);
            }
            Step::Ends(which, end) => {
                let works = self.seen.iter();
                let works = works.flat_map(|(ticket, seen)| seen.at.iter().map(|at| (*ticket, *at)));
                let works: Vec<_> = works.collect();
                let Some((ticket, member)) = works.get(which % works.len().max(1)).copied() else {
                    return;
                };
                let seen = self.seen.get_mut(&ticket).expect("asked for");
                seen.at.remove(&member);
                match end {
                    AttemptOutcome::NotTaken => {
                        self.paused.insert((member, seen.kind.clone()));
                    }
                    AttemptOutcome::Lost => {
                        seen.lost += 1;
                        self.paused.insert((member, seen.kind.clone()));
                    }
                    AttemptOutcome::Answered => {
                        assert!(!seen.over, "answered twice");
                        seen.over = true;
                    }
                }
                let (counts, orders) = self.group.finish_attempt(ticket, member, end);
                assert_eq!(counts, end == AttemptOutcome::Answered);
                self.apply_orders(orders);
            }
            Step::Withdraws(which) => {
                let open = self.seen.iter().filter(|(_, seen)| !seen.over);
                let Some(ticket) = nth(open.map(|(ticket, _)| ticket), which) else {
                    return;
                };
                self.seen.get_mut(&ticket).expect("asked for").over = true;
                let orders = self.group.withdraw(ticket);
                self.apply_orders(orders);
            }
        }
    }

    fn check_invariants(&self) {
        let open: Vec<&TrackedRequest> = self.seen.values().filter(|seen| !seen.over).collect();
        for seen in self.seen.values().filter(|seen| seen.over) {
            assert!(seen.at.is_empty(), "nobody waits for it");
        }
        for member in self.members.keys() {
            let here: Vec<&&TrackedRequest> = open.iter().filter(|seen| seen.at.contains(member)).collect();
            assert_eq!(self.group.member_load(*member), here.len());
            let calls = here.iter().filter(|seen| seen.is_call()).count();
            assert!(calls <= self.rules.window, "{calls} calls");
            for seen in &here {
                let crosses = |other: &&&TrackedRequest| other.kind == seen.kind && other.robot != seen.robot;
                let goal = !seen.is_call();
                assert!(!goal || !here.iter().any(crosses), "of two robots");
            }
        }
        let waiting = open.iter().filter(|seen| seen.at.is_empty());
        let count = waiting.clone().count();
        assert_eq!(self.group.load().waiting, count);
        assert_eq!(self.group.load().under_way, open.len() - count);
        let able =
            |member: &Member, kind: &Kind| !self.members[member] && !self.paused.contains(&(*member, kind.clone()));
        let has_servant = |of: &TrackedRequest| {
            let mut same = open.iter();
            same.any(|other| {
                let here = other.kind == of.kind && other.robot == of.robot;
                here && other.at.iter().any(|it| self.members.contains_key(it) && able(it, &of.kind))
            })
        };
        let others_wait = |seen: &TrackedRequest| {
            let mut others = open.iter().filter(|other| other.at.is_empty());
            others.any(|other| other.kind == seen.kind && other.robot != seen.robot && !has_servant(other))
        };
        // Nothing waits that could be sent.
        for seen in waiting {
            let members = self.members.keys();
            let able: Vec<&Member> = members.filter(|it| able(it, &seen.kind)).collect();
            let free = able.iter().filter(|member| {
                let mut here = open.iter().filter(|other| other.at.contains(**member));
                match seen.kind {
                    Kind::Call(_) => here.filter(|other| other.is_call()).count() < self.rules.window,
                    // Further goals of a robot give way to others'.
                    _ => here.all(|other| other.kind != seen.kind || (other.robot == seen.robot && !others_wait(seen))),
                }
            });
            let wanted = match seen.kind {
                Kind::Call(_) => self.rules.replicas.min(able.len()).max(1),
                _ => 1,
            };
            assert!(free.count() < wanted, "{seen:?} waits");
        }
        for seen in &open {
            let most = if seen.is_call() { self.rules.replicas } else { 1 };
            assert!(seen.at.len() <= most);
        }
    }
}

fn nth<'a>(keys: impl Iterator<Item = &'a u64>, which: usize) -> Option<u64> {
    let keys: Vec<u64> = keys.copied().collect();
    keys.get(which % keys.len().max(1)).copied()
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(300) })]
    #[test]
    fn each_request_is_answered_once_or_fails_with_a_reason_and_none_crosses_robots(
        steps in prop::collection::vec(step(), 1..150),
        window in 1usize..4,
        replicas in 1usize..4,
        idempotent: bool,
    ) {
        let idempotent = idempotent || replicas > 1;
        let rules = Rules { window, replicas, idempotent };
        let mut world = DispatchWorld {
            rules,
            group: Dispatcher::new(rules),
            members: BTreeMap::new(),
            joined: 0,
            paused: BTreeSet::new(),
            seen: BTreeMap::new(),
        };
        for step in steps {
            world.apply_step(step);
            world.check_invariants();
        }
        // With a working servant, every request ends.
        while let Some(member) = world.members.keys().next().copied() {
            world.apply_step(Step::Leaves(0));
            prop_assert!(!world.members.contains_key(&member));
        }
        world.apply_step(Step::Joins);
        for _ in 0..world.seen.len() {
            world.apply_step(Step::Ends(0, AttemptOutcome::Answered));
            world.check_invariants();
        }
        prop_assert!(world.seen.values().all(|seen| seen.over));
        prop_assert_eq!(world.group.load(), GroupLoad::default());
    }
}
