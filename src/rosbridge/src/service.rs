//! `call_service`, `service_response`, `advertise_service`, `unadvertise_service`.

use std::borrow::Cow;
use std::time::Duration;

use crate::fields::Fields;
use crate::message::Message;
use crate::subscribe::fragment_size;
use crate::{Compression, Id, Payload, Problem, Writer};

/// Calls a service: from the client, or from the server to a client that serves it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallService<'a> {
    /// Id of the call, repeated in the response.
    pub id: Option<Id<'a>>,
    /// Name of the service (without the old `#id` suffix, which becomes the id).
    pub service: Cow<'a, str>,
    /// `package/Type`, if given.
    pub type_name: Option<Cow<'a, str>>,
    /// Arguments: an object, or a list of values in the order of the request's fields.
    pub args: Option<Payload<'a>>,
    /// Time to wait for the response.
    pub timeout: Option<Duration>,
    /// Maximum frame size in bytes; a longer response is fragmented.
    pub fragment_size: Option<usize>,
    /// Encoding of the response; with `cbor-raw` also of the arguments. If absent, as in the call.
    pub compression: Option<Compression>,
}

impl<'a> Message<'a> for CallService<'a> {
    const OP: &'static str = "call_service";
    const FIELDS: &'static [&'static str] = &["service", "type", "args", "timeout", "fragment_size", "compression"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        let service = fields.required_text("service", "a service name")?;
        let (service, id) = split_name(service, id);
        Ok(Self {
            id,
            service,
            type_name: fields
                .text("type", "a service type such as \"std_srvs/Trigger\"")?
                .filter(|name| !name.is_empty()),
            args: fields.arguments("args")?,
            timeout: fields.duration("timeout", Duration::from_secs(1), "a number of seconds, 0 or more,")?,
            fragment_size: fragment_size(fields)?,
            compression: Compression::read_optional(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("service", &self.service);
        writer.optional_text("type", &self.type_name);
        if let Some(args) = self.args {
            writer.payload("args", args);
        }
        if let Some(timeout) = self.timeout {
            writer.number("timeout", timeout.as_secs_f64());
        }
        writer.optional_count("fragment_size", self.fragment_size.map(|size| size as u64));
        if let Some(compression) = self.compression {
            writer.text("compression", compression.name());
        }
    }
}

/// Splits the id off a name: old clients wrote a call with id 7 as `/service#7`.
pub(crate) fn split_name<'a>(name: Cow<'a, str>, id: Option<Id<'a>>) -> (Cow<'a, str>, Option<Id<'a>>) {
    let Some(at) = name.find('#') else {
        return (name, id);
    };
    let suffix = Id::from(name[at + 1..].to_owned());
    let name = match name {
        Cow::Borrowed(name) => Cow::Borrowed(&name[..at]),
        Cow::Owned(mut name) => {
            name.truncate(at);
            Cow::Owned(name)
        }
    };
    (name, id.or(Some(suffix)))
}

/// Response to a service call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceResponse<'a> {
    /// Id of the call.
    pub id: Option<Id<'a>>,
    /// Name of the service.
    pub service: Cow<'a, str>,
    /// Response message, or, if `result` is false, the reason as a string.
    pub values: Option<Payload<'a>>,
    /// True if the call succeeded.
    pub result: bool,
    /// Encoding: `cbor-raw` if `values` holds the ROS serialization (extension).
    pub compression: Compression,
}

impl<'a> Message<'a> for ServiceResponse<'a> {
    const OP: &'static str = "service_response";
    const FIELDS: &'static [&'static str] = &["service", "values", "result", "compression"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self {
            id,
            service: fields.required_text("service", "a service name")?,
            values: fields.payload("values"),
            result: fields.boolean("result")?.ok_or(Problem::Missing { field: "result", expected: "true or false" })?,
            compression: Compression::read(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("service", &self.service);
        self.compression.write(writer);
        if let Some(values) = self.values {
            writer.payload("values", values);
        }
        writer.boolean("result", self.result);
    }
}

/// Advertises that the client serves a service.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AdvertiseService<'a> {
    /// Id of the interaction.
    pub id: Option<Id<'a>>,
    /// Name of the service.
    pub service: Cow<'a, str>,
    /// Type of the service: `package/Type`.
    pub type_name: Cow<'a, str>,
    /// Encoding in which the client wants the calls (extension).
    pub compression: Compression,
}

impl<'a> Message<'a> for AdvertiseService<'a> {
    const OP: &'static str = "advertise_service";
    const FIELDS: &'static [&'static str] = &["service", "type", "compression"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self {
            id,
            service: fields.required_text("service", "a service name")?,
            type_name: fields.required_text("type", "a service type such as \"std_srvs/Trigger\"")?,
            compression: Compression::read(fields)?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("service", &self.service);
        writer.text("type", &self.type_name);
        self.compression.write(writer);
    }
}

/// Ends an [`AdvertiseService`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnadvertiseService<'a> {
    /// Id of the interaction.
    pub id: Option<Id<'a>>,
    /// Name of the service.
    pub service: Cow<'a, str>,
}

impl<'a> Message<'a> for UnadvertiseService<'a> {
    const OP: &'static str = "unadvertise_service";
    const FIELDS: &'static [&'static str] = &["service", "type"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self { id, service: fields.required_text("service", "a service name")? })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("service", &self.service);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::op::tests::{assert_parses, assert_refused, assert_survives_cbor};

    fn add() -> CallService<'static> {
        CallService {
            id: Some("call_service:/add:1".into()),
            service: "/add".into(),
            type_name: Some("rospy_tutorials/AddTwoInts".into()),
            args: Some(Payload::json(r#"{"a":1,"b":2}"#)),
            timeout: Some(Duration::from_millis(2500)),
            fragment_size: Some(512),
            compression: Some(Compression::None),
        }
    }

    #[test]
    fn call_service_is_read() {
        assert_parses(
            r#"{"op":"call_service","id":"call_service:/add:1","service":"/add","type":"rospy_tutorials/AddTwoInts","args":{"a":1,"b":2},"timeout":2.5,"fragment_size":512,"compression":"none"}"#,
            add(),
        );
        let bare = CallService {
            id: None,
            type_name: None,
            args: None,
            timeout: None,
            fragment_size: None,
            compression: None,
            ..add()
        };
        assert_parses(r#"{"op":"call_service","service":"/add"}"#, bare.clone());
        assert_survives_cbor(bare.clone());
        assert_parses(
            r#"{"op":"call_service","service":"/add","args":[1,2]}"#,
            CallService { args: Some(Payload::json("[1,2]")), ..bare.clone() },
        );
        assert_parses(
            r#"{"op":"call_service","service":"/add#33"}"#,
            CallService { id: Some("33".into()), ..bare.clone() },
        );
        assert_parses(
            r#"{"op":"call_service","id":"mine","service":"/add#33"}"#,
            CallService { id: Some("mine".into()), ..bare },
        );
    }

    #[test]
    fn call_service_is_checked() {
        assert_refused(
            r#"{"op":"call_service"}"#,
            "call_service: field \"service\" is missing, a service name is expected",
        );
        assert_refused(
            r#"{"op":"call_service","service":"/add","args":"1"}"#,
            "call_service: field \"args\" is \"1\", an object, or a list of arguments in order, is expected",
        );
        assert_refused(
            r#"{"op":"call_service","service":"/add","timeout":"soon"}"#,
            "call_service: field \"timeout\" is \"soon\", a number of seconds, 0 or more, is expected",
        );
    }

    #[test]
    fn service_response_is_read_and_checked() {
        let done = ServiceResponse {
            id: Some("service_request:/add:1".into()),
            service: "/add".into(),
            values: Some(Payload::json(r#"{"sum":3}"#)),
            result: true,
            compression: Compression::None,
        };
        assert_parses(
            r#"{"op":"service_response","id":"service_request:/add:1","service":"/add","values":{"sum":3},"result":true}"#,
            done.clone(),
        );
        assert_parses(
            r#"{"op":"service_response","service":"/add","values":"no","result":false}"#,
            ServiceResponse { id: None, values: Some(Payload::json("\"no\"")), result: false, ..done.clone() },
        );
        assert_survives_cbor(ServiceResponse { values: None, ..done });
        assert_refused(
            r#"{"op":"service_response","service":"/add"}"#,
            "service_response: field \"result\" is missing, true or false is expected",
        );
        assert_refused(
            r#"{"op":"service_response","result":true}"#,
            "service_response: field \"service\" is missing, a service name is expected",
        );
    }

    #[test]
    fn advertise_service_is_read_and_checked() {
        let op = AdvertiseService {
            id: None,
            service: "/add".into(),
            type_name: "rospy_tutorials/AddTwoInts".into(),
            compression: Compression::None,
        };
        assert_parses(r#"{"op":"advertise_service","type":"rospy_tutorials/AddTwoInts","service":"/add"}"#, op.clone());
        assert_survives_cbor(op);
        assert_refused(
            r#"{"op":"advertise_service","service":"/add"}"#,
            "advertise_service: field \"type\" is missing, a service type such as \"std_srvs/Trigger\" is expected",
        );
        let op = UnadvertiseService { id: None, service: "/add".into() };
        assert_parses(r#"{"op":"unadvertise_service","service":"/add"}"#, op.clone());
        assert_survives_cbor(op);
        assert_refused(
            r#"{"op":"unadvertise_service","service":[]}"#,
            "unadvertise_service: field \"service\" is [], a service name is expected",
        );
    }
}
