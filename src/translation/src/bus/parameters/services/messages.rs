//! Requests and responses of the services about parameters.

use bytes::Bytes;
use ros::bus::{FailureReason, ParamChange, ParamValue, ParameterDescription, ParameterKind, ParameterNames};
use ros::codec::put::CdrWriter;
use ros::ros2::parameters::reading::ParameterReader;
use ros::ros2::parameters::values;

use crate::bus::parameters::values::write_typed;

/// Reads the names that are asked for; `None` if the request is truncated or too long.
pub(super) fn read_names(request: &[u8]) -> Option<Vec<String>> {
    ParameterReader::new(request)?.texts()
}

/// Reads prefixes of names, and the number of levels beyond them.
pub(super) fn read_list_request(request: &[u8]) -> Option<(Vec<String>, u64)> {
    let mut reader = ParameterReader::new(request)?;
    Some((reader.texts()?, reader.unsigned_integer()?))
}

/// Reads changes; one without a value deletes the parameter.
pub(super) fn read_changes(request: &[u8]) -> Option<Vec<ParamChange>> {
    let mut reader = ParameterReader::new(request)?;
    reader.list(|reader| Some((reader.text()?, values::read(reader)?)))
}

/// Returns the response with the names of parameters.
pub(super) fn write_names(names: &ParameterNames) -> Bytes {
    let mut put = CdrWriter::new();
    for texts in [&names.names, &names.prefixes] {
        put.length(texts.len());
        texts.iter().for_each(|text| put.text(text));
    }
    put.finish()
}

/// Returns the response with values. A parameter that does not exist, or whose value ROS 2 does not have, is not set.
pub(super) fn write_values(all: Vec<Option<ParamValue>>) -> Bytes {
    let mut put = CdrWriter::new();
    put.length(all.len());
    all.into_iter().for_each(|value| write_typed(value, &mut put));
    put.finish()
}

/// Returns the response with the types of parameters.
pub(super) fn write_kinds(all: &[Option<ParameterDescription>]) -> Bytes {
    let mut put = CdrWriter::new();
    put.length(all.len());
    for described in all {
        put.byte(values::number_from_kind(
            described.as_ref().map_or(ParameterKind::NotSet, |described| described.kind),
        ));
    }
    put.finish()
}

/// Returns the response with descriptions of the parameters of these names.
pub(super) fn write_descriptions(names: &[String], all: Vec<Option<ParameterDescription>>) -> Bytes {
    let mut put = CdrWriter::new();
    put.length(all.len());
    for (name, described) in names.iter().zip(all) {
        let described =
            described.unwrap_or_else(|| ParameterDescription { name: name.clone(), ..ParameterDescription::default() });
        put.text(&described.name);
        put.byte(values::number_from_kind(described.kind));
        put.text(&described.description);
        put.text(&described.constraints);
        put.byte(described.read_only.into());
        put.byte(described.dynamic_typing.into());
        put.length(described.double_range.iter().len());
        if let Some(range) = described.double_range {
            [range.from, range.to, range.step].iter().for_each(|limit| put.number(limit.to_le_bytes()));
        }
        put.length(described.integer_range.iter().len());
        if let Some(range) = described.integer_range {
            put.number(range.from.to_le_bytes());
            put.number(range.to.to_le_bytes());
            put.number(range.step.to_le_bytes());
        }
    }
    put.finish()
}

/// Returns the response about each change.
pub(super) fn write_results(results: &[Result<(), FailureReason>]) -> Bytes {
    let mut put = CdrWriter::new();
    put.length(results.len());
    results.iter().for_each(|result| put_result(result, &mut put));
    put.finish()
}

/// Returns the response about all changes together.
pub(super) fn write_result(result: &Result<(), FailureReason>) -> Bytes {
    let mut put = CdrWriter::new();
    put_result(result, &mut put);
    put.finish()
}

fn put_result(result: &Result<(), FailureReason>, put: &mut CdrWriter) {
    put.byte(result.is_ok().into());
    put.text(result.as_ref().err().map_or("", FailureReason::as_str));
}
