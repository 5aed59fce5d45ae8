//! The mirror's side of the promise: a [`Keeper`] between the robot's messages, the link and the local original.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Weak};

use anyhow::Context;
use bytes::Bytes;
use link::Session;
use link::control::Graph;
use parking_lot::Mutex;
use qos::{Event, Local, Mode, Outcome, Pair, RequestId, SafeStop, Sla, SlaError, Topic};
use ros::bus::{Message, WireType};
use ros::schema::MessageType;

use super::Mirror;
use super::diagnostics::Diagnostics;
use super::reports::{self, Reports};
use crate::config::{self, Config};
use crate::local::{self, Application, Cloud, Keeper, Original, Setting};

/// What is known of the interface so far: lazy inputs become known later, and do not go again.
#[derive(Default)]
pub struct Known {
    inputs: BTreeMap<String, WireType>,
    outputs: BTreeMap<String, WireType>,
    told: BTreeSet<String>,
}

/// The SLA that a configuration states; none where it states no times.
pub fn sla(config: &Config) -> Result<Option<Sla>, SlaError> {
    let mut sla = serde_json::Map::new();
    let (Some(desire), Some(max)) = (config.desire, config.max) else {
        return Ok(None);
    };
    sla.insert("t_desire".into(), desire.into());
    sla.insert("t_max".into(), max.into());
    for (name, value) in [("threshold", config.threshold), ("initial", config.initial)] {
        if let Some(value) = value {
            sla.insert(name.into(), value.into());
        }
    }
    let mode = if config.stateful {
        Mode::Stateful
    } else {
        Mode::Stateless
    };
    let local = match config.local {
        config::Local::Cold => Local::Cold,
        config::Local::Warm => Local::Warm,
        config::Local::None => Local::None,
    };
    sla.insert("mode".into(), serde_json::json!(mode));
    sla.insert("local".into(), serde_json::json!(local));
    if let Some(request) = config
        .request
        .as_deref()
        .filter(|request| *request != "auto")
    {
        sla.insert("answers".into(), serde_json::json!([request]));
    }
    let mut sla = Sla::parse(serde_json::Value::Object(sla))?;
    // Its type is known once the node has advertised it.
    sla.safe_stop = config.safe_stop.as_ref().map(|topic| SafeStop {
        topic: topic.clone(),
        type_name: String::new(),
        message: serde_json::Map::new(),
    });
    Ok(Some(sla))
}

impl Mirror {
    /// Keeps the promise of `sla` from now on, with the local original that `setting` tells of; how it stands is
    /// shown by `diagnostics`.
    pub async fn promise(
        self: &Arc<Self>,
        sla: Sla,
        setting: Setting,
        diagnostics: Diagnostics,
    ) -> anyhow::Result<()> {
        let original = match sla.local {
            Local::None => None,
            _ => {
                let original =
                    Original::new(setting, BTreeMap::new(), Vec::new(), self.bus.clone());
                Some(original.await.context("the local original")?)
            }
        };
        let way = Arc::new(Way(Arc::downgrade(self)));
        let answers = sla.answers.clone();
        let keeper = Keeper::start(sla, Vec::new(), original, way.clone(), way);
        let _ = self.promise.set(Promise {
            keeper: keeper.clone(),
            answers,
            known: Mutex::default(),
            reports: Reports::default(),
        });
        let mirror = Arc::downgrade(self);
        tokio::spawn(follow(mirror.clone(), keeper));
        tokio::spawn(reports::tell(mirror, diagnostics));
        Ok(())
    }

    /// Who keeps the promise, where there is one.
    pub fn keeper(&self) -> Option<&Arc<Keeper>> {
        self.promise.get().map(|promise| &promise.keeper)
    }

    /// The graph has changed: there may be more to pair.
    pub(super) async fn learn(&self, graph: &Graph) {
        let Some(promise) = self.promise.get() else {
            return;
        };
        let (pairs, inputs, outputs) = {
            let mut known = promise.known.lock();
            let types = self.types.lock();
            let wire_type = |name: &str, md5: &str| {
                let known = types.get(&(name.to_owned(), md5.to_owned())).cloned();
                known.unwrap_or(WireType {
                    name: name.to_owned(),
                    md5: md5.to_owned(),
                    definition: String::new(),
                })
            };
            for input in graph
                .inputs
                .iter()
                .filter(|input| input.feed && input.type_name != "*")
            {
                let found = wire_type(&input.type_name, &input.md5);
                known.inputs.insert(input.topic.clone(), found);
            }
            for output in &graph.outputs {
                let found = wire_type(&output.type_name, &output.md5);
                known.outputs.insert(output.topic.clone(), found);
            }
            let found = match qos::find(
                &topics(&known.inputs),
                &topics(&known.outputs),
                promise.answers.as_deref(),
            ) {
                Ok(found) => found,
                Err(reason) => {
                    // The rest of the interface may not be known yet.
                    tracing::debug!(reason, "no requests yet");
                    qos::Found::default()
                }
            };
            for pair in &found.pairs {
                if known.told.insert(pair.to_string()) {
                    tracing::info!("requests and answers: {pair}");
                }
            }
            let inputs = known.inputs.iter();
            let inputs: BTreeMap<_, _> = inputs
                .filter(|(name, _)| found.pairs.iter().any(|pair: &Pair| pair.input == **name))
                .map(|(name, wire_type)| (name.clone(), wire_type.clone()))
                .collect();
            let outputs: Vec<String> = known.outputs.keys().cloned().collect();
            (found.pairs, inputs, outputs)
        };
        if let Err(error) = promise.keeper.learn(pairs, inputs, outputs).await {
            tracing::warn!("the local original cannot be fed: {error:#}");
        }
    }
}

/// What a mirror holds of it.
pub struct Promise {
    keeper: Arc<Keeper>,
    answers: Option<Vec<Pair>>,
    known: Mutex<Known>,
    pub(super) reports: Reports,
}

impl Promise {
    /// Who keeps it.
    pub fn keeper(&self) -> &Arc<Keeper> {
        &self.keeper
    }
}

fn topics(known: &BTreeMap<String, WireType>) -> Vec<Topic> {
    let topic = |(name, wire_type): (&String, &WireType)| Topic {
        name: name.clone(),
        type_name: wire_type.name.clone(),
        stamped: local::is_stamped(wire_type),
    };
    known.iter().map(topic).collect()
}

/// Tells the keeper whether the link is up, over all sessions.
async fn follow(mirror: Weak<Mirror>, keeper: Arc<Keeper>) {
    // The session that was up last: what it carried is answered yet when it is up again.
    let mut before: Weak<Session> = Weak::new();
    loop {
        let Some(session) = mirror.upgrade().map(|mirror| mirror.session()) else {
            return;
        };
        let mut up = session.up();
        let this = Arc::downgrade(&session);
        drop(session);
        if *up.borrow_and_update() {
            keeper.link_up(Weak::ptr_eq(&before, &this));
            before = this;
        } else {
            keeper.link_down();
        }
        // A session that was replaced ends its channel.
        let _ = up.changed().await;
    }
}

/// The ways out of a keeper.
struct Way(Weak<Mirror>);

impl Cloud for Way {
    fn publish(&self, topic: &str, message: &Message) {
        if let Some(mirror) = self.0.upgrade() {
            mirror.inputs.send(&mirror, topic, message);
        }
    }

    fn call(&self, request: RequestId, service: &str, bytes: Bytes) {
        if let Some(mirror) = self.0.upgrade() {
            mirror.calls.kept(&mirror, request, service, bytes);
        }
    }
}

impl Application for Way {
    fn deliver(&self, topic: &str, message: Message) {
        if let Some(mirror) = self.0.upgrade() {
            mirror.outputs.publish(topic, message.bytes);
        }
    }

    fn safe_stop(&self, stop: &SafeStop) {
        let Some(mirror) = self.0.upgrade() else {
            return;
        };
        match mirror.outputs.wire_type(&stop.topic).map(|of| zeros(&of)) {
            Some(Ok(bytes)) => {
                tracing::warn!("nobody answered in time: safe stop on {}", stop.topic);
                mirror.outputs.publish(&stop.topic, bytes);
            }
            Some(Err(reason)) => tracing::error!("no safe stop on {}: {reason}", stop.topic),
            None => tracing::error!("no safe stop: {} is no output of this node", stop.topic),
        }
    }

    fn told(&self, outcome: &Outcome) {
        if let Some(promise) = self
            .0
            .upgrade()
            .as_ref()
            .and_then(|mirror| mirror.promise.get())
        {
            promise.reports.note(outcome);
        }
    }

    fn decided(&self, event: &Event) {
        match event {
            Event::Start(why) => tracing::info!(?why, "the local original is started"),
            Event::Feed(why) => tracing::warn!(?why, "the local original answers, too"),
            Event::StopFeeding(why) => tracing::info!(?why, "the cloud answers alone"),
            Event::Stop(why) => tracing::info!(?why, "the local original is stopped"),
            Event::SaidOnceMissing => {
                tracing::warn!("there is no local original: the cloud is alone")
            }
            Event::Crashed(reason) => tracing::warn!("the local original ended: {reason}"),
            Event::Uncorrelated(input) => {
                tracing::warn!(
                    "no output carries the stamps of {input}: the next one is taken for the answer"
                );
            }
        }
    }
}

/// A message of zeros.
fn zeros(wire_type: &WireType) -> Result<Bytes, String> {
    let of = MessageType::from_full_text(&wire_type.name, &wire_type.definition);
    let of = of.map_err(|error| error.to_string())?;
    Ok(vec![0; of.min_size()].into())
}
