//! Resolution of names to types: dependencies first, each once, then the digest and the codec plan.

use std::sync::{Arc, OnceLock};

use md5::{Digest, Md5};

use crate::RosVersion;
use crate::schema::limits::{MAX_DEPTH, MAX_MESSAGE_BYTES, MAX_VALUES};
use crate::schema::parse::{Parsed, ParsedField, parse};
use crate::schema::plan::CodecPlan;
use crate::schema::primitive::Primitive;
use crate::schema::registry::State;
use crate::schema::types::{ActionDef, ActionServices, Base, Field, MessageType, ServiceDef};
use crate::schema::{Arity, ExceededLimit, SchemaError};

/// Resolves message `name` (`package/Type`) and its dependencies.
pub(crate) fn build_message(state: &mut State, name: &str) -> Result<Arc<MessageType>, SchemaError> {
    Resolver { state, stack: Vec::new() }.message(name)
}

/// Resolves a service's request and response.
pub(crate) fn build_service(state: &mut State, name: &str) -> Result<Arc<ServiceDef>, SchemaError> {
    if let Some(known) = state.resolved_services.get(name) {
        return Ok(known.clone());
    }
    if !state.has_service(name) {
        return Err(SchemaError::Unknown(name.to_owned()));
    }
    let ending = match state.version {
        RosVersion::One => "",
        RosVersion::Two => "_",
    };
    let request = build_message(state, &format!("{name}{ending}Request"))?;
    let response = build_message(state, &format!("{name}{ending}Response"))?;
    let digest = match state.version {
        RosVersion::One => {
            let mut hash = Md5::new();
            hash.update(md5_text(&request));
            hash.update(md5_text(&response));
            hex::encode(hash.finalize())
        }
        RosVersion::Two => build_message(state, name)?.digest().to_owned(),
    };
    let service = Arc::new(ServiceDef { name: name.to_owned(), md5: digest, request, response });
    state.resolved_services.insert(name.to_owned(), service.clone());
    Ok(service)
}

/// Resolves an action's seven messages; it is enough if only the messages are known.
pub(crate) fn build_action(state: &mut State, name: &str) -> Result<Arc<ActionDef>, SchemaError> {
    if let Some(known) = state.resolved_actions.get(name) {
        return Ok(known.clone());
    }
    let action = Arc::new(match state.version {
        RosVersion::One => resolve_ros1_action(state, name)?,
        RosVersion::Two => resolve_ros2_action(state, name)?,
    });
    state.resolved_actions.insert(name.to_owned(), action.clone());
    Ok(action)
}

fn resolve_ros1_action(state: &mut State, name: &str) -> Result<ActionDef, SchemaError> {
    if !state.has_action(name) && state.message_text(&format!("{name}Action"))?.is_none() {
        return Err(SchemaError::Unknown(name.to_owned()));
    }
    let mut part = |ending: &str| build_message(state, &format!("{name}{ending}"));
    Ok(ActionDef {
        name: name.to_owned(),
        action: part("Action")?,
        action_goal: part("ActionGoal")?,
        action_result: part("ActionResult")?,
        action_feedback: part("ActionFeedback")?,
        goal: part("Goal")?,
        result: part("Result")?,
        feedback: part("Feedback")?,
        services: None,
    })
}

fn resolve_ros2_action(state: &mut State, name: &str) -> Result<ActionDef, SchemaError> {
    if !state.has_action(name) {
        return Err(SchemaError::Unknown(name.to_owned()));
    }
    let services = ActionServices {
        send_goal: build_service(state, &format!("{name}_SendGoal"))?,
        get_result: build_service(state, &format!("{name}_GetResult"))?,
    };
    let mut part = |ending: &str| build_message(state, &format!("{name}{ending}"));
    Ok(ActionDef {
        name: name.to_owned(),
        action: part("")?,
        action_goal: services.send_goal.request.clone(),
        action_result: services.get_result.response.clone(),
        action_feedback: part("_FeedbackMessage")?,
        goal: part("_Goal")?,
        result: part("_Result")?,
        feedback: part("_Feedback")?,
        services: Some(services),
    })
}

struct Resolver<'a> {
    state: &'a mut State,
    /// The messages being resolved, outermost first.
    stack: Vec<String>,
}

impl Resolver<'_> {
    fn message(&mut self, name: &str) -> Result<Arc<MessageType>, SchemaError> {
        if let Some(known) = self.state.resolved_messages.get(name) {
            return Ok(known.clone());
        }
        if let Some(start) = self.stack.iter().position(|outer| outer == name) {
            let way: Vec<&str> = self.stack[start..].iter().map(String::as_str).chain([name]).collect();
            return Err(SchemaError::Cycle(way.join(" > ")));
        }
        if self.stack.len() >= MAX_DEPTH {
            return Err(too_large(&self.stack[0], ExceededLimit::Depth));
        }
        let Some(text) = self.state.message_text(name)? else {
            return Err(match self.stack.last() {
                None => SchemaError::Unknown(name.to_owned()),
                Some(outer) => SchemaError::Missing { name: name.to_owned(), needed_by: outer.clone() },
            });
        };
        self.stack.push(name.to_owned());
        let message = self.resolve(name, text)?;
        self.stack.pop();
        self.state.resolved_messages.insert(name.to_owned(), message.clone());
        Ok(message)
    }

    fn resolve(&mut self, name: &str, text: Arc<str>) -> Result<Arc<MessageType>, SchemaError> {
        let version = self.state.version;
        let Parsed { constants, fields: parsed } = parse(version, name, &text)?;
        let fields = parsed.into_iter().map(|field| self.field(field)).collect::<Result<Vec<_>, _>>()?;
        check_size(name, &fields)?;
        let message = MessageType {
            version,
            name: name.to_owned(),
            text,
            digest: OnceLock::new(),
            plan: CodecPlan::compile(version, name, &fields),
            fields,
            constants,
            full_text: OnceLock::new(),
        };
        if version == RosVersion::One {
            let digest = hex::encode(Md5::digest(md5_text(&message)));
            message.digest.get_or_init(|| digest);
        }
        // The depth of the dependencies was checked when they were first resolved, perhaps from elsewhere.
        if message.plan.depth > MAX_DEPTH {
            return Err(too_large(name, ExceededLimit::Depth));
        }
        Ok(Arc::new(message))
    }

    fn field(&mut self, parsed: ParsedField) -> Result<Field, SchemaError> {
        let base = match Primitive::from_versioned_name(self.state.version, &parsed.type_name) {
            Some(primitive) => Base::Primitive(primitive),
            None => Base::Message(self.message(&parsed.type_name)?),
        };
        Ok(Field {
            name: parsed.name,
            type_name: parsed.type_name,
            base,
            arity: parsed.arity,
            bounds: parsed.bounds,
            initial: parsed.initial,
        })
    }
}

/// Returns the text that genmsg hashes: constants, then fields, with each contained message replaced by its MD5.
fn md5_text(message: &MessageType) -> String {
    let mut out = String::new();
    for constant in &message.constants {
        out.push_str(&format!("{} {}={}\n", constant.type_name, constant.name, constant.value));
    }
    for field in &message.fields {
        match (&field.base, field.arity) {
            (Base::Message(inner), _) => out.push_str(inner.md5()),
            (Base::Primitive(_), Arity::One) => out.push_str(&field.type_name),
            (Base::Primitive(_), Arity::Variable) => out.push_str(&format!("{}[]", field.type_name)),
            (Base::Primitive(_), Arity::Fixed(count)) => out.push_str(&format!("{}[{count}]", field.type_name)),
        }
        out.push_str(&format!(" {}\n", field.name));
    }
    out.trim().to_owned()
}

/// Rejects messages that are huge even when empty.
fn check_size(name: &str, fields: &[Field]) -> Result<(), SchemaError> {
    let size = fields.iter().fold(0usize, |sum, field| sum.saturating_add(field.min_size()));
    if size > MAX_MESSAGE_BYTES {
        return Err(too_large(name, ExceededLimit::FixedArrays));
    }
    let values = CodecPlan::count_values(fields);
    if values > MAX_VALUES {
        return Err(too_large(name, ExceededLimit::Values));
    }
    Ok(())
}

fn too_large(name: &str, reason: ExceededLimit) -> SchemaError {
    SchemaError::TooLarge { name: name.to_owned(), reason }
}
