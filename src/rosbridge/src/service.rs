//! `call_service`, `service_response`, `advertise_service`, `unadvertise_service`.

use std::borrow::Cow;
use std::time::Duration;

use crate::field_kinds::{
    AnyValue, Arguments, Encoding, FrameSize, OptionalEncoding, OptionalId, OptionalText, Outcome, SERVICE,
    SERVICE_TYPE, Seconds, Text,
};
use crate::message::message;
use crate::{Compression, Id, Payload};

message! {
    /// Calls a service: from the client, or from the server to a client that serves it.
    CallService "call_service"
    /// Id of the call, repeated in the response.
    id: Option<Id<'a>> = OptionalId => service,
    /// Name of the service (without the old `#id` suffix, which becomes the id).
    service: Cow<'a, str> = "service" SERVICE,
    /// `package/Type`, if given.
    type_name: Option<Cow<'a, str>> = "type" OptionalText(SERVICE_TYPE),
    /// Arguments: an object, or a list of values in the order of the request's fields.
    args: Option<Payload<'a>> = "args" Arguments,
    /// Time to wait for the response.
    timeout: Option<Duration> = "timeout" Seconds,
    /// Maximum frame size in bytes; a longer response is fragmented.
    fragment_size: Option<usize> = "fragment_size" FrameSize,
    /// Encoding of the response; with `cbor-raw` also of the arguments. If absent, as in the call.
    compression: Option<Compression> = "compression" OptionalEncoding,
}

message! {
    /// Response to a service call.
    ServiceResponse "service_response"
    /// Id of the call.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the service.
    service: Cow<'a, str> = "service" SERVICE,
    /// Encoding: `cbor-raw` if `values` holds the ROS serialization (extension).
    compression: Compression = "compression" Encoding,
    /// Response message, or, if `result` is false, the reason as a string.
    values: Option<Payload<'a>> = "values" AnyValue,
    /// True if the call succeeded.
    result: bool = "result" Outcome,
}

message! {
    /// Advertises that the client serves a service.
    AdvertiseService "advertise_service"
    /// Id of the interaction.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the service.
    service: Cow<'a, str> = "service" SERVICE,
    /// Type of the service: `package/Type`.
    type_name: Cow<'a, str> = "type" Text(SERVICE_TYPE),
    /// Encoding in which the client wants the calls (extension).
    compression: Compression = "compression" Encoding,
}

message! {
    /// Ends an [`AdvertiseService`].
    UnadvertiseService "unadvertise_service" ignores ["type"]
    /// Id of the interaction.
    id: Option<Id<'a>> = OptionalId,
    /// Name of the service.
    service: Cow<'a, str> = "service" SERVICE,
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
