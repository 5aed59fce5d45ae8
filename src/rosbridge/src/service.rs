//! `call_service`, `service_response`, `advertise_service`, `unadvertise_service`.

use std::borrow::Cow;
use std::time::Duration;

use crate::fields::Fields;
use crate::op::Message;
use crate::subscribe::fragment_size;
use crate::{Compression, Id, Payload, Problem, Writer};

/// "Do this": from the client to a service, or from the server to a client that serves one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CallService<'a> {
    /// Comes back in the response.
    pub id: Option<Id<'a>>,
    /// The service's name (without the old `#id` suffix, which becomes the id).
    pub service: Cow<'a, str>,
    /// `package/Type`, where the client says it.
    pub type_name: Option<Cow<'a, str>>,
    /// An object, or a list of values in the request's order.
    pub args: Option<Payload<'a>>,
    /// How long to wait for the answer.
    pub timeout: Option<Duration>,
    /// A longer answer is cut.
    pub fragment_size: Option<usize>,
    /// How the answer is encoded; with `cbor-raw` the arguments are too. Absent: as the call.
    pub compression: Option<Compression>,
}

impl<'a> Message<'a> for CallService<'a> {
    const OP: &'static str = "call_service";
    const FIELDS: &'static [&'static str] = &[
        "service",
        "type",
        "args",
        "timeout",
        "fragment_size",
        "compression",
    ];

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
            timeout: fields.duration(
                "timeout",
                Duration::from_secs(1),
                "a number of seconds, 0 or more,",
            )?,
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

/// `/service#7` is how old clients wrote a call with id 7.
pub(crate) fn split_name<'a>(
    name: Cow<'a, str>,
    id: Option<Id<'a>>,
) -> (Cow<'a, str>, Option<Id<'a>>) {
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

/// The answer to a call.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceResponse<'a> {
    /// The call's id.
    pub id: Option<Id<'a>>,
    /// The service's name.
    pub service: Cow<'a, str>,
    /// The response, or, where `result` is false, the reason as a text.
    pub values: Option<Payload<'a>>,
    /// Whether the service was done.
    pub result: bool,
    /// `cbor-raw` where `values` holds the ROS serialization (extension).
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
            result: fields.boolean("result")?.ok_or(Problem::Missing {
                field: "result",
                expected: "true or false",
            })?,
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

/// "I serve this."
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AdvertiseService<'a> {
    /// The interaction.
    pub id: Option<Id<'a>>,
    /// The service's name.
    pub service: Cow<'a, str>,
    /// `package/Type`.
    pub type_name: Cow<'a, str>,
    /// How the client wants the calls (extension).
    pub compression: Compression,
}

impl<'a> Message<'a> for AdvertiseService<'a> {
    const OP: &'static str = "advertise_service";
    const FIELDS: &'static [&'static str] = &["service", "type", "compression"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self {
            id,
            service: fields.required_text("service", "a service name")?,
            type_name: fields
                .required_text("type", "a service type such as \"std_srvs/Trigger\"")?,
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

/// "I serve it no longer."
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnadvertiseService<'a> {
    /// The interaction.
    pub id: Option<Id<'a>>,
    /// The service's name.
    pub service: Cow<'a, str>,
}

impl<'a> Message<'a> for UnadvertiseService<'a> {
    const OP: &'static str = "unadvertise_service";
    const FIELDS: &'static [&'static str] = &["service", "type"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        Ok(Self {
            id,
            service: fields.required_text("service", "a service name")?,
        })
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
    use crate::op::tests::{reads, refuses, survives_cbor};

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
        reads(
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
        reads(r#"{"op":"call_service","service":"/add"}"#, bare.clone());
        survives_cbor(bare.clone());
        reads(
            r#"{"op":"call_service","service":"/add","args":[1,2]}"#,
            CallService {
                args: Some(Payload::json("[1,2]")),
                ..bare.clone()
            },
        );
        reads(
            r#"{"op":"call_service","service":"/add#33"}"#,
            CallService {
                id: Some("33".into()),
                ..bare.clone()
            },
        );
        reads(
            r#"{"op":"call_service","id":"mine","service":"/add#33"}"#,
            CallService {
                id: Some("mine".into()),
                ..bare
            },
        );
    }

    #[test]
    fn call_service_is_checked() {
        refuses(
            r#"{"op":"call_service"}"#,
            "call_service: field \"service\" is missing, a service name is expected",
        );
        refuses(
            r#"{"op":"call_service","service":"/add","args":"1"}"#,
            "call_service: field \"args\" is \"1\", an object, or a list of arguments in order, is expected",
        );
        refuses(
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
        reads(
            r#"{"op":"service_response","id":"service_request:/add:1","service":"/add","values":{"sum":3},"result":true}"#,
            done.clone(),
        );
        reads(
            r#"{"op":"service_response","service":"/add","values":"no","result":false}"#,
            ServiceResponse {
                id: None,
                values: Some(Payload::json("\"no\"")),
                result: false,
                ..done.clone()
            },
        );
        survives_cbor(ServiceResponse {
            values: None,
            ..done
        });
        refuses(
            r#"{"op":"service_response","service":"/add"}"#,
            "service_response: field \"result\" is missing, true or false is expected",
        );
        refuses(
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
        reads(
            r#"{"op":"advertise_service","type":"rospy_tutorials/AddTwoInts","service":"/add"}"#,
            op.clone(),
        );
        survives_cbor(op);
        refuses(
            r#"{"op":"advertise_service","service":"/add"}"#,
            "advertise_service: field \"type\" is missing, a service type such as \"std_srvs/Trigger\" is expected",
        );
        let op = UnadvertiseService {
            id: None,
            service: "/add".into(),
        };
        reads(
            r#"{"op":"unadvertise_service","service":"/add"}"#,
            op.clone(),
        );
        survives_cbor(op);
        refuses(
            r#"{"op":"unadvertise_service","service":[]}"#,
            "unadvertise_service: field \"service\" is [], a service name is expected",
        );
    }
}
