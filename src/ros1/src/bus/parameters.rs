//! Global parameters at the Master.

use async_trait::async_trait;
use ros_bus::{BusError, GlobalParameters, ParamChangeReceiver, ParamValue, param_change_channel};

use super::Ros1Bus;
use crate::names;
use crate::xmlrpc::Value;

#[async_trait]
impl GlobalParameters for Ros1Bus {
    async fn get(&self, key: &str) -> Result<ParamValue, BusError> {
        match self.inner.master.ask("getParam", vec![key.into()]).await? {
            Ok(value) => Ok(value.into()),
            Err(_) => Err(BusError::NoParam(key.to_owned())),
        }
    }

    async fn set(&self, key: &str, value: ParamValue) -> Result<(), BusError> {
        let value = Value::try_from(value)
            .map_err(|error| BusError::BadParam { key: key.to_owned(), reason: error.to_string() })?;
        let set = self.inner.master.call("setParam", vec![key.into(), value]);
        set.await.map(drop)
    }

    async fn delete(&self, key: &str) -> Result<(), BusError> {
        let answer = self.inner.master.ask("deleteParam", vec![key.into()]);
        match answer.await? {
            Ok(_) => Ok(()),
            Err(_) => Err(BusError::NoParam(key.to_owned())),
        }
    }

    async fn has(&self, key: &str) -> Result<bool, BusError> {
        let has = self.inner.master.call("hasParam", vec![key.into()]).await?;
        Ok(has == Value::Bool(true))
    }

    async fn search(&self, namespace: &str, key: &str) -> Result<Option<String>, BusError> {
        let asker = names::canonical(namespace);
        let master = &self.inner.master;
        let found = master.ask_in_name_of(&asker, "searchParam", vec![key.into()]);
        Ok(match found.await? {
            Ok(Value::String(found)) => Some(found),
            _ => None,
        })
    }

    async fn names(&self) -> Result<Vec<String>, BusError> {
        let names = self.inner.master.call("getParamNames", vec![]).await?;
        Ok(names.to_strings())
    }

    async fn watch(&self) -> Result<ParamChangeReceiver, BusError> {
        self.inner.check_open()?;
        let (teller, changes) = param_change_channel(&self.inner.frames.budget);
        {
            let mut watchers = self.inner.param_watchers.lock();
            watchers.retain(|watcher| !watcher.is_closed());
            watchers.push(teller);
        }
        self.inner.subscribe_params().await?;
        Ok(changes)
    }
}
