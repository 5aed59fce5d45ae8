//! Parameters as viewers have them.

use foxglove::ws_protocol::parameter::{Parameter, ParameterType, ParameterValue};
use ros::bus::ParamValue;

/// As viewers have it; none for what they have no word for.
pub fn told(name: &str, value: &ParamValue) -> Option<Parameter> {
    let (value, hint) = match value {
        ParamValue::Double(_) => (written(value)?, Some(ParameterType::Float64)),
        ParamValue::List(all) if is_of_doubles(all) => {
            (written(value)?, Some(ParameterType::Float64Array))
        }
        // What viewers take for text is not told to be bytes.
        ParamValue::Binary(_) => return None,
        other => (written(other)?, None),
    };
    Some(Parameter {
        name: name.to_owned(),
        r#type: hint,
        value: Some(value),
    })
}

fn is_of_doubles(all: &[ParamValue]) -> bool {
    !all.is_empty() && all.iter().all(|one| matches!(one, ParamValue::Double(_)))
}

fn written(value: &ParamValue) -> Option<ParameterValue> {
    Some(match value {
        ParamValue::Bool(value) => ParameterValue::Bool(*value),
        ParamValue::Int(value) => ParameterValue::Integer(*value),
        ParamValue::Double(value) => ParameterValue::Float64(*value),
        ParamValue::String(value) => ParameterValue::String(value.clone()),
        ParamValue::Binary(_) | ParamValue::Nil => return None,
        ParamValue::List(all) => {
            ParameterValue::Array(all.iter().map(written).collect::<Option<_>>()?)
        }
        ParamValue::Map(all) => {
            let one = |(key, value): (&String, &ParamValue)| Some((key.clone(), written(value)?));
            ParameterValue::Dict(all.iter().map(one).collect::<Option<_>>()?)
        }
    })
}

/// As ROS has it.
pub fn read(value: ParameterValue) -> ParamValue {
    match value {
        ParameterValue::Integer(value) => ParamValue::Int(value),
        ParameterValue::Float64(value) => ParamValue::Double(value),
        ParameterValue::Bool(value) => ParamValue::Bool(value),
        ParameterValue::String(value) => ParamValue::String(value),
        ParameterValue::Array(all) => ParamValue::List(all.into_iter().map(read).collect()),
        ParameterValue::Dict(all) => {
            let all = all.into_iter();
            ParamValue::Map(all.map(|(key, value)| (key, read(value))).collect())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_come_back_as_they_were() {
        let list = ParamValue::List(vec![ParamValue::Double(1.0), ParamValue::Double(2.5)]);
        let map = [
            ("a".to_owned(), list.clone()),
            ("b".to_owned(), ParamValue::Bool(true)),
        ];
        for value in [
            ParamValue::Int(3),
            ParamValue::Double(3.0),
            ParamValue::String("x".into()),
            list,
            ParamValue::Map(map.into()),
        ] {
            let told = told("/p", &value).expect("has a word");
            assert_eq!(read(told.value.expect("a value")), value);
        }
        assert_eq!(told("/p", &ParamValue::Nil), None);
        assert_eq!(told("/p", &ParamValue::Binary(vec![1])), None);
        let double = told("/p", &ParamValue::Double(3.0)).expect("has a word");
        assert_eq!(double.r#type, Some(ParameterType::Float64));
    }
}
