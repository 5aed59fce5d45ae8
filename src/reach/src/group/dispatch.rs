//! Which servant of a group works at which request: the one with the fewest requests under way. Pure: what comes in are
//! requests, answers, and servants that come and go; what goes out are orders.
//!
//! ```text
//!            no servant has a free place        every servant that had it was lost
//!               ┌───────────────┐         ┌───────────────(idempotent)──────────────┐
//!  asked for ──▶ waits ──────────▶ under way at 1 … `replicas` servants ──▶ answered, once
//!                                         └──────▶ failed, with the reason
//! ```
//!
//! - A servant has at most [`Rules::window`] calls under way; the rest wait here, so that what waits is lost with no servant,
//!   and goes to a servant that is added meanwhile. Robots that wait have turns: one with a thousand calls holds nobody up,
//!   and neither does one that calls a service which no servant serves at the moment.
//! - A servant carries out goals of one action for one robot at a time, since most action servers take one goal and give up
//!   the one before for it: another robot's goal would end this robot's. A robot's next goal goes where its goal is, so that
//!   the node treats both as it would if it were this robot's alone. While others wait for the action, at most [`AHEAD`] of
//!   its goals do so, or one that sends a new goal each second would have the servant for ever; the next ones wait for their turn.
//! - A request that a lost servant had may have been carried out: it is asked again where the service is idempotent, at most
//!   [`ATTEMPTS`] times in all (it may be what ends the servants), and fails elsewhere. One that a servant did not take waits
//!   for its next turn.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use ros::turns::Turns;

/// How many servants in all may be lost with a request before it fails.
pub const ATTEMPTS: usize = 3;
/// So many goals of a robot that has a servant go before those of others who wait for it.
pub const AHEAD: usize = 8;

/// A request.
pub type Ticket = u64;
/// A servant of the group.
pub type Member = u64;
/// A robot of the group.
pub type Robot = u64;

/// What is asked for.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// A call of the service of this name.
    Call(Arc<str>),
    /// A goal of the action of this name.
    Goal(Arc<str>),
}

/// What the deployer decided of the group.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rules {
    /// Calls that one servant has under way at most; 0 counts as 1.
    pub window: usize,
    /// Servants that work at the same call at most; 0 counts as 1.
    pub replicas: usize,
    /// A request may be carried out twice.
    pub idempotent: bool,
}

/// What is to be done.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Order {
    /// Have this servant work at the request.
    Ask(Ticket, Member),
    /// What this servant answers to the request does not matter any more.
    Drop(Ticket, Member),
    /// The request has failed: the servant was lost while it worked at it.
    Fail(Ticket, Lost),
}

/// Why a request fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lost {
    /// The service is not idempotent.
    NotAskedAgain,
    /// It was asked as often as may be.
    AskedOften,
}

/// How a servant's work at a request has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum End {
    /// With an answer, be it that it failed.
    Answered,
    /// The servant did not take it: it was certainly not carried out.
    NotTaken,
    /// The servant went away: it may have been carried out.
    Lost,
}

/// How much is to be done.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Load {
    /// Requests that wait for a servant.
    pub waiting: usize,
    /// Requests at which at least one servant works.
    pub under_way: usize,
}

/// The calls of one service, or the goals of one action.
type Lane = u32;

#[derive(Debug)]
struct Request {
    robot: Robot,
    lane: Lane,
    /// Servants that work at it.
    at: BTreeSet<Member>,
    /// Servants that were lost with it.
    lost: usize,
}

#[derive(Debug, Default)]
struct Servant {
    calls: usize,
    /// By action, whose goals it carries out.
    goals: BTreeMap<Lane, Goals>,
    /// It gets no more.
    retired: bool,
    /// What it does not take, or does not answer, at the moment.
    paused: BTreeSet<Lane>,
    /// Requests that it was ever asked.
    asked: u64,
}

/// Goals of one action that a servant carries out.
#[derive(Debug)]
struct Goals {
    robot: Robot,
    count: usize,
    /// So many were begun while others waited.
    ahead: usize,
}

impl Servant {
    /// It can be asked.
    fn is_open(&self, lane: Lane) -> bool {
        !self.retired && !self.paused.contains(&lane)
    }

    fn load(&self) -> usize {
        self.calls + self.goals.values().map(|goals| goals.count).sum::<usize>()
    }
}

/// The requests of one group.
#[derive(Debug)]
pub struct Dispatcher {
    rules: Rules,
    tickets: Ticket,
    lanes: BTreeMap<Kind, Lane>,
    /// Those of calls.
    calls: BTreeSet<Lane>,
    servants: BTreeMap<Member, Servant>,
    requests: BTreeMap<Ticket, Request>,
    waiting: BTreeMap<(Robot, Lane), VecDeque<Ticket>>,
    turns: Turns<(Robot, Lane)>,
}

impl Dispatcher {
    /// One without servants and requests.
    pub fn new(rules: Rules) -> Dispatcher {
        Dispatcher {
            rules: Rules {
                window: rules.window.max(1),
                replicas: rules.replicas.max(1),
                // Whoever lets two servants work at a call lets it be carried out twice.
                idempotent: rules.idempotent || rules.replicas > 1,
            },
            tickets: 0,
            lanes: BTreeMap::new(),
            calls: BTreeSet::new(),
            servants: BTreeMap::new(),
            requests: BTreeMap::new(),
            waiting: BTreeMap::new(),
            turns: Turns::default(),
        }
    }

    /// A servant can be asked from now on.
    pub fn join(&mut self, member: Member) -> Vec<Order> {
        self.servants.entry(member).or_default();
        self.next()
    }

    /// A servant is asked no more; what it works at it ends.
    pub fn retire(&mut self, member: Member) -> Vec<Order> {
        if let Some(servant) = self.servants.get_mut(&member) {
            servant.retired = true;
        }
        // A call that waited for it, too, now has as many servants as there are.
        self.next()
    }

    /// A servant that was to be asked no more is asked again.
    pub fn take_back(&mut self, member: Member) -> Vec<Order> {
        if let Some(servant) = self.servants.get_mut(&member) {
            servant.retired = false;
        }
        self.next()
    }

    /// A servant that did not take a request, or lost it, is asked for such again.
    pub fn resume(&mut self, member: Member, kind: &Kind) -> Vec<Order> {
        let lane = self.lanes.get(kind);
        if let (Some(servant), Some(lane)) = (self.servants.get_mut(&member), lane) {
            servant.paused.remove(lane);
        }
        self.next()
    }

    fn lane(&mut self, kind: &Kind) -> Lane {
        if let Some(known) = self.lanes.get(kind) {
            return *known;
        }
        let lane = self.lanes.len() as Lane;
        self.lanes.insert(kind.clone(), lane);
        if matches!(kind, Kind::Call(_)) {
            self.calls.insert(lane);
        }
        lane
    }

    /// A servant is gone, with what it worked at.
    pub fn leave(&mut self, member: Member) -> Vec<Order> {
        self.servants.remove(&member);
        let had = self.requests.iter();
        let had: Vec<Ticket> = had
            .filter(|(_, request)| request.at.contains(&member))
            .map(|(ticket, _)| *ticket)
            .collect();
        let mut orders = Vec::new();
        for ticket in had.into_iter().rev() {
            orders.push(Order::Drop(ticket, member));
            self.lost(ticket, member, &mut orders);
        }
        orders.extend(self.next());
        orders
    }

    /// A robot asks for something.
    pub fn ask(&mut self, robot: Robot, kind: &Kind) -> (Ticket, Vec<Order>) {
        self.tickets += 1;
        let ticket = self.tickets;
        let lane = self.lane(kind);
        let request = Request {
            robot,
            lane,
            at: BTreeSet::new(),
            lost: 0,
        };
        self.requests.insert(ticket, request);
        let queue = self.waiting.entry((robot, lane)).or_default();
        queue.push_back(ticket);
        self.turns.join((robot, lane));
        (ticket, self.next())
    }

    /// A servant's work at a request has ended. Whether that is the request's answer, and what is to be done.
    pub fn ended(&mut self, ticket: Ticket, member: Member, end: End) -> (bool, Vec<Order>) {
        let known = self.requests.get(&ticket);
        let Some(request) = known.filter(|request| request.at.contains(&member)) else {
            return (false, Vec::new());
        };
        let lane = request.lane;
        let mut orders = Vec::new();
        match end {
            End::Answered => {
                let mut others = self.remove(ticket);
                others.remove(&member);
                orders.extend(others.into_iter().map(|other| Order::Drop(ticket, other)));
            }
            End::NotTaken => {
                self.pause(member, lane);
                self.release(ticket, member);
                self.again(ticket, &mut orders);
            }
            End::Lost => {
                self.pause(member, lane);
                self.lost(ticket, member, &mut orders);
            }
        }
        orders.extend(self.next());
        (end == End::Answered, orders)
    }

    /// A servant that ends requests without carrying them out has the fewest under way: unless it pauses, it would get, and
    /// lose, all that follow until its end is known.
    fn pause(&mut self, member: Member, lane: Lane) {
        if let Some(servant) = self.servants.get_mut(&member) {
            servant.paused.insert(lane);
        }
    }

    /// Nobody waits for the request's answer any more.
    pub fn withdraw(&mut self, ticket: Ticket) -> Vec<Order> {
        let at = self.remove(ticket).into_iter();
        let mut orders: Vec<Order> = at.map(|member| Order::Drop(ticket, member)).collect();
        orders.extend(self.next());
        orders
    }

    /// How much is to be done now.
    pub fn load(&self) -> Load {
        let waiting = self.waiting.values().map(VecDeque::len).sum();
        Load {
            waiting,
            under_way: self.requests.len() - waiting,
        }
    }

    /// Requests that a servant works at.
    pub fn load_of(&self, member: Member) -> usize {
        self.servants.get(&member).map_or(0, Servant::load)
    }

    /// Forgets a request; gives those that worked at it.
    fn remove(&mut self, ticket: Ticket) -> BTreeSet<Member> {
        let at = match self.requests.get(&ticket) {
            Some(request) => request.at.clone(),
            None => return BTreeSet::new(),
        };
        for member in &at {
            self.release(ticket, *member);
        }
        self.unqueue(ticket);
        self.requests.remove(&ticket);
        at
    }

    /// A servant does not work at a request any more.
    fn release(&mut self, ticket: Ticket, member: Member) {
        let Some(request) = self.requests.get_mut(&ticket) else {
            return;
        };
        if !request.at.remove(&member) {
            return;
        }
        let Some(servant) = self.servants.get_mut(&member) else {
            return;
        };
        if self.calls.contains(&request.lane) {
            servant.calls -= 1;
        } else if let Some(goals) = servant.goals.get_mut(&request.lane) {
            goals.count -= 1;
            if goals.count == 0 {
                servant.goals.remove(&request.lane);
            }
        }
    }

    /// A servant was lost with a request.
    fn lost(&mut self, ticket: Ticket, member: Member, orders: &mut Vec<Order>) {
        self.release(ticket, member);
        if let Some(request) = self.requests.get_mut(&ticket) {
            request.lost += 1;
        }
        self.again(ticket, orders);
    }

    /// A request at which nobody works any more waits again, before its robot's others, or fails.
    fn again(&mut self, ticket: Ticket, orders: &mut Vec<Order>) {
        let Some(request) = self.requests.get(&ticket) else {
            return;
        };
        if !request.at.is_empty() {
            return;
        }
        let why = match request.lost {
            0 => None,
            _ if !self.rules.idempotent => Some(Lost::NotAskedAgain),
            lost => (lost >= ATTEMPTS).then_some(Lost::AskedOften),
        };
        if let Some(why) = why {
            self.requests.remove(&ticket);
            orders.push(Order::Fail(ticket, why));
            return;
        }
        let key = (request.robot, request.lane);
        self.waiting.entry(key).or_default().push_front(ticket);
        self.turns.join(key);
    }

    /// A request does not wait any more.
    fn unqueue(&mut self, ticket: Ticket) {
        let Some(request) = self.requests.get(&ticket) else {
            return;
        };
        let key = (request.robot, request.lane);
        if let Some(queue) = self.waiting.get_mut(&key) {
            queue.retain(|other| *other != ticket);
            if queue.is_empty() {
                self.waiting.remove(&key);
                self.turns.forget(key);
            }
        }
    }

    /// Those that can be asked in this lane now for this robot, the best first; empty if they are too few.
    fn places(&self, robot: Robot, lane: Lane) -> Vec<Member> {
        let mut open: Vec<(Member, &Servant)> = self
            .servants
            .iter()
            .filter(|(_, servant)| servant.is_open(lane))
            .map(|(member, servant)| (*member, servant))
            .collect();
        let is_call = self.calls.contains(&lane);
        let wanted = match is_call {
            true => self.rules.replicas.min(open.len()),
            false => 1,
        };
        if is_call {
            open.retain(|(_, servant)| servant.calls < self.rules.window);
        } else {
            let of = |servant: &Servant| {
                servant
                    .goals
                    .get(&lane)
                    .map(|goals| (goals.robot, goals.ahead))
            };
            let own = open.iter().find_map(|(member, servant)| {
                let (has, ahead) = of(servant)?;
                (has == robot).then_some((*member, ahead))
            });
            match own {
                Some((member, ahead)) if ahead < AHEAD || !self.others_wait(robot, lane) => {
                    return vec![member];
                }
                Some(_) => return Vec::new(),
                None => open.retain(|(_, servant)| of(servant).is_none()),
            }
        }
        if open.len() < wanted.max(1) {
            return Vec::new();
        }
        open.sort_by_key(|(member, servant)| (servant.load(), servant.asked, *member));
        open.truncate(wanted);
        open.into_iter().map(|(member, _)| member).collect()
    }

    /// Whether another robot waits in this lane that no servant carries out a goal for.
    fn others_wait(&self, robot: Robot, lane: Lane) -> bool {
        let mut waiting = self.waiting.keys();
        waiting.any(|(other, of)| *of == lane && *other != robot && !self.has_servant(*other, lane))
    }

    fn has_servant(&self, robot: Robot, lane: Lane) -> bool {
        let mut open = self
            .servants
            .values()
            .filter(|servant| servant.is_open(lane));
        open.any(|servant| servant.goals.get(&lane).is_some_and(|of| of.robot == robot))
    }

    /// Has servants work at what waits, as far as they can.
    fn next(&mut self) -> Vec<Order> {
        let mut orders = Vec::new();
        let mut turns = std::mem::take(&mut self.turns);
        while let Some(key) = turns.take(|(robot, lane)| !self.places(*robot, *lane).is_empty()) {
            let places = self.places(key.0, key.1);
            let queue = self.waiting.get_mut(&key);
            let Some(ticket) = queue.and_then(VecDeque::pop_front) else {
                continue;
            };
            if self.waiting.get(&key).is_some_and(VecDeque::is_empty) {
                self.waiting.remove(&key);
                turns.forget(key);
            } else {
                turns.join(key);
            }
            for member in places {
                self.begin(ticket, key, member);
                orders.push(Order::Ask(ticket, member));
            }
        }
        self.turns = turns;
        orders
    }

    fn begin(&mut self, ticket: Ticket, (robot, lane): (Robot, Lane), member: Member) {
        if let Some(request) = self.requests.get_mut(&ticket) {
            request.at.insert(member);
        }
        let others = !self.calls.contains(&lane) && self.others_wait(robot, lane);
        if let Some(servant) = self.servants.get_mut(&member) {
            servant.asked += 1;
            if self.calls.contains(&lane) {
                servant.calls += 1;
                return;
            }
            let goals = servant.goals.entry(lane).or_insert(Goals {
                robot,
                count: 0,
                ahead: 0,
            });
            // The first one was its turn.
            goals.ahead += usize::from(others && goals.count > 0);
            goals.count += 1;
        }
    }
}

#[cfg(test)]
mod tests;
