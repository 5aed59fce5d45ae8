//! When the local original is started, fed, not fed any more, and stopped.

use serde::{Deserialize, Serialize};

use crate::satisfaction::Satisfaction;
use crate::sla::{Local, Mode, Sla, Warm};

/// How the local original's process is, as whoever runs it reports.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LocalState {
    /// There is no such package on the robot.
    Missing,
    /// It does not run.
    Stopped,
    /// It was told to run and does not answer yet; also after a crash, until it is up again.
    Starting,
    /// It can be fed.
    Ready,
}

/// Why something is done.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Why {
    /// Q fell below the threshold, or rose above it.
    Satisfaction {
        /// Satisfaction when it was decided.
        q: f64,
    },
    /// Stateful, or no time promised: the link is down, the local original takes over.
    LinkDown,
    /// The same: the cloud is there again, the local original hands back.
    LinkUp,
    /// It is kept warm.
    Warm,
    /// It is kept warm from the first late request on.
    FirstSign,
    /// Its process ended by itself.
    Crash,
}

/// What is decided; each is carried out by whoever runs the local original, and told to the user.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Event {
    /// Start its process.
    Start(Why),
    /// Give it the requests, too.
    Feed(Why),
    /// Give it no more requests.
    StopFeeding(Why),
    /// End its process.
    Stop(Why),
    /// It is not there: said once, the cloud is alone from now on.
    SaidOnceMissing,
    /// Its process ended by itself; it is started again after a while.
    Crashed(String),
    /// Outputs of this input's pair never carry its stamp: from now on the next output answers.
    Uncorrelated(String),
}

/// Runs the local original as the SLA says. Its answers are the commands; it asks nobody.
#[derive(Debug, Clone)]
pub struct Decider {
    /// The link's state decides, not Q.
    by_link: bool,
    local: Local,
    warm: Warm,
    state: LocalState,
    /// The algorithm's last word: is it to answer requests.
    wanted: bool,
    /// It is wanted because the cloud was never reached, whatever Q is.
    alone: bool,
    /// The first late request has been seen, and Q was not full since.
    sign: bool,
    fed: bool,
}

impl Decider {
    /// The process does not run yet.
    pub fn new(sla: &Sla) -> Self {
        Self {
            by_link: sla.mode == Mode::Stateful || sla.is_of_link(),
            local: sla.local,
            warm: sla.warm,
            state: LocalState::Stopped,
            wanted: false,
            alone: false,
            sign: false,
            fed: false,
        }
    }

    /// Requests go to it, too.
    pub fn is_fed(&self) -> bool {
        self.fed
    }

    /// It is to answer, and will once it is ready.
    pub fn is_coming(&self) -> bool {
        let alive = matches!(self.state, LocalState::Starting | LocalState::Ready);
        self.wanted && alive && self.local != Local::None
    }

    /// Its process, as last heard or as last told.
    pub fn state(&self) -> LocalState {
        self.state
    }

    /// `late`: the last request was.
    pub fn late(&mut self) {
        self.sign = true;
    }

    /// Nothing points to trouble any more.
    pub fn calm(&mut self) {
        self.sign = false;
    }

    /// The process changed.
    pub fn reported(&mut self, state: LocalState) -> Vec<Event> {
        let before = std::mem::replace(&mut self.state, state);
        let mut events = Vec::new();
        if self.fed && state != LocalState::Ready {
            self.fed = false;
            events.push(Event::StopFeeding(Why::Crash));
        }
        if state == LocalState::Missing && before != state && self.local != Local::None {
            events.push(Event::SaidOnceMissing);
        }
        events
    }

    /// What follows from Q and the link; `link`: it has not been away for too long. Where Q decides, that is said of a
    /// link that was never there.
    pub fn decide(&mut self, satisfaction: &Satisfaction, link: bool) -> Vec<Event> {
        let mut events = Vec::new();
        if self.local == Local::None || self.state == LocalState::Missing {
            return events;
        }
        if satisfaction.is_full() {
            self.sign = false;
        }
        let why = if self.by_link {
            self.wanted = !link;
            if link { Why::LinkUp } else { Why::LinkDown }
        } else if !link {
            self.wanted = true;
            self.alone = true;
            Why::LinkDown
        } else if std::mem::take(&mut self.alone) {
            self.wanted = satisfaction.wants_local();
            Why::LinkUp
        } else {
            if satisfaction.wants_local() {
                self.wanted = true;
            } else if satisfaction.wants_cloud_alone() {
                self.wanted = false;
            }
            Why::Satisfaction {
                q: satisfaction.q(),
            }
        };
        let kept = match (self.local, self.warm) {
            (Local::Warm, Warm::AtOnce) => Some(Why::Warm),
            (Local::Warm, Warm::FirstSign) if self.sign => Some(Why::FirstSign),
            _ => None,
        };
        let running = matches!(self.state, LocalState::Starting | LocalState::Ready);
        if !self.wanted && self.fed {
            self.fed = false;
            events.push(Event::StopFeeding(why));
        }
        if !self.wanted && kept.is_none() && running {
            self.state = LocalState::Stopped;
            events.push(Event::Stop(why));
        }
        if (self.wanted || kept.is_some()) && !running {
            self.state = LocalState::Starting;
            let why = if self.wanted {
                why
            } else {
                kept.unwrap_or(why)
            };
            events.push(Event::Start(why));
        }
        if self.wanted && !self.fed && self.state == LocalState::Ready {
            self.fed = true;
            events.push(Event::Feed(why));
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
        Decider::new(&Sla::parse(toml::Deserializer::parse(&text).unwrap()).unwrap())
    }

    fn judged(satisfaction: &mut Satisfaction, ms: Option<u64>) -> Satisfaction {
        let (desire, max) = (Duration::from_millis(100), Duration::from_millis(300));
        satisfaction.observe(ms.map(Duration::from_millis), desire, max);
        satisfaction.clone()
    }

    fn names(events: &[Event]) -> Vec<&'static str> {
        let name = |event: &Event| match event {
            Event::Start(_) => "start",
            Event::Feed(_) => "feed",
            Event::StopFeeding(_) => "stop feeding",
            Event::Stop(_) => "stop",
            Event::SaidOnceMissing => "missing",
            Event::Crashed(_) => "crashed",
            Event::Uncorrelated(_) => "uncorrelated",
        };
        events.iter().map(name).collect()
    }

    #[test]
    fn cold_is_started_fed_and_stopped() {
        let mut decider = decider("local = 'cold'");
        let mut q = Satisfaction::new(4.0, 4.0, 16.0);
        assert!(
            decider.decide(&q, true).is_empty(),
            "at the threshold nothing changes"
        );
        judged(&mut q, None);
        assert_eq!(names(&decider.decide(&q, true)), ["start"]);
        assert!(decider.decide(&q, true).is_empty(), "it is started once");
        decider.reported(LocalState::Ready);
        assert_eq!(names(&decider.decide(&q, true)), ["feed"]);
        judged(&mut q, Some(1));
        assert_eq!(q.q(), 4.0);
        assert!(decider.decide(&q, true).is_empty());
        assert!(decider.is_fed());
        judged(&mut q, Some(1));
        assert_eq!(names(&decider.decide(&q, true)), ["stop feeding", "stop"]);
    }

    #[test]
    fn warm_runs_at_once_and_is_only_fed() {
        let mut decider = decider("local = 'warm'");
        let mut q = Satisfaction::new(5.0, 4.0, 16.0);
        assert_eq!(decider.decide(&q, true), [Event::Start(Why::Warm)]);
        decider.reported(LocalState::Ready);
        assert!(decider.decide(&q, true).is_empty());
        judged(&mut q, None);
        assert_eq!(names(&decider.decide(&q, true)), ["feed"]);
        judged(&mut q, Some(1));
        judged(&mut q, Some(1));
        assert_eq!(names(&decider.decide(&q, true)), ["stop feeding"]);
    }

    #[test]
    fn warm_may_wait_for_the_first_sign() {
        let mut decider = decider("local = 'warm'\nwarm = 'first-sign'");
        let mut q = Satisfaction::new(15.0, 4.0, 16.0);
        assert!(decider.decide(&q, true).is_empty());
        judged(&mut q, None);
        decider.late();
        assert_eq!(decider.decide(&q, true), [Event::Start(Why::FirstSign)]);
        decider.reported(LocalState::Ready);
        for _ in 0..4 {
            judged(&mut q, Some(1));
            assert!(decider.decide(&q, true).is_empty(), "Q {}", q.q());
        }
        judged(&mut q, Some(1));
        assert!(q.is_full());
        assert_eq!(names(&decider.decide(&q, true)), ["stop"]);
    }

    #[test]
    fn stateful_takes_over_only_while_the_link_is_down() {
        let mut decider = decider("mode = 'stateful'\nlocal = 'warm'");
        let mut q = Satisfaction::new(5.0, 4.0, 16.0);
        assert_eq!(names(&decider.decide(&q, true)), ["start"]);
        decider.reported(LocalState::Ready);
        for _ in 0..5 {
            judged(&mut q, None);
            assert!(decider.decide(&q, true).is_empty(), "slow is not down");
        }
        assert_eq!(decider.decide(&q, false), [Event::Feed(Why::LinkDown)]);
        assert_eq!(decider.decide(&q, true), [Event::StopFeeding(Why::LinkUp)]);
    }

    #[test]
    fn a_cloud_that_was_never_reached_is_stood_in_for_whatever_q_is() {
        let mut decider = decider("local = 'cold'");
        let mut q = Satisfaction::new(8.0, 4.0, 16.0);
        assert_eq!(decider.decide(&q, false), [Event::Start(Why::LinkDown)]);
        decider.reported(LocalState::Ready);
        assert_eq!(decider.decide(&q, false), [Event::Feed(Why::LinkDown)]);
        let back = [Event::StopFeeding(Why::LinkUp), Event::Stop(Why::LinkUp)];
        assert_eq!(decider.decide(&q, true), back);
        // Where the cloud kept no promise meanwhile it goes on, and Q decides.
        decider.decide(&q, false);
        decider.reported(LocalState::Ready);
        decider.decide(&q, false);
        judged(&mut q, None);
        judged(&mut q, None);
        assert!(decider.decide(&q, true).is_empty());
        assert!(decider.is_fed());
    }

    #[test]
    fn an_absent_original_is_said_once() {
        let mut decider = decider("local = 'cold'");
        let mut q = Satisfaction::new(4.0, 4.0, 16.0);
        judged(&mut q, None);
        assert_eq!(names(&decider.decide(&q, true)), ["start"]);
        assert_eq!(names(&decider.reported(LocalState::Missing)), ["missing"]);
        assert!(decider.reported(LocalState::Missing).is_empty());
        judged(&mut q, None);
        assert!(decider.decide(&q, true).is_empty());
        assert!(!decider.is_coming());
    }

    #[test]
    fn after_a_crash_it_is_fed_again_when_ready() {
        let mut decider = decider("local = 'cold'");
        let mut q = Satisfaction::new(4.0, 4.0, 16.0);
        judged(&mut q, None);
        decider.decide(&q, true);
        decider.reported(LocalState::Ready);
        assert_eq!(names(&decider.decide(&q, true)), ["feed"]);
        let events = decider.reported(LocalState::Starting);
        assert_eq!(events, [Event::StopFeeding(Why::Crash)]);
        assert!(decider.decide(&q, true).is_empty());
        decider.reported(LocalState::Ready);
        assert_eq!(names(&decider.decide(&q, true)), ["feed"]);
    }
}
