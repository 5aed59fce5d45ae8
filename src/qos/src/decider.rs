//! Decides when the local original is started, fed, no longer fed, and stopped.

use serde::{Deserialize, Serialize};

use crate::satisfaction::Satisfaction;
use crate::sla::{LocalPolicy, Mode, QosSla, WarmStart};

/// State of the local original's process, as reported by whoever runs it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LocalState {
    /// The package is not installed on the robot.
    Missing,
    /// The process does not run.
    Stopped,
    /// The process was started and is not ready yet; also after a crash, until it is up again.
    Starting,
    /// The process accepts requests.
    Ready,
}

/// Reason for a decision.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DecisionReason {
    /// Q fell below the threshold, or rose above it.
    Satisfaction {
        /// Q at the time of the decision.
        q: f64,
    },
    /// The link is down, and the service is stateful or has no response-time goal: the local original takes over.
    LinkDown,
    /// The link is up again, in the same cases: the local original hands back.
    LinkUp,
    /// The SLA keeps the process warm.
    Warm,
    /// The SLA keeps the process warm from the first late request on.
    FirstSign,
    /// The process ended unexpectedly.
    Crash,
}

/// A decision about the local original; it is carried out by whoever runs the process and reported to the user.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum QosEvent {
    /// Start the process.
    Start(DecisionReason),
    /// Send it the requests as well.
    Feed(DecisionReason),
    /// Send it no more requests.
    StopFeeding(DecisionReason),
    /// Stop the process.
    Stop(DecisionReason),
    /// The local original is not installed, so the cloud answers alone; reported once.
    SaidOnceMissing,
    /// The process ended unexpectedly and is restarted after a pause.
    Crashed(String),
    /// Outputs of the pair with this input never carry the input's stamp: from now on the next output counts as the
    /// answer.
    Uncorrelated(String),
}

/// Decides about the local original as the SLA says. It returns the commands and performs no I/O.
#[derive(Debug, Clone)]
pub struct Decider {
    /// The state of the link decides instead of Q.
    by_link: bool,
    local: LocalPolicy,
    warm: WarmStart,
    state: LocalState,
    /// Latest result of the algorithm: the local original is to answer requests.
    wanted: bool,
    /// The local original is wanted because the cloud was never reached, whatever Q is.
    alone: bool,
    /// A request was late, and Q has not been full since.
    sign: bool,
    fed: bool,
}

impl Decider {
    /// Creates a decider for a process that does not run yet.
    pub fn new(sla: &QosSla) -> Self {
        Self {
            by_link: sla.mode == Mode::Stateful || sla.is_link_based(),
            local: sla.local,
            warm: sla.warm,
            state: LocalState::Stopped,
            wanted: false,
            alone: false,
            sign: false,
            fed: false,
        }
    }

    /// Returns true if requests are sent to the local original.
    pub fn is_fed(&self) -> bool {
        self.fed
    }

    /// Returns true if the local original is wanted and will answer once it is ready.
    pub fn is_coming(&self) -> bool {
        let alive = matches!(self.state, LocalState::Starting | LocalState::Ready);
        self.wanted && alive && self.local != LocalPolicy::None
    }

    /// Returns the state of the process, as last reported or last ordered.
    pub fn state(&self) -> LocalState {
        self.state
    }

    /// Records that a request was late.
    pub fn note_late(&mut self) {
        self.sign = true;
    }

    /// Clears the sign of a late request.
    pub fn clear_sign(&mut self) {
        self.sign = false;
    }

    /// Records a new state of the process and returns the decisions that follow.
    pub fn on_state_change(&mut self, state: LocalState) -> Vec<QosEvent> {
        let before = std::mem::replace(&mut self.state, state);
        let mut events = Vec::new();
        if self.fed && state != LocalState::Ready {
            self.fed = false;
            events.push(QosEvent::StopFeeding(DecisionReason::Crash));
        }
        if state == LocalState::Missing && before != state && self.local != LocalPolicy::None {
            events.push(QosEvent::SaidOnceMissing);
        }
        events
    }

    /// Returns the decisions that follow from Q and the link. `link` is false if the link has been down for too long;
    /// where Q decides, that applies only to a link that was never up.
    pub fn decide(&mut self, satisfaction: &Satisfaction, link: bool) -> Vec<QosEvent> {
        let mut events = Vec::new();
        if self.local == LocalPolicy::None || self.state == LocalState::Missing {
            return events;
        }
        if satisfaction.is_full() {
            self.sign = false;
        }
        let why = if self.by_link {
            self.wanted = !link;
            if link { DecisionReason::LinkUp } else { DecisionReason::LinkDown }
        } else if !link {
            self.wanted = true;
            self.alone = true;
            DecisionReason::LinkDown
        } else if std::mem::take(&mut self.alone) {
            self.wanted = satisfaction.wants_local();
            DecisionReason::LinkUp
        } else {
            if satisfaction.wants_local() {
                self.wanted = true;
            } else if satisfaction.wants_cloud_alone() {
                self.wanted = false;
            }
            DecisionReason::Satisfaction { q: satisfaction.q() }
        };
        let kept = match (self.local, self.warm) {
            (LocalPolicy::Warm, WarmStart::AtOnce) => Some(DecisionReason::Warm),
            (LocalPolicy::Warm, WarmStart::FirstSign) if self.sign => Some(DecisionReason::FirstSign),
            _ => None,
        };
        let running = matches!(self.state, LocalState::Starting | LocalState::Ready);
        if !self.wanted && self.fed {
            self.fed = false;
            events.push(QosEvent::StopFeeding(why));
        }
        if !self.wanted && kept.is_none() && running {
            self.state = LocalState::Stopped;
            events.push(QosEvent::Stop(why));
        }
        if (self.wanted || kept.is_some()) && !running {
            self.state = LocalState::Starting;
            let why = if self.wanted { why } else { kept.unwrap_or(why) };
            events.push(QosEvent::Start(why));
        }
        if self.wanted && !self.fed && self.state == LocalState::Ready {
            self.fed = true;
            events.push(QosEvent::Feed(why));
        }
        events
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    fn decider(more: &str) -> Decider {
        let text = format!("t_desire = 0.1\nt_max = 0.3\n{more}");
        Decider::new(&QosSla::parse(toml::Deserializer::parse(&text).unwrap()).unwrap())
    }

    fn observe_ms(satisfaction: &mut Satisfaction, ms: Option<u64>) -> Satisfaction {
        let (desire, max) = (Duration::from_millis(100), Duration::from_millis(300));
        satisfaction.observe(ms.map(Duration::from_millis), desire, max);
        satisfaction.clone()
    }

    fn names(events: &[QosEvent]) -> Vec<&'static str> {
        let name = |event: &QosEvent| match event {
            QosEvent::Start(_) => "start",
            QosEvent::Feed(_) => "feed",
            QosEvent::StopFeeding(_) => "stop feeding",
            QosEvent::Stop(_) => "stop",
            QosEvent::SaidOnceMissing => "missing",
            QosEvent::Crashed(_) => "crashed",
            QosEvent::Uncorrelated(_) => "uncorrelated",
        };
        events.iter().map(name).collect()
    }

    #[test]
    fn cold_is_started_fed_and_stopped() {
        let mut decider = decider("local = 'cold'");
        let mut q = Satisfaction::new(4.0, 4.0, 16.0);
        assert!(decider.decide(&q, true).is_empty(), "at the threshold nothing changes");
        observe_ms(&mut q, None);
        assert_eq!(names(&decider.decide(&q, true)), ["start"]);
        assert!(decider.decide(&q, true).is_empty(), "it is started once");
        decider.on_state_change(LocalState::Ready);
        assert_eq!(names(&decider.decide(&q, true)), ["feed"]);
        observe_ms(&mut q, Some(1));
        assert_eq!(q.q(), 4.0);
        assert!(decider.decide(&q, true).is_empty());
        assert!(decider.is_fed());
        observe_ms(&mut q, Some(1));
        assert_eq!(names(&decider.decide(&q, true)), ["stop feeding", "stop"]);
    }

    #[test]
    fn warm_runs_at_once_and_is_only_fed() {
        let mut decider = decider("local = 'warm'");
        let mut q = Satisfaction::new(5.0, 4.0, 16.0);
        assert_eq!(decider.decide(&q, true), [QosEvent::Start(DecisionReason::Warm)]);
        decider.on_state_change(LocalState::Ready);
        assert!(decider.decide(&q, true).is_empty());
        observe_ms(&mut q, None);
        assert_eq!(names(&decider.decide(&q, true)), ["feed"]);
        observe_ms(&mut q, Some(1));
        observe_ms(&mut q, Some(1));
        assert_eq!(names(&decider.decide(&q, true)), ["stop feeding"]);
    }

    #[test]
    fn warm_may_wait_for_the_first_sign() {
        let mut decider = decider("local = 'warm'\nwarm = 'first-sign'");
        let mut q = Satisfaction::new(15.0, 4.0, 16.0);
        assert!(decider.decide(&q, true).is_empty());
        observe_ms(&mut q, None);
        decider.note_late();
        assert_eq!(decider.decide(&q, true), [QosEvent::Start(DecisionReason::FirstSign)]);
        decider.on_state_change(LocalState::Ready);
        for _ in 0..4 {
            observe_ms(&mut q, Some(1));
            assert!(decider.decide(&q, true).is_empty(), "Q {}", q.q());
        }
        observe_ms(&mut q, Some(1));
        assert!(q.is_full());
        assert_eq!(names(&decider.decide(&q, true)), ["stop"]);
    }

    #[test]
    fn stateful_takes_over_only_while_the_link_is_down() {
        let mut decider = decider("mode = 'stateful'\nlocal = 'warm'");
        let mut q = Satisfaction::new(5.0, 4.0, 16.0);
        assert_eq!(names(&decider.decide(&q, true)), ["start"]);
        decider.on_state_change(LocalState::Ready);
        for _ in 0..5 {
            observe_ms(&mut q, None);
            assert!(decider.decide(&q, true).is_empty(), "slow is not down");
        }
        assert_eq!(decider.decide(&q, false), [QosEvent::Feed(DecisionReason::LinkDown)]);
        assert_eq!(decider.decide(&q, true), [QosEvent::StopFeeding(DecisionReason::LinkUp)]);
    }

    #[test]
    fn a_cloud_that_was_never_reached_is_stood_in_for_whatever_q_is() {
        let mut decider = decider("local = 'cold'");
        let mut q = Satisfaction::new(8.0, 4.0, 16.0);
        assert_eq!(decider.decide(&q, false), [QosEvent::Start(DecisionReason::LinkDown)]);
        decider.on_state_change(LocalState::Ready);
        assert_eq!(decider.decide(&q, false), [QosEvent::Feed(DecisionReason::LinkDown)]);
        let back = [QosEvent::StopFeeding(DecisionReason::LinkUp), QosEvent::Stop(DecisionReason::LinkUp)];
        assert_eq!(decider.decide(&q, true), back);
        // If the cloud missed its goal meanwhile, the local original goes on, and Q decides.
        decider.decide(&q, false);
        decider.on_state_change(LocalState::Ready);
        decider.decide(&q, false);
        observe_ms(&mut q, None);
        observe_ms(&mut q, None);
        assert!(decider.decide(&q, true).is_empty());
        assert!(decider.is_fed());
    }

    #[test]
    fn an_absent_original_is_said_once() {
        let mut decider = decider("local = 'cold'");
        let mut q = Satisfaction::new(4.0, 4.0, 16.0);
        observe_ms(&mut q, None);
        assert_eq!(names(&decider.decide(&q, true)), ["start"]);
        assert_eq!(names(&decider.on_state_change(LocalState::Missing)), ["missing"]);
        assert!(decider.on_state_change(LocalState::Missing).is_empty());
        observe_ms(&mut q, None);
        assert!(decider.decide(&q, true).is_empty());
        assert!(!decider.is_coming());
    }

    #[test]
    fn after_a_crash_it_is_fed_again_when_ready() {
        let mut decider = decider("local = 'cold'");
        let mut q = Satisfaction::new(4.0, 4.0, 16.0);
        observe_ms(&mut q, None);
        decider.decide(&q, true);
        decider.on_state_change(LocalState::Ready);
        assert_eq!(names(&decider.decide(&q, true)), ["feed"]);
        let events = decider.on_state_change(LocalState::Starting);
        assert_eq!(events, [QosEvent::StopFeeding(DecisionReason::Crash)]);
        assert!(decider.decide(&q, true).is_empty());
        decider.on_state_change(LocalState::Ready);
        assert_eq!(names(&decider.decide(&q, true)), ["feed"]);
    }
}
