//! The parameter methods.

use super::super::notify::Notice;
use super::super::params;
use super::super::registry::Kind;
use super::{Api, name_argument, refusal_reply};
use crate::names;
use crate::reply::{ApiReply, Args};
use crate::xmlrpc::Value;

type Locked<'a> = parking_lot::MutexGuard<'a, crate::master::State>;

impl Api {
    pub(super) fn parameter(&self, method: &str, args: &mut Args) -> Option<Result<ApiReply, ApiReply>> {
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
                ApiReply::success("Parameter names", Value::strings(names))
            }),
            _ => return None,
        })
    }

    fn set_param(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let node = args.text("caller_id")?;
        let key = name_argument(args, "key", &node)?;
        let value = args.value("value")?;
        args.finish()?;
        let master = &self.master;
        let set = master.update(|state, notices| {
            let watchers = state.registry.parameter_watchers();
            if !watchers.is_empty() {
                report(params::updates(&watchers, &key, &value), notices);
            }
            let set = state.params.set(&key, value);
            match set {
                Ok(()) => master.record_use(state, &key, &node, true),
                Err(_) => notices.clear(),
            }
            set
        });
        match set {
            Ok(()) => Ok(ApiReply::success(format!("parameter {key} set"), 0)),
            Err(refused) => Err(ApiReply::error(format!("parameter {key}: {refused}"), 0)),
        }
    }

    fn delete_param(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let node = args.text("caller_id")?;
        let key = name_argument(args, "key", &node)?;
        let deleted = self.master.update(|state, notices| {
            let deleted = state.params.delete(&key);
            if deleted {
                let nothing = Value::Struct(Default::default());
                let watchers = state.registry.parameter_watchers();
                report(params::updates(&watchers, &key, &nothing), notices);
            }
            deleted
        });
        Ok(if deleted {
            ApiReply::success(format!("parameter {key} deleted"), 0)
        } else {
            ApiReply::error(format!("parameter [{key}] is not set"), 0)
        })
    }

    fn get_param(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let (state, key) = &mut self.note_read(args)?;
        Ok(match state.params.get(key) {
            Some(value) => ApiReply::success(format!("Parameter [{key}]"), value.clone()),
            None => ApiReply::error(format!("Parameter [{key}] is not set"), 0),
        })
    }

    fn has_param(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let (state, key) = &mut self.note_read(args)?;
        let there = state.params.get(key).is_some();
        Ok(ApiReply::success(key.as_str(), there))
    }

    /// Records that the caller reads the key in its next argument; returns the state and the key.
    fn note_read(&self, args: &mut Args) -> Result<(Locked<'_>, String), ApiReply> {
        let node = args.text("caller_id")?;
        let key = name_argument(args, "key", &node)?;
        let mut state = self.master.state.lock();
        self.master.record_use(&mut state, &key, &node, false);
        Ok((state, key))
    }

    fn search_param(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let node = args.text("caller_id")?;
        let key = args.text("key")?;
        if key.starts_with('~') || !node.starts_with('/') {
            let message = format!("cannot search for {key} from {node}");
            return Err(ApiReply::error(message, ""));
        }
        let mut state = self.master.state.lock();
        let found = state.params.search(&node, &key);
        let used = found.clone().unwrap_or_else(|| names::resolve(&key, &node));
        self.master.record_use(&mut state, &used, &node, false);
        Ok(match found {
            Some(found) => ApiReply::success(format!("Found [{found}]"), found),
            None => ApiReply::error(format!("Cannot find parameter [{key}] in an upwards search"), ""),
        })
    }

    fn subscribe_param(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let node = args.text("caller_id")?;
        let api = args.uri("caller_api", "http")?;
        let key = name_argument(args, "key", &node)?;
        let master = &self.master;
        let value = master.update(|state, notices| {
            let by = (node.as_str(), api.as_str());
            state.registry.register(Kind::Parameter, &key, "", by, "", notices)?;
            master.record_use(state, &key, &node, false);
            Ok(state.params.get(&key).cloned())
        });
        let nothing = || Value::Struct(Default::default());
        Ok(ApiReply::success(
            format!("Subscribed to parameter [{key}]"),
            value.map_err(refusal_reply)?.unwrap_or_else(nothing),
        ))
    }

    fn unsubscribe_param(&self, args: &mut Args) -> Result<ApiReply, ApiReply> {
        let node = args.text("caller_id")?;
        let api = args.text("caller_api")?;
        let key = name_argument(args, "key", &node)?;
        let held = self.master.update(|state, notices| {
            let registry = &mut state.registry;
            registry.unregister(Kind::Parameter, &key, &node, &api, notices)
        });
        Ok(ApiReply::success(format!("Unsubscribe to parameter [{key}]"), i32::from(held)))
    }
}

fn report(updates: Vec<(String, String, Value)>, notices: &mut Vec<Notice>) {
    notices.extend(updates.into_iter().map(|(api, key, value)| Notice::parameter(api, key, value)));
}
