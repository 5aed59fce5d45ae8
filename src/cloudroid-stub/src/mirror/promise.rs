//! The mirror's side of the promise: a [`Keeper`] between the robot's messages, the link and the local original.

use std::sync::{Arc, Weak};

use anyhow::{Context, bail};
use bytes::Bytes;
use link::RobotSession;
use link::control::Graph;
use parking_lot::Mutex;
use qos::{
    Correlation, Failure, HandOver, LocalPolicy, Measure, Mode, QosEvent, QosSla, RequestId, RequestOutcome, Responder,
    SafeStop, TopicPair, WarmStart,
};
use ros::bus::{Bus, SerializedMessage};
use serde_json::json;

use super::diagnostics::Diagnostics;
use super::known_interface::KnownInterface;
use super::reports::{self, Reports};
use super::requests::RequestPattern;
use super::safe_stop::{self, SafeStopPublisher};
use super::state::Mirror;
use crate::config::{self, Config, OUTPUT_MEASURES};
use crate::local::{Application, Cloud, ExpectedInterface, Keeper, Original, OriginalSetup, PendingAnswer};

/// Returns the SLA that a configuration states. If it promises nothing, the local original runs while the link is down;
/// if it excludes a local original as well, returns `None`.
pub fn sla(config: &Config) -> anyhow::Result<Option<QosSla>> {
    let mut sla = serde_json::Map::new();
    let promised = OUTPUT_MEASURES.iter();
    let promised: Vec<_> = promised.filter_map(|one| one.promise(config)).collect();
    match promised.as_slice() {
        [] => match (config.desire, config.max) {
            (Some(desire), Some(max)) => {
                sla.insert("t_desire".into(), desire.into());
                sla.insert("t_max".into(), max.into());
            }
            _ if config.local == config::LocalMode::None => return Ok(None),
            _ => {
                let measure = json!({"link": {"after": config.fallback_after}});
                sla.insert("measure".into(), measure);
            }
        },
        [measure] if config.desire.or(config.max).is_none() => {
            sla.insert("measure".into(), measure.clone());
        }
        [_] => bail!("desire and max are about response times; remove them, or what is set of an output"),
        _ => {
            let keys = OUTPUT_MEASURES.each_ref().map(|measure| measure.key);
            bail!("{} are both given; remove one", keys.join(" and "))
        }
    }
    // JSON has no infinity.
    let cap = config.cap.filter(|cap| cap.is_finite());
    for (name, value) in [("threshold", config.threshold), ("initial", config.initial), ("cap", cap)] {
        if let Some(value) = value {
            sla.insert(name.into(), value.into());
        }
    }
    if config.has_promise() {
        let unreached = config.fallback_after.max(config.promise_timeout().unwrap_or(0.0));
        sla.insert("unreached".into(), unreached.into());
    }
    let mode = if config.stateful { Mode::Stateful } else { Mode::Stateless };
    let local = match config.local {
        config::LocalMode::Cold => LocalPolicy::Cold,
        config::LocalMode::Warm => LocalPolicy::Warm,
        config::LocalMode::FirstSign => {
            sla.insert("warm".into(), json!(WarmStart::FirstSign));
            LocalPolicy::Warm
        }
        config::LocalMode::None => LocalPolicy::None,
    };
    sla.insert("mode".into(), json!(mode));
    sla.insert("local".into(), json!(local));
    if let Some(request) = config.request.as_deref().filter(|request| *request != "auto") {
        sla.insert("answers".into(), json!([request]));
    }
    if let Some(requests) = &config.requests {
        let meaning = requests.read()?;
        if let Some(answers) = meaning.answers {
            sla.insert("answers".into(), json!(answers));
        }
        let times = meaning.times.into_iter();
        let times = times.map(|(name, (desire, max))| (name, json!({"t_desire": desire, "t_max": max}))).collect();
        sla.insert("requests".into(), serde_json::Value::Object(times));
    }
    let mut sla = QosSla::parse(serde_json::Value::Object(sla))?;
    if config.cap == Some(f64::INFINITY) {
        sla.cap = f64::INFINITY;
    }
    sla.safe_stop = config.safe_stop.as_ref().map(|stop| match stop {
        config::SafeStopConfig::Message(stop) => stop.clone(),
        // Its type becomes known when the node advertises it.
        config::SafeStopConfig::Output(topic) => {
            SafeStop { topic: topic.clone(), type_name: String::new(), message: serde_json::Map::new() }
        }
    });
    Ok(Some(sla))
}

impl Mirror {
    /// Keeps the promise of `sla` from now on, or, if it promises nothing, only prepares for a lost link, with the
    /// local original that `setting` describes. `diagnostics` shows its state. If `sla` does not define which input is
    /// answered by which output, the pairs `decided` at the push are used. `watcher` publishes a safe stop of a
    /// declared type.
    pub async fn start_promise(
        self: &Arc<Self>,
        sla: QosSla,
        setting: OriginalSetup,
        decided: Vec<RequestPattern>,
        diagnostics: Diagnostics,
        watcher: &Arc<dyn Bus>,
    ) -> anyhow::Result<()> {
        // If nothing is promised, an original that is not installed is not reported before it is needed.
        let useless = sla.local == LocalPolicy::None || (sla.is_link_based() && setting.program.is_none());
        let original = if useless {
            None
        } else {
            let interface = ExpectedInterface::default();
            let robot = self.bus.clone();
            let original = Original::new(setting, interface, robot, self.call_limit);
            Some(original.await.context("the local original")?)
        };
        let (of_link, is_timed) = (sla.is_link_based(), sla.measure == Measure::Rrt);
        let way = Arc::new(MirrorAdapter(Arc::downgrade(self)));
        let stated = sla.answers.as_ref();
        let stated = stated.map(|pairs| pairs.iter().map(RequestPattern::from_pair).collect());
        let sla_stop = sla.safe_stop.clone();
        let keeper = Keeper::start(sla, Vec::new(), original, way.clone(), way);
        let stop = match sla_stop {
            Some(stop) if !stop.type_name.is_empty() => Some(SafeStopPublisher::new(&stop, watcher).await?),
            _ => None,
        };
        let _ = self.promise.set(Promise {
            keeper: keeper.clone(),
            of_link,
            is_timed,
            requests: stated.unwrap_or(decided),
            known: Mutex::default(),
            reports: Reports::default(),
            stop,
        });
        let mirror = Arc::downgrade(self);
        tokio::spawn(super::stand_in::run_stand_in(mirror.clone(), Arc::downgrade(&keeper)));
        tokio::spawn(watch_link(mirror.clone(), keeper));
        tokio::spawn(reports::report_loop(mirror, diagnostics));
        Ok(())
    }

    /// Returns the keeper of the promise, if there is one.
    pub fn keeper(&self) -> Option<&Arc<Keeper>> {
        self.promise.get().map(|promise| &promise.keeper)
    }

    /// Handles a change of the graph, after which the topics of more requests may exist. If `settled`, what it does not
    /// list is gone.
    pub(super) async fn learn(&self, graph: &Graph, settled: bool) {
        let Some(promise) = self.promise.get() else {
            return;
        };
        let (pairs, interface) = {
            let mut known = promise.known.lock();
            let wire_type = |name: &str, md5: &str| self.wire_type(name, md5);
            known.add_graph(graph, self.bus.node(), settled, wire_type);
            let types = known.inputs.values().chain(known.outputs.values());
            promise.keeper.learn_types(types);
            let mut pairs = known.pairs(&promise.requests);
            if settled && pairs.is_empty() && promise.is_timed && known.told.insert(String::new()) {
                let lacks = match promise.requests.as_slice() {
                    [] => "the push found no request topics of this node, so only its calls and goals are timed",
                    _ => "this node has none of the request topics that the push found, so they are not timed",
                };
                tracing::warn!("{lacks}; name them with request = \"/INPUT -> /OUTPUT\" in stub.toml");
            }
            if promise.of_link {
                // A goal is executed by one side only; of all other messages, only those of the side that speaks count.
                let of_action = |pair: &TopicPair| pair.by == Some(Correlation::Goal);
                pairs.retain(of_action);
            }
            for pair in &pairs {
                if known.told.insert(pair.to_string()) {
                    tracing::info!("requests and answers: {pair}");
                }
            }
            let answered = |name: &&String| pairs.iter().any(|pair| pair.input == **name);
            let interface = ExpectedInterface {
                inputs: known.inputs.clone(),
                asked: known.asked.clone(),
                awaited: known.inputs.keys().filter(answered).cloned().collect(),
                outputs: known.outputs.keys().cloned().collect(),
                services: graph.services.iter().map(|service| service.name.clone()).collect(),
                of_others: known.of_others.keys().cloned().collect(),
            };
            (pairs, interface)
        };
        if let Err(error) = promise.keeper.learn(pairs, interface).await {
            tracing::warn!("cannot send requests to the local original: {error:#}");
        }
    }
}

/// The mirror's part of a promise.
pub struct Promise {
    keeper: Arc<Keeper>,
    /// No time is promised: only the state of the link decides.
    of_link: bool,
    /// Response times are promised.
    is_timed: bool,
    /// Inputs and the outputs that answer them.
    requests: Vec<RequestPattern>,
    known: Mutex<KnownInterface>,
    pub(super) reports: Reports,
    /// Ready to be published; `None` if the safe stop is a zero message on an output of the node.
    stop: Option<SafeStopPublisher>,
}

impl Promise {
    /// Returns the keeper of the promise.
    pub fn keeper(&self) -> &Arc<Keeper> {
        &self.keeper
    }
}

/// Reports the state of the link to the keeper, across sessions.
async fn watch_link(mirror: Weak<Mirror>, keeper: Arc<Keeper>) {
    // The session that was up last; if it comes up again, its pending requests are still answered.
    let mut before: Weak<RobotSession> = Weak::new();
    let Some(mut sessions) = mirror.upgrade().map(|mirror| mirror.sessions()) else {
        return;
    };
    drop(mirror);
    loop {
        let session = sessions.borrow_and_update().clone();
        let mut up = session.watch_up();
        let this = Arc::downgrade(&session);
        drop(session);
        if *up.borrow_and_update() {
            keeper.link_up(Weak::ptr_eq(&before, &this));
            before = this;
        } else {
            keeper.link_down();
        }
        // A replaced session may stay alive for pending answers.
        tokio::select! {
            _ = up.changed() => {}
            replaced = sessions.changed() => if replaced.is_err() { return },
        }
    }
}

/// Implements [`Cloud`] and [`Application`] for a keeper.
struct MirrorAdapter(Weak<Mirror>);

impl Cloud for MirrorAdapter {
    fn publish(&self, topic: &str, message: &SerializedMessage) {
        if let Some(mirror) = self.0.upgrade() {
            mirror.inputs.send(&mirror, topic, message);
        }
    }

    fn call(&self, request: RequestId, service: &str, bytes: Bytes) {
        if let Some(mirror) = self.0.upgrade() {
            mirror.calls.call_for_keeper(&mirror, request, service, bytes);
        }
    }

    fn call_unmeasured(&self, service: &str, bytes: Bytes) -> PendingAnswer {
        match self.0.upgrade() {
            Some(mirror) => mirror.calls.call_unmeasured(&mirror, service, bytes),
            None => Box::pin(async {
                let ending = "the node is ending".to_owned();
                Err(Failure::Unreachable(ending))
            }),
        }
    }
}

impl Application for MirrorAdapter {
    fn deliver(&self, topic: &str, message: SerializedMessage) {
        if let Some(mirror) = self.0.upgrade() {
            mirror.outputs.publish_local(topic, message, true);
        }
    }

    fn on_latched_output(&self, topic: &str, message: SerializedMessage) {
        if let Some(mirror) = self.0.upgrade() {
            mirror.outputs.publish_local(topic, message, false);
        }
    }

    fn safe_stop(&self, stop: &SafeStop) {
        let Some(mirror) = self.0.upgrade() else {
            return;
        };
        let ready = mirror.promise.get().and_then(|promise| promise.stop.as_ref());
        if let Some(ready) = ready {
            tracing::warn!("no answer in time: safe stop on {}", stop.topic);
            return ready.publish();
        }
        match mirror.outputs.wire_type(&stop.topic).map(|of| safe_stop::zero_message(&of)) {
            Some(Ok(bytes)) => {
                tracing::warn!("no answer in time: safe stop on {}", stop.topic);
                mirror.outputs.publish(&stop.topic, bytes);
            }
            Some(Err(error)) => tracing::error!("no safe stop on {}: {error}", stop.topic),
            None => tracing::error!("no safe stop: {} is not an output of this node", stop.topic),
        }
    }

    fn on_outcome(&self, outcome: &RequestOutcome) {
        if let Some(promise) = self.0.upgrade().as_ref().and_then(|mirror| mirror.promise.get()) {
            promise.reports.record_outcome(outcome);
        }
    }

    fn on_hand_over(&self, over: &HandOver) {
        tracing::warn!("{over}");
        let mirror = self.0.upgrade();
        if let Some(promise) = mirror.as_ref().and_then(|mirror| mirror.promise.get()) {
            promise.reports.record_hand_over(over);
        }
    }

    fn on_missed_requests(&self, over: &HandOver) {
        tracing::info!(
            "{over}: a mode or priority that was changed there is not changed here; if it is needed, set it again"
        );
    }

    fn on_decision(&self, event: &QosEvent) {
        let mirror = self.0.upgrade();
        if let Some(promise) = mirror.as_ref().and_then(|mirror| mirror.promise.get()) {
            promise.reports.record_decision(event);
        }
        if let Some(mirror) = &mirror {
            match event {
                QosEvent::Feed(_) => mirror.outputs.set_active_side(Responder::Local),
                QosEvent::StopFeeding(_) => mirror.outputs.set_active_side(Responder::Cloud),
                QosEvent::Stop(_) | QosEvent::Crashed(_) => mirror.outputs.on_local_ended(),
                _ => {}
            }
        }
        match event {
            QosEvent::Start(why) => tracing::info!(?why, "the local original is started"),
            QosEvent::Feed(why) => tracing::warn!(?why, "the local original answers, too"),
            QosEvent::StopFeeding(why) => tracing::info!(?why, "the cloud answers alone"),
            QosEvent::Stop(why) => tracing::info!(?why, "the local original is stopped"),
            QosEvent::SaidOnceMissing => {
                tracing::warn!("there is no local original: only the cloud answers")
            }
            QosEvent::Crashed(reason) => tracing::warn!("the local original ended: {reason}"),
            QosEvent::Uncorrelated(input) => {
                tracing::warn!("no output carries the stamps of {input}: the next output counts as the answer");
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use qos::Measure;

    fn parse_sla(lines: &str) -> anyhow::Result<Option<QosSla>> {
        let file = format!("server = 'ws://here'\nservice = 's'\n{lines}");
        sla(&toml::from_str(&file)?)
    }

    #[test]
    fn a_promise_is_about_times_or_frames_or_age() {
        assert_eq!(parse_sla("local = 'none'").unwrap(), None);
        let nothing = parse_sla("").unwrap().unwrap();
        let after = std::time::Duration::from_secs(3);
        assert_eq!(nothing.measure, Measure::Link { after });
        let own = parse_sla("fallback_after = 0.5\nlocal = 'warm'").unwrap().unwrap();
        let after = std::time::Duration::from_millis(500);
        assert_eq!((own.measure, own.local), (Measure::Link { after }, LocalPolicy::Warm));
        let sign = parse_sla("desire = 0.1\nmax = 0.3\nlocal = 'first-sign'").unwrap();
        let sign = sign.map(|sla| (sla.local, sla.warm));
        assert_eq!(sign, Some((LocalPolicy::Warm, WarmStart::FirstSign)));
        let times = parse_sla("desire = 0.1\nmax = 0.3\nstateful = true").unwrap().unwrap();
        assert_eq!((times.measure, times.mode), (Measure::Rrt, Mode::Stateful));
        let frames = parse_sla("frames_per_second = 4.0").unwrap().unwrap();
        assert_eq!(frames.t_max.as_millis(), 250);
        assert_eq!(frames.t_desire, frames.t_max, "as ever: kept or not");
        let band = parse_sla("frames_per_second = 4.0\ndesired_frames_per_second = 10").unwrap();
        let band = band.map(|sla| (sla.t_desire.as_millis(), sla.t_max.as_millis()));
        assert_eq!(band, Some((100, 250)));
        let age = parse_sla("age = 2.0\noutput = '/map'").unwrap().unwrap();
        let output = "/map".to_owned();
        assert_eq!(age.measure, Measure::Age { output });
        let band = parse_sla("age = 2.0\ndesired_age = 0.5").unwrap();
        let band = band.map(|sla| (sla.t_desire.as_millis(), sla.t_max.as_millis()));
        assert_eq!(band, Some((500, 2000)));
        for (lines, named) in [
            ("age = 2.0\nfps = 1", "fps"),
            ("age = 2.0\nframes_per_second = 1.0", "both"),
            ("age = 2.0\nmax = 1.0", "response times"),
            ("age = 2.0\noutput = 'map'", "slash"),
        ] {
            let error = format!("{:#}", parse_sla(lines).unwrap_err());
            assert!(error.contains(named), "{error}");
        }
    }

    #[test]
    fn requests_and_the_cap_are_as_written() {
        let lines = "desire = 0.1\nmax = 0.3\nthreshold = 2\n";
        let own = |more: &str| parse_sla(&format!("{lines}{more}")).map(Option::unwrap);
        assert_eq!(own("").unwrap().cap, 8.0);
        assert_eq!(own("cap = 5").unwrap().cap, 5.0);
        assert_eq!(own("cap = inf").unwrap().cap, f64::INFINITY);
        let low = format!("{:#}", own("cap = 2").unwrap_err());
        assert!(low.contains("cap: 2 is not above threshold (2)"), "{low}");
        let pairs = "requests = ['/a -> /b', { request = '/c -> /d', desire = 1, max = 2 }, \
                     { request = '/s', desire = 3, max = 4 }]";
        let sla = own(pairs).unwrap();
        let answers = sla.answers.as_ref().unwrap();
        let shown: Vec<String> = answers.iter().map(ToString::to_string).collect();
        assert_eq!(shown, ["/a -> /b", "/c -> /d"]);
        let max = |name: &str| sla.times(name).t_max.as_millis();
        assert_eq!((max("/a"), max("/c"), max("/s"), max("/else")), (300, 2000, 4000, 300));
        let swapped = own("requests = [{ request = '/s', desire = 4, max = 3 }]").unwrap_err();
        let swapped = format!("{swapped:#}");
        assert!(swapped.contains("requests./s.t_max"), "{swapped}");
    }

    #[test]
    fn a_safe_stop_is_an_output_or_any_message() {
        let lines = "desire = 1.0\nmax = 1.0\nsafe_stop =";
        let stop = |text: &str| {
            let sla = parse_sla(&format!("{lines} {text}")).unwrap().unwrap();
            sla.safe_stop.unwrap()
        };
        assert_eq!(stop("'/cmd_vel'").type_name, "");
        let twist = stop("{ topic = '/cmd_vel', type = 'geometry_msgs/Twist' }");
        assert_eq!(twist.type_name, "geometry_msgs/Twist");
    }
}
