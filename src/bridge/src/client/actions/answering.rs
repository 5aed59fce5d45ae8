//! `advertise_action`, `unadvertise_action`, `action_feedback`, `action_result` from the client.

use std::sync::Arc;

use rosbridge::{ActionFeedback, ActionResult, AdvertiseAction, GoalStatus, UnadvertiseAction};

use super::server::ActionServer;
use crate::actionlib::Status;
use crate::client::publishing::{decode, decode_args};
use crate::client::{Client, Reply};
use crate::names::resolve;

impl Client {
    pub(in crate::client) fn advertise_action(
        self: &Arc<Self>,
        op: &AdvertiseAction<'_>,
        reply: &Reply,
    ) -> Result<(), String> {
        let name = resolve(&op.action)?.into_owned();
        let def = self.action_def(&name, &op.type_name)?;
        let limit = self.shared.options.max_advertisements;
        if self.actions.lock().served.len() >= limit {
            return Err(format!(
                "this client serves {limit} actions already; unadvertise one"
            ));
        }
        // The earlier one first: it says of its goals that they are given up.
        let earlier = self.actions.lock().served.remove(&name);
        if earlier.is_some() {
            self.warn(
                reply,
                &format!("advertise_action: {name} was advertised before, the new one replaces it"),
            );
        }
        drop(earlier);
        let server = ActionServer::open(self, &name, op, def)?;
        let replaced = self.actions.lock().served.insert(name.clone(), server);
        drop(replaced);
        self.info(reply, &format!("advertise_action: advertised {name}"));
        Ok(())
    }

    pub(in crate::client) fn unadvertise_action(
        &self,
        op: &UnadvertiseAction<'_>,
        reply: &Reply,
    ) -> Result<(), String> {
        let name = resolve(&op.action)?;
        let gone = self.actions.lock().served.remove(&*name);
        match gone {
            Some(_) => self.info(
                reply,
                &format!("unadvertise_action: {name} is no longer advertised"),
            ),
            None => self.warn(
                reply,
                &format!("unadvertise_action: this client does not advertise {name}"),
            ),
        }
        Ok(())
    }

    /// The client's result of that goal cannot be used: the goal is ended as failed, so that its sender does not wait for ever.
    pub(in crate::client) fn result_is_lost(&self, request: &str, reason: &str) {
        let servers: Vec<_> = self.actions.lock().served.values().cloned().collect();
        let text = format!("the result cannot be used: {reason}");
        for server in servers {
            let body = vec![0; server.def.result.min_size()];
            // Most of them have no such goal.
            if server
                .end_goal(request, Status::Aborted, &text, &body)
                .is_ok()
            {
                return;
            }
        }
    }

    fn action_server(&self, action: &str) -> Result<Arc<ActionServer>, String> {
        let name = resolve(action)?;
        let server = self.actions.lock().served.get(&*name).cloned();
        server.ok_or_else(|| {
            format!("action {name} is not advertised by this client; advertise_action it first")
        })
    }

    pub(in crate::client) fn action_feedback(&self, op: &ActionFeedback<'_>) -> Result<(), String> {
        let server = self.action_server(&op.action)?;
        let request = op.id.to_string();
        let body = decode(&server.def.feedback, op.values, op.compression, None)?;
        server.publish_feedback(&request, &body)
    }

    pub(in crate::client) fn action_result(&self, op: &ActionResult<'_>) -> Result<(), String> {
        let server = self.action_server(&op.action)?;
        let request = op
            .id
            .as_ref()
            .ok_or("field \"id\" is missing, the goal's id is expected")?
            .to_string();
        let text = match op.values {
            _ if op.result => None,
            None => Some("".into()),
            Some(values) => values.text(),
        };
        let status = match op.status {
            Some(GoalStatus::Canceled) => Status::Preempted,
            Some(GoalStatus::Aborted) => Status::Aborted,
            _ if !op.result => Status::Aborted,
            _ => Status::Succeeded,
        };
        // Who fails says why in a text, or gives a result all the same.
        if let Some(text) = text {
            let body = vec![0; server.def.result.min_size()];
            return server.end_goal(&request, status, &text, &body);
        }
        match decode_args(&server.def.result, op.values, op.compression) {
            Ok(body) => server.end_goal(&request, status, "", &body),
            Err(reason) => {
                let body = vec![0; server.def.result.min_size()];
                server.end_goal(
                    &request,
                    Status::Aborted,
                    &format!("the result does not fit: {reason}"),
                    &body,
                )?;
                Err(reason)
            }
        }
    }
}
