//! Dispatcher of a group: sends each request to the servant with the fewest requests in progress. Pure logic: its
//! inputs are requests, outcomes and changes of servants; its outputs are orders.
//!
//! ```text
//!            no servant has a free place        every servant that had it was lost
//!               ┌───────────────┐         ┌───────────────(idempotent)──────────────┐
//!  requested ──▶ waiting ────────▶ in progress at 1 … `replicas` servants ──▶ answered, once
//!                                         └──────▶ failed, with the reason
//! ```
//!
//! - A servant has at most [`Rules::window`] calls in progress. The others wait here, so that they are not lost with a
//!   servant and can go to servants that are added meanwhile. Waiting robots take turns: one with a thousand calls
//!   delays nobody, and neither does one that calls a service which no servant provides at the moment.
//! - A servant executes goals of an action for one robot at a time, because most action servers handle one goal and
//!   preempt it for the next: another robot's goal would end this robot's. Further goals of the robot go to the same
//!   servant, so that the node treats them as if it belonged to this robot alone. While others wait for the action, at
//!   most [`AHEAD`] further goals do so, because a robot that sends a new goal each second would otherwise keep the
//!   servant forever; later ones wait for their turn.
//! - A request that a lost servant had may have been executed. It is retried if the service is idempotent, at most
//!   [`ATTEMPTS`] times in total (it may be the cause of the crashes), and fails otherwise. A request that a servant
//!   did not take waits for its next turn.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use ros::turns::RoundRobin;

/// Number of servants that may be lost with a request before it fails.
pub const ATTEMPTS: usize = 3;
/// Number of further goals of a robot that has a servant which may precede those of waiting robots.
pub const AHEAD: usize = 8;

/// Id of a request.
pub type Ticket = u64;
/// Id of a servant of the group.
pub type Member = u64;
/// Id of a robot of the group.
pub type RobotNumber = u64;

/// Kind of a request.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// A call of the service of this name.
    Call(Arc<str>),
    /// A goal for the action of this name.
    Goal(Arc<str>),
}

/// Rules set by the deployer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rules {
    /// Maximum number of calls in progress per servant; 0 counts as 1.
    pub window: usize,
    /// Maximum number of servants that work on the same call; 0 counts as 1.
    pub replicas: usize,
    /// A request may be executed twice.
    pub idempotent: bool,
}

/// An order for the owner of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DispatchOrder {
    /// Send the request to this servant.
    Ask(Ticket, Member),
    /// Ignore the response of this servant.
    Drop(Ticket, Member),
    /// Fail the request, because its servant was lost.
    Fail(Ticket, LossReason),
}

/// Reason why a request fails.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LossReason {
    /// The service is not idempotent.
    NotAskedAgain,
    /// The maximum number of attempts was reached.
    AskedOften,
}

/// Outcome of a servant's work on a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AttemptOutcome {
    /// The servant has answered, possibly with an error.
    Answered,
    /// The servant did not take the request, which was certainly not executed.
    NotTaken,
    /// The servant is gone, and the request may have been executed.
    Lost,
}

/// Load of a group.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct GroupLoad {
    /// Requests waiting for a servant.
    pub waiting: usize,
    /// Requests in progress at at least one servant.
    pub under_way: usize,
}

/// Number of a service or action.
type Lane = u32;

#[derive(Debug)]
struct QueuedRequest {
    robot: RobotNumber,
    lane: Lane,
    /// Servants that work on it.
    at: BTreeSet<Member>,
    /// Number of servants lost with it.
    lost: usize,
}

#[derive(Debug, Default)]
struct ServantState {
    calls: usize,
    /// Actions whose goals it executes.
    goals: BTreeMap<Lane, ServantGoals>,
    /// It gets no more requests.
    retired: bool,
    /// Services and actions that it currently does not provide.
    paused: BTreeSet<Lane>,
    /// Number of requests ever sent to it.
    asked: u64,
}

/// Goals of one action at a servant.
#[derive(Debug)]
struct ServantGoals {
    robot: RobotNumber,
    count: usize,
    /// Number of goals started while others waited.
    ahead: usize,
}

impl ServantState {
    /// Returns whether it can get requests of this kind.
    fn is_available(&self, lane: Lane) -> bool {
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
    /// Numbers of services.
    calls: BTreeSet<Lane>,
    servants: BTreeMap<Member, ServantState>,
    requests: BTreeMap<Ticket, QueuedRequest>,
    waiting: BTreeMap<(RobotNumber, Lane), VecDeque<Ticket>>,
    turns: RoundRobin<(RobotNumber, Lane)>,
}

impl Dispatcher {
    /// Creates a dispatcher without servants and requests.
    pub fn new(rules: Rules) -> Dispatcher {
        Dispatcher {
            rules: Rules {
                window: rules.window.max(1),
                replicas: rules.replicas.max(1),
                // Replicas execute a call more than once, so it must be idempotent.
                idempotent: rules.idempotent || rules.replicas > 1,
            },
            tickets: 0,
            lanes: BTreeMap::new(),
            calls: BTreeSet::new(),
            servants: BTreeMap::new(),
            requests: BTreeMap::new(),
            waiting: BTreeMap::new(),
            turns: RoundRobin::default(),
        }
    }

    /// Adds a servant.
    pub fn join(&mut self, member: Member) -> Vec<DispatchOrder> {
        self.servants.entry(member).or_default();
        self.dispatch_waiting()
    }

    /// Sends no further requests to a servant, which finishes what it is working on.
    pub fn retire(&mut self, member: Member) -> Vec<DispatchOrder> {
        if let Some(servant) = self.servants.get_mut(&member) {
            servant.retired = true;
        }
        // A call waiting for this servant as well now has as many servants as there are.
        self.dispatch_waiting()
    }

    /// Sends requests to a retired servant again.
    pub fn reinstate(&mut self, member: Member) -> Vec<DispatchOrder> {
        if let Some(servant) = self.servants.get_mut(&member) {
            servant.retired = false;
        }
        self.dispatch_waiting()
    }

    /// Sends requests of this kind to a servant again that did not take one or lost it.
    pub fn resume(&mut self, member: Member, kind: &Kind) -> Vec<DispatchOrder> {
        let lane = self.lanes.get(kind);
        if let (Some(servant), Some(lane)) = (self.servants.get_mut(&member), lane) {
            servant.paused.remove(lane);
        }
        self.dispatch_waiting()
    }

    fn lane_for(&mut self, kind: &Kind) -> Lane {
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

    /// Removes a servant together with its work.
    pub fn leave(&mut self, member: Member) -> Vec<DispatchOrder> {
        self.servants.remove(&member);
        let had = self.requests.iter();
        let had: Vec<Ticket> =
            had.filter(|(_, request)| request.at.contains(&member)).map(|(ticket, _)| *ticket).collect();
        let mut orders = Vec::new();
        for ticket in had.into_iter().rev() {
            orders.push(DispatchOrder::Drop(ticket, member));
            self.record_loss(ticket, member, &mut orders);
        }
        orders.extend(self.dispatch_waiting());
        orders
    }

    /// Queues a request of a robot.
    pub fn ask(&mut self, robot: RobotNumber, kind: &Kind) -> (Ticket, Vec<DispatchOrder>) {
        self.tickets += 1;
        let ticket = self.tickets;
        let lane = self.lane_for(kind);
        let request = QueuedRequest { robot, lane, at: BTreeSet::new(), lost: 0 };
        self.requests.insert(ticket, request);
        let queue = self.waiting.entry((robot, lane)).or_default();
        queue.push_back(ticket);
        self.turns.enqueue((robot, lane));
        (ticket, self.dispatch_waiting())
    }

    /// Handles the outcome of a servant's work on a request. Returns whether it is the response, and the resulting
    /// orders.
    pub fn finish_attempt(
        &mut self,
        ticket: Ticket,
        member: Member,
        end: AttemptOutcome,
    ) -> (bool, Vec<DispatchOrder>) {
        let known = self.requests.get(&ticket);
        let Some(request) = known.filter(|request| request.at.contains(&member)) else {
            return (false, Vec::new());
        };
        let lane = request.lane;
        let mut orders = Vec::new();
        match end {
            AttemptOutcome::Answered => {
                let mut others = self.remove(ticket);
                others.remove(&member);
                orders.extend(others.into_iter().map(|other| DispatchOrder::Drop(ticket, other)));
            }
            AttemptOutcome::NotTaken => {
                self.pause(member, lane);
                self.release(ticket, member);
                self.requeue_or_fail(ticket, &mut orders);
            }
            AttemptOutcome::Lost => {
                self.pause(member, lane);
                self.record_loss(ticket, member, &mut orders);
            }
        }
        orders.extend(self.dispatch_waiting());
        (end == AttemptOutcome::Answered, orders)
    }

    /// Pauses a servant for a kind of requests. One that ends requests without executing them has the fewest in
    /// progress and would otherwise get, and lose, all following ones until its failure is known.
    fn pause(&mut self, member: Member, lane: Lane) {
        if let Some(servant) = self.servants.get_mut(&member) {
            servant.paused.insert(lane);
        }
    }

    /// Withdraws a request for whose response nobody waits any more.
    pub fn withdraw(&mut self, ticket: Ticket) -> Vec<DispatchOrder> {
        let at = self.remove(ticket).into_iter();
        let mut orders: Vec<DispatchOrder> = at.map(|member| DispatchOrder::Drop(ticket, member)).collect();
        orders.extend(self.dispatch_waiting());
        orders
    }

    /// Returns the current load.
    pub fn load(&self) -> GroupLoad {
        let waiting = self.waiting.values().map(VecDeque::len).sum();
        GroupLoad { waiting, under_way: self.requests.len() - waiting }
    }

    /// Returns the number of requests a servant is working on.
    pub fn member_load(&self, member: Member) -> usize {
        self.servants.get(&member).map_or(0, ServantState::load)
    }

    /// Removes a request; returns the servants that worked on it.
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

    /// Removes a servant from a request.
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

    /// Handles the loss of a servant that worked on a request.
    fn record_loss(&mut self, ticket: Ticket, member: Member, orders: &mut Vec<DispatchOrder>) {
        self.release(ticket, member);
        if let Some(request) = self.requests.get_mut(&ticket) {
            request.lost += 1;
        }
        self.requeue_or_fail(ticket, orders);
    }

    /// Queues a request on which nobody works any more in front of its robot's others, or fails it.
    fn requeue_or_fail(&mut self, ticket: Ticket, orders: &mut Vec<DispatchOrder>) {
        let Some(request) = self.requests.get(&ticket) else {
            return;
        };
        if !request.at.is_empty() {
            return;
        }
        let why = match request.lost {
            0 => None,
            _ if !self.rules.idempotent => Some(LossReason::NotAskedAgain),
            lost => (lost >= ATTEMPTS).then_some(LossReason::AskedOften),
        };
        if let Some(why) = why {
            self.requests.remove(&ticket);
            orders.push(DispatchOrder::Fail(ticket, why));
            return;
        }
        let key = (request.robot, request.lane);
        self.waiting.entry(key).or_default().push_front(ticket);
        self.turns.enqueue(key);
    }

    /// Removes a request from its queue.
    fn unqueue(&mut self, ticket: Ticket) {
        let Some(request) = self.requests.get(&ticket) else {
            return;
        };
        let key = (request.robot, request.lane);
        if let Some(queue) = self.waiting.get_mut(&key) {
            queue.retain(|other| *other != ticket);
            if queue.is_empty() {
                self.waiting.remove(&key);
                self.turns.withdraw(key);
            }
        }
    }

    /// Returns the servants that can get this robot's next request of a kind, the best first; empty if there are too
    /// few.
    fn pick_servants(&self, robot: RobotNumber, lane: Lane) -> Vec<Member> {
        let mut open: Vec<(Member, &ServantState)> = self
            .servants
            .iter()
            .filter(|(_, servant)| servant.is_available(lane))
            .map(|(member, servant)| (*member, servant))
            .collect();
        let is_call = self.calls.contains(&lane);
        let wanted = if is_call { self.rules.replicas.min(open.len()) } else { 1 };
        if is_call {
            open.retain(|(_, servant)| servant.calls < self.rules.window);
        } else {
            let of = |servant: &ServantState| servant.goals.get(&lane).map(|goals| (goals.robot, goals.ahead));
            let own = open.iter().find_map(|(member, servant)| {
                let (has, ahead) = of(servant)?;
                (has == robot).then_some((*member, ahead))
            });
            match own {
                Some((member, ahead)) if ahead < AHEAD || !self.has_waiting_others(robot, lane) => {
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

    /// Returns whether another robot without a servant waits for the same action.
    fn has_waiting_others(&self, robot: RobotNumber, lane: Lane) -> bool {
        let mut waiting = self.waiting.keys();
        waiting.any(|(other, of)| *of == lane && *other != robot && !self.has_servant(*other, lane))
    }

    fn has_servant(&self, robot: RobotNumber, lane: Lane) -> bool {
        let mut open = self.servants.values().filter(|servant| servant.is_available(lane));
        open.any(|servant| servant.goals.get(&lane).is_some_and(|of| of.robot == robot))
    }

    /// Sends waiting requests to servants as far as possible.
    fn dispatch_waiting(&mut self) -> Vec<DispatchOrder> {
        let mut orders = Vec::new();
        let mut turns = std::mem::take(&mut self.turns);
        while let Some(key) = turns.take(|(robot, lane)| !self.pick_servants(*robot, *lane).is_empty()) {
            let places = self.pick_servants(key.0, key.1);
            let queue = self.waiting.get_mut(&key);
            let Some(ticket) = queue.and_then(VecDeque::pop_front) else {
                continue;
            };
            if self.waiting.get(&key).is_some_and(VecDeque::is_empty) {
                self.waiting.remove(&key);
                turns.withdraw(key);
            } else {
                turns.enqueue(key);
            }
            for member in places {
                self.start_attempt(ticket, key, member);
                orders.push(DispatchOrder::Ask(ticket, member));
            }
        }
        self.turns = turns;
        orders
    }

    fn start_attempt(&mut self, ticket: Ticket, (robot, lane): (RobotNumber, Lane), member: Member) {
        if let Some(request) = self.requests.get_mut(&ticket) {
            request.at.insert(member);
        }
        let others = !self.calls.contains(&lane) && self.has_waiting_others(robot, lane);
        if let Some(servant) = self.servants.get_mut(&member) {
            servant.asked += 1;
            if self.calls.contains(&lane) {
                servant.calls += 1;
                return;
            }
            let goals = servant.goals.entry(lane).or_insert(ServantGoals { robot, count: 0, ahead: 0 });
            // The first goal was its regular turn.
            goals.ahead += usize::from(others && goals.count > 0);
            goals.count += 1;
        }
    }
}

#[cfg(test)]
mod tests;
