//! `advertise_action`, `unadvertise_action`, `action_feedback`, `action_result` from the client.

use std::sync::Arc;

use access::Operation;
use ros::bus::GoalOutcome;
use rosbridge::{ActionFeedback, ActionResult, AdvertiseAction, GoalStatus, UnadvertiseAction};

use super::ClientActionError;
use crate::client::decoding::{decode, decode_args};
use crate::client::{BridgeClient, ReplyTarget};
use crate::client_state::ActionServer;
use crate::names::ResolveNameError;

impl BridgeClient {
    pub(in crate::client) fn advertise_action(
        self: &Arc<Self>,
        op: &AdvertiseAction<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), ClientActionError> {
        let name = self.resolve(&op.action)?.into_owned();
        self.client_grants().check(Operation::Advertise, &name)?;
        let def = self.action_def(&name, &op.type_name)?;
        let limit = self.shared.options.max_advertisements;
        if self.actions.lock().served.len() >= limit {
            return Err(ClientActionError::TooManyServed(limit));
        }
        // The earlier one is dropped first, which aborts its goals.
        let earlier = self.actions.lock().served.remove(&name);
        if earlier.is_some() {
            self.warn(reply, &format!("advertise_action: {name} was advertised before, the new one replaces it"));
        }
        drop(earlier);
        // Under the lock, so that the answer to its first goal finds the server.
        let mut actions = self.actions.lock();
        let server = ActionServer::open(self, &name, op, def)?;
        let replaced = actions.served.insert(name.clone(), server);
        drop(actions);
        drop(replaced);
        self.info(reply, &format!("advertise_action: advertised {name}"));
        Ok(())
    }

    pub(in crate::client) fn unadvertise_action(
        &self,
        op: &UnadvertiseAction<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), ResolveNameError> {
        let name = self.resolve(&op.action)?;
        let gone = self.actions.lock().served.remove(&*name);
        match gone {
            Some(_) => self.info(reply, &format!("unadvertise_action: {name} is no longer advertised")),
            None => self.warn(reply, &format!("unadvertise_action: this client does not advertise {name}")),
        }
        Ok(())
    }

    /// Fails the goal whose result from the client is unusable, so that its sender does not wait forever.
    pub(in crate::client) fn fail_lost_result(&self, request: &str, reason: &str) {
        let servers: Vec<_> = self.actions.lock().served.values().cloned().collect();
        let text = format!("the result cannot be used: {reason}");
        for server in servers {
            // Only one of them has the goal.
            let ended = server.end_goal(request, GoalOutcome::Aborted, &text, server.default_result());
            if ended.is_ok() {
                return;
            }
        }
    }

    fn action_server(&self, action: &str) -> Result<Arc<ActionServer>, ClientActionError> {
        let name = self.resolve(action)?;
        let server = self.actions.lock().served.get(&*name).cloned();
        server.ok_or_else(|| ClientActionError::NotAdvertised(name.into_owned()))
    }

    pub(in crate::client) fn action_feedback(
        &self,
        op: &ActionFeedback<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), ClientActionError> {
        let server = self.action_server(&op.action)?;
        let request = op.id.to_string();
        let body = decode(&server.def.feedback, op.values, op.compression, None)?;
        server.publish_feedback(&request, self.take_decoded(body, "action_feedback", ("action", &server.name), reply))
    }

    pub(in crate::client) fn action_result(
        &self,
        op: &ActionResult<'_>,
        reply: &ReplyTarget,
    ) -> Result<(), ClientActionError> {
        let server = self.action_server(&op.action)?;
        let request = op.id.as_ref().ok_or(ClientActionError::NoId)?.to_string();
        let text = match op.values {
            _ if op.result => None,
            None => Some("".into()),
            Some(values) => values.text(),
        };
        let outcome = match op.status {
            Some(GoalStatus::Canceled) => GoalOutcome::Canceled,
            Some(GoalStatus::Aborted) => GoalOutcome::Aborted,
            _ if !op.result => GoalOutcome::Aborted,
            _ => GoalOutcome::Succeeded,
        };
        // A failure has a reason as text, or a result all the same.
        if let Some(text) = text {
            return server.end_goal(&request, outcome, &text, server.default_result());
        }
        match decode_args(&server.def.result, op.values, op.compression) {
            Ok(body) => {
                let body = self.take_decoded(body, "action_result", ("action", &server.name), reply);
                server.end_goal(&request, outcome, "", body)
            }
            Err(error) => {
                let text = format!("the result does not fit: {error}");
                server.end_goal(&request, GoalOutcome::Aborted, &text, server.default_result())?;
                Err(error.into())
            }
        }
    }
}
