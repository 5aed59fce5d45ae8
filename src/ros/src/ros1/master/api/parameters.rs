//! The parameter methods.

use super::super::notify::Notice;
use super::super::params;
use super::super::registry::Kind;
use super::{Api, name, refusal};
use crate::ros1::names;
use crate::ros1::reply::{Args, Reply};
use crate::ros1::xmlrpc::Value;

type Locked<'a> = parking_lot::MutexGuard<'a, crate::ros1::master::State>;

impl Api {
    pub(super) fn parameter(&self, method: &str, args: &mut Args) -> Option<Result<Reply, Reply>> {
        Some(match method {
            "setParam" => self.set_param(args),
            "getParam" => self.get_param(args),
            "deleteParam" => self.delete_param(args),
            "hasParam" => self.has_param(args),
            "searchParam" => self.search_param(args),
            "subscribeParam" => self.subscribe_param(args),
            "unsubscribeParam" => self.unsubscribe_param(args),
            "getParamNames" => args.text("caller_id").map(|_| {
                let names = self.master.state.lock().params.names();
                Reply::done("Parameter names", Value::strings(names))
            }),
            _ => return None,
        })
    }

    fn set_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let key = name(args, "key", &node)?;
        let value = args.any("value")?;
        args.end()?;
        let master = &self.master;
        let set = master.change(|state, notices| {
            let watchers = state.registry.parameter_watchers();
            if !watchers.is_empty() {
                report(params::updates(&watchers, &key, &value), notices);
            }
            let set = state.params.set(&key, value);
            match set {
                Ok(()) => master.note_use(state, &key, &node, true),
                Err(_) => notices.clear(),
            }
            set
        });
        match set {
            Ok(()) => Ok(Reply::done(format!("parameter {key} set"), 0)),
            Err(refused) => Err(Reply::mistake(format!("parameter {key}: {refused}"), 0)),
        }
    }

    fn delete_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let key = name(args, "key", &node)?;
        let deleted = self.master.change(|state, notices| {
            let deleted = state.params.delete(&key);
            if deleted {
                let nothing = Value::Struct(Default::default());
                let watchers = state.registry.parameter_watchers();
                report(params::updates(&watchers, &key, &nothing), notices);
            }
            deleted
        });
        Ok(if deleted {
            Reply::done(format!("parameter {key} deleted"), 0)
        } else {
            Reply::mistake(format!("parameter [{key}] is not set"), 0)
        })
    }

    fn get_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let (state, key) = &mut self.reads(args)?;
        Ok(match state.params.get(key) {
            Some(value) => Reply::done(format!("Parameter [{key}]"), value.clone()),
            None => Reply::mistake(format!("Parameter [{key}] is not set"), 0),
        })
    }

    fn has_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let (state, key) = &mut self.reads(args)?;
        let there = state.params.get(key).is_some();
        Ok(Reply::done(key.as_str(), there))
    }

    /// The state, after noting that the caller reads the key it names next.
    fn reads(&self, args: &mut Args) -> Result<(Locked<'_>, String), Reply> {
        let node = args.text("caller_id")?;
        let key = name(args, "key", &node)?;
        let mut state = self.master.state.lock();
        self.master.note_use(&mut state, &key, &node, false);
        Ok((state, key))
    }

    fn search_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let key = args.text("key")?;
        if key.starts_with('~') || !node.starts_with('/') {
            let message = format!("cannot search for {key} from {node}");
            return Err(Reply::mistake(message, ""));
        }
        let mut state = self.master.state.lock();
        let found = state.params.search(&node, &key);
        let used = found.clone().unwrap_or_else(|| names::resolve(&key, &node));
        self.master.note_use(&mut state, &used, &node, false);
        Ok(match found {
            Some(found) => Reply::done(format!("Found [{found}]"), found),
            None => Reply::mistake(
                format!("Cannot find parameter [{key}] in an upwards search"),
                "",
            ),
        })
    }

    fn subscribe_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let api = args.uri("caller_api", "http")?;
        let key = name(args, "key", &node)?;
        let master = &self.master;
        let value = master.change(|state, notices| {
            let by = (node.as_str(), api.as_str());
            state
                .registry
                .register(Kind::Parameter, &key, "", by, "", notices)?;
            master.note_use(state, &key, &node, false);
            Ok(state.params.get(&key).cloned())
        });
        let nothing = || Value::Struct(Default::default());
        Ok(Reply::done(
            format!("Subscribed to parameter [{key}]"),
            value.map_err(refusal)?.unwrap_or_else(nothing),
        ))
    }

    fn unsubscribe_param(&self, args: &mut Args) -> Result<Reply, Reply> {
        let node = args.text("caller_id")?;
        let api = args.text("caller_api")?;
        let key = name(args, "key", &node)?;
        let held = self.master.change(|state, notices| {
            let registry = &mut state.registry;
            registry.unregister(Kind::Parameter, &key, &node, &api, notices)
        });
        Ok(Reply::done(
            format!("Unsubscribe to parameter [{key}]"),
            i32::from(held),
        ))
    }
}

fn report(updates: Vec<(String, String, Value)>, notices: &mut Vec<Notice>) {
    notices.extend(
        updates
            .into_iter()
            .map(|(api, key, value)| Notice::parameter(api, key, value)),
    );
}
