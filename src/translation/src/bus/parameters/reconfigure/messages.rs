//! Messages of dynamic_reconfigure.

use std::collections::BTreeMap;
use std::sync::{Arc, LazyLock};

use bytes::Bytes;
use ros::bus::{BusError, ParamValue, RosVersion};
use ros::codec::cursor::MessageCursor;
use ros::ros2::process::yaml;
use ros::schema::{MessageType, Registry, SchemaError, ServiceDef};
use serde::Deserialize;

/// Maximum size of a message in bytes, and number of values in it.
const MAX_BYTES: usize = 4 << 20;
const MAX_VALUES: usize = 20_000;

static MESSAGE_TYPES: LazyLock<Result<Registry, SchemaError>> = LazyLock::new(|| {
    let registry = Registry::for_version(RosVersion::One);
    for (key, text) in DEFINITIONS {
        registry.insert(key, text)?;
    }
    Ok(registry)
});

const DEFINITIONS: [(&str, &str); 10] = [
    ("dynamic_reconfigure/msg/BoolParameter", "string name\nbool value\n"),
    ("dynamic_reconfigure/msg/IntParameter", "string name\nint32 value\n"),
    ("dynamic_reconfigure/msg/StrParameter", "string name\nstring value\n"),
    ("dynamic_reconfigure/msg/DoubleParameter", "string name\nfloat64 value\n"),
    ("dynamic_reconfigure/msg/GroupState", "string name\nbool state\nint32 id\nint32 parent\n"),
    (
        "dynamic_reconfigure/msg/Config",
        "BoolParameter[] bools\nIntParameter[] ints\nStrParameter[] strs\nDoubleParameter[] doubles\n\
         GroupState[] groups\n",
    ),
    (
        "dynamic_reconfigure/msg/ParamDescription",
        "string name\nstring type\nuint32 level\nstring description\nstring edit_method\n",
    ),
    (
        "dynamic_reconfigure/msg/Group",
        "string name\nstring type\nParamDescription[] parameters\nint32 parent\nint32 id\n",
    ),
    ("dynamic_reconfigure/msg/ConfigDescription", "Group[] groups\nConfig max\nConfig min\nConfig dflt\n"),
    ("dynamic_reconfigure/srv/Reconfigure", "Config config\n---\nConfig config\n"),
];

/// Returns a message type by its name.
pub(crate) fn message(name: &str) -> Result<Arc<MessageType>, BusError> {
    look_up(name, |registry| registry.message(name))
}

/// Returns the type of the service that changes parameters.
pub(crate) fn service() -> Result<Arc<ServiceDef>, BusError> {
    let name = "dynamic_reconfigure/Reconfigure";
    look_up(name, |registry| registry.service(name))
}

fn look_up<T>(name: &str, find: impl FnOnce(&Registry) -> Result<T, SchemaError>) -> Result<T, BusError> {
    let found = match &*MESSAGE_TYPES {
        Ok(registry) => find(registry),
        Err(error) => Err(error.clone()),
    };
    found.map_err(|error| BusError::Protocol { what: name.to_owned(), reason: error.to_string() })
}

/// Name of the group that all parameters belong to, unless their server has others.
const DEFAULT_GROUP: &str = "Default";
/// Parent and number of that group, each 0.
const PARENT_AND_ID: [u8; 8] = [0; 8];

/// Type of a parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ConfigKind {
    Bool,
    Integer,
    Double,
    Text,
}

impl ConfigKind {
    /// Returns the name of the type in descriptions.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Bool => "bool",
            Self::Integer => "int",
            Self::Double => "double",
            Self::Text => "str",
        }
    }

    fn from_name(name: &str) -> Option<Self> {
        [Self::Bool, Self::Integer, Self::Double, Self::Text].into_iter().find(|kind| kind.name() == name)
    }
}

/// A parameter as its server describes it.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DescribedParameter {
    pub(crate) kind: ConfigKind,
    pub(crate) description: String,
    /// The named values that it can have, in words; may be empty.
    pub(crate) choices: String,
    /// Smallest and largest value of a number.
    pub(crate) range: Option<(f64, f64)>,
}

/// The parameters of a server.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct ConfigDescription {
    pub(crate) parameters: BTreeMap<String, DescribedParameter>,
}

/// Values by name.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Config {
    pub(crate) values: BTreeMap<String, ParamValue>,
}

impl ConfigDescription {
    /// Reads a serialized `ConfigDescription`; `None` if it is truncated or too long.
    pub(super) fn parse(bytes: &[u8]) -> Option<Self> {
        let mut reader = ConfigReader::new(bytes)?;
        let mut parameters = BTreeMap::new();
        for _ in 0..reader.count()? {
            reader.text()?;
            reader.text()?;
            for _ in 0..reader.count()? {
                let (name, kind) = (reader.text()?, reader.text()?);
                reader.cursor.number::<4>()?;
                let (description, choices) = (reader.text()?, describe_choices(reader.text()?));
                // A type of a later version would be changed by nobody here.
                if let Some(kind) = ConfigKind::from_name(&kind) {
                    parameters.insert(name, DescribedParameter { kind, description, choices, range: None });
                }
            }
            reader.cursor.number::<4>()?;
            reader.cursor.number::<4>()?;
        }
        let (largest, smallest) = (reader.config()?, reader.config()?);
        for (name, parameter) in &mut parameters {
            let number = |of: &Config| match of.values.get(name) {
                Some(ParamValue::Int(number)) => Some(*number as f64),
                Some(ParamValue::Double(number)) => Some(*number),
                _ => None,
            };
            parameter.range = number(&smallest).zip(number(&largest)).filter(|(from, to)| from <= to);
        }
        Some(Self { parameters })
    }

    /// Returns the serialized `ConfigDescription` with these defaults, which are to have a value for each parameter.
    pub(crate) fn serialize(&self, defaults: &Config) -> Bytes {
        let mut out = Vec::new();
        out.extend(1u32.to_le_bytes());
        put_text(DEFAULT_GROUP, &mut out);
        put_text("", &mut out);
        out.extend((self.parameters.len() as u32).to_le_bytes());
        for (name, parameter) in &self.parameters {
            put_text(name, &mut out);
            put_text(parameter.kind.name(), &mut out);
            out.extend(0u32.to_le_bytes());
            put_text(&parameter.description, &mut out);
            put_text(&parameter.choices, &mut out);
        }
        out.extend(PARENT_AND_ID);
        // Clients look for each parameter in each of the three.
        out.extend(self.limits(DescribedParameter::largest).serialize_state());
        out.extend(self.limits(DescribedParameter::smallest).serialize_state());
        out.extend(defaults.serialize_state());
        out.into()
    }

    fn limits(&self, of: fn(&DescribedParameter) -> ParamValue) -> Config {
        let limits = self.parameters.iter().map(|(name, parameter)| (name.clone(), of(parameter)));
        Config { values: limits.collect() }
    }
}

/// The part of a parameter's edit method that is read.
#[derive(Deserialize)]
struct EditMethod {
    #[serde(rename = "enum")]
    choices: Vec<Choice>,
}

/// A value with a name.
#[derive(Deserialize)]
struct Choice {
    name: String,
    value: ParamValue,
}

/// Returns the named values of a parameter (`Slow = 0, Fast = 1`), or else its edit method as it is. Generators write a
/// dictionary of Python, which is YAML, too. Text with aliases, which repeat other text at no cost, stays as it is.
fn describe_choices(edit_method: String) -> String {
    if edit_method.contains('*') {
        return edit_method;
    }
    match serde_norway::from_str(&edit_method) {
        Ok(EditMethod { choices }) if !choices.is_empty() => {
            let choices = choices.iter().map(|choice| format!("{} = {}", choice.name, yaml(&choice.value)));
            choices.collect::<Vec<_>>().join(", ")
        }
        _ => edit_method,
    }
}

impl DescribedParameter {
    /// Returns the smallest value. Types without an order have one as well.
    fn smallest(&self) -> ParamValue {
        let from = self.range.map(|(from, _)| from);
        match self.kind {
            ConfigKind::Bool => ParamValue::Bool(false),
            ConfigKind::Integer => ParamValue::Int(from.map_or(i32::MIN, |from| from as i32).into()),
            ConfigKind::Double => ParamValue::Double(from.unwrap_or(f64::NEG_INFINITY)),
            ConfigKind::Text => ParamValue::String(String::new()),
        }
    }

    /// Returns the largest value, likewise.
    fn largest(&self) -> ParamValue {
        let to = self.range.map(|(_, to)| to);
        match self.kind {
            ConfigKind::Bool => ParamValue::Bool(true),
            ConfigKind::Integer => ParamValue::Int(to.map_or(i32::MAX, |to| to as i32).into()),
            ConfigKind::Double => ParamValue::Double(to.unwrap_or(f64::INFINITY)),
            ConfigKind::Text => ParamValue::String(String::new()),
        }
    }
}

impl Config {
    /// Reads a serialized `Config`, which is also the request and the response of the service.
    pub(crate) fn parse(bytes: &[u8]) -> Option<Self> {
        ConfigReader::new(bytes)?.config()
    }

    /// Returns the serialized `Config` as clients send it, without groups. Values that are neither bools, integers,
    /// texts nor doubles are left out.
    pub(crate) fn serialize(&self) -> Bytes {
        let mut out = self.serialize_values();
        out.extend(0u32.to_le_bytes());
        out.into()
    }

    /// Returns the serialized `Config` as servers send it, with the state of the group that all parameters belong to.
    pub(crate) fn serialize_state(&self) -> Bytes {
        let mut out = self.serialize_values();
        out.extend(1u32.to_le_bytes());
        put_text(DEFAULT_GROUP, &mut out);
        out.push(true.into());
        out.extend(PARENT_AND_ID);
        out.into()
    }

    fn serialize_values(&self) -> Vec<u8> {
        let mut lists: [(u32, Vec<u8>); 4] = Default::default();
        for (name, value) in &self.values {
            let at = match value {
                ParamValue::Bool(_) => 0,
                ParamValue::Int(_) => 1,
                ParamValue::String(_) => 2,
                ParamValue::Double(_) => 3,
                _ => continue,
            };
            let (count, out) = &mut lists[at];
            *count += 1;
            put_text(name, out);
            match value {
                ParamValue::Bool(value) => out.push((*value).into()),
                // Checked before.
                ParamValue::Int(value) => out.extend((*value as i32).to_le_bytes()),
                ParamValue::String(text) => put_text(text, out),
                ParamValue::Double(value) => out.extend(value.to_le_bytes()),
                _ => {}
            }
        }
        let mut out = Vec::new();
        for (count, list) in lists {
            out.extend(count.to_le_bytes());
            out.extend(list);
        }
        out
    }
}

fn put_text(text: &str, out: &mut Vec<u8>) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text.as_bytes());
}

/// Reader of messages of an untrusted node. Methods return `None` where the message ends too early.
struct ConfigReader<'a> {
    cursor: MessageCursor<'a>,
    /// Remaining number of values.
    left: usize,
}

impl<'a> ConfigReader<'a> {
    fn new(bytes: &'a [u8]) -> Option<Self> {
        let cursor = MessageCursor::new(RosVersion::One, bytes)?;
        (bytes.len() <= MAX_BYTES).then_some(Self { cursor, left: MAX_VALUES })
    }

    /// Reads the length of a list.
    fn count(&mut self) -> Option<usize> {
        let count = self.cursor.length()?;
        self.left = self.left.checked_sub(count)?;
        Some(count)
    }

    /// Reads a text; invalid UTF-8 is replaced.
    fn text(&mut self) -> Option<String> {
        Some(String::from_utf8_lossy(self.cursor.string(false)?).into_owned())
    }

    fn config(&mut self) -> Option<Config> {
        let mut values = BTreeMap::new();
        for _ in 0..self.count()? {
            let (name, [value]) = (self.text()?, self.cursor.number()?);
            values.insert(name, ParamValue::Bool(value != 0));
        }
        for _ in 0..self.count()? {
            let (name, value) = (self.text()?, i32::from_le_bytes(self.cursor.number()?));
            values.insert(name, ParamValue::Int(value.into()));
        }
        for _ in 0..self.count()? {
            let (name, value) = (self.text()?, self.text()?);
            values.insert(name, ParamValue::String(value));
        }
        for _ in 0..self.count()? {
            let (name, value) = (self.text()?, f64::from_le_bytes(self.cursor.number()?));
            values.insert(name, ParamValue::Double(value));
        }
        for _ in 0..self.count()? {
            self.text()?;
            self.cursor.take(9, 1)?;
        }
        Some(Config { values })
    }
}

#[cfg(test)]
mod tests {
    use ros::codec::{FillOptions, from_json, validate};

    use super::*;

    fn serialize(name: &str, json: &str) -> Vec<u8> {
        let mut bytes = Vec::new();
        let of = message(name).expect(name);
        from_json(&of, json.as_bytes(), &mut bytes, &FillOptions::default()).expect(json);
        bytes
    }

    const DESCRIPTION: &str = r#"{
        "groups": [
            {"name": "Default", "parameters": [
                {"name": "gain", "type": "double", "level": 1, "description": "how much", "edit_method": ""},
                {"name": "mode", "type": "int", "edit_method": "{'enum': []}"},
                {"name": "later", "type": "complex"}
            ]},
            {"name": "more", "id": 1, "parameters": [{"name": "on", "type": "bool"}, {"name": "text", "type": "str"}]}
        ],
        "max": {"bools": [{"name": "on", "value": true}], "ints": [{"name": "mode", "value": 3}],
            "doubles": [{"name": "gain", "value": 2.5}], "groups": [{"name": "Default", "state": true}]},
        "min": {"ints": [{"name": "mode"}], "doubles": [{"name": "gain", "value": -1}]},
        "dflt": {}
    }"#;

    #[test]
    fn the_definitions_are_those_of_the_package() {
        assert_eq!(service().expect("a service").md5, "bb125d226a21982a4a98760418dc2672");
        for (name, md5) in [
            ("dynamic_reconfigure/ConfigDescription", "757ce9d44ba8ddd801bb30bc456f946f"),
            ("dynamic_reconfigure/Config", "958f16a05573709014982821e6822580"),
        ] {
            assert_eq!(message(name).expect(name).md5(), md5, "{name}");
        }
    }

    #[test]
    fn a_description_has_types_and_ranges() {
        let bytes = serialize("dynamic_reconfigure/ConfigDescription", DESCRIPTION);
        let read = ConfigDescription::parse(&bytes).expect("a description").parameters;
        assert_eq!(read.keys().collect::<Vec<_>>(), ["gain", "mode", "on", "text"]);
        let gain = DescribedParameter {
            kind: ConfigKind::Double,
            description: "how much".to_owned(),
            choices: String::new(),
            range: Some((-1.0, 2.5)),
        };
        assert_eq!(read["gain"], gain);
        assert_eq!((read["mode"].range, &*read["mode"].choices), (Some((0.0, 3.0)), "{'enum': []}"));
        assert_eq!((read["on"].range, read["text"].kind), (None, ConfigKind::Text));
        // The defaults at the end are not read.
        let needed = bytes.len() - serialize("dynamic_reconfigure/Config", "{}").len();
        for end in 0..needed {
            assert_eq!(ConfigDescription::parse(&bytes[..end]), None, "{end}");
        }
    }

    #[test]
    fn choices_are_told_in_words() {
        for (edit_method, told) in [
            ("", ""),
            (
                "{'enum_description': 'how fast: very?', 'enum': [{'srcline': 9, 'srcfile': '/x.cfg', 'name': 'Slow', \
                 'type': 'int', 'value': 0, 'description': ''}, {'name': 'Fast', 'value': 3}]}",
                "Slow = 0, Fast = 3",
            ),
            ("{'enum': [{'name': 'Left', 'value': 'l'}]}", "Left = \"l\""),
            ("{'enum': []}", "{'enum': []}"),
            ("[unlike", "[unlike"),
        ] {
            assert_eq!(describe_choices(edit_method.to_owned()), told);
        }
    }

    #[test]
    fn a_description_is_serialized_and_read_again() {
        let parameter = |kind, range| DescribedParameter { kind, description: "x".into(), choices: "".into(), range };
        let parameters = [
            ("gain", parameter(ConfigKind::Double, Some((-1.0, 2.5)))),
            ("gains/p", parameter(ConfigKind::Double, Some((f64::NEG_INFINITY, f64::INFINITY)))),
            ("mode", parameter(ConfigKind::Integer, Some((0.0, 3.0)))),
            ("on", parameter(ConfigKind::Bool, None)),
            ("text", parameter(ConfigKind::Text, None)),
        ];
        let mut description =
            ConfigDescription { parameters: parameters.map(|(name, it)| (name.to_owned(), it)).into() };
        let bytes = description.serialize(&Config::default());
        let of = message("dynamic_reconfigure/ConfigDescription").expect("a type");
        validate(&of, &bytes).expect("a message");
        assert_eq!(ConfigDescription::parse(&bytes).as_ref(), Some(&description));
        // What has no limits has those of its type.
        for parameter in description.parameters.values_mut() {
            parameter.range = None;
        }
        let read = ConfigDescription::parse(&description.serialize(&Config::default())).expect("a description");
        let ranges = ["gain", "mode", "on"].map(|name| read.parameters[name].range);
        let whole = Some((i32::MIN.into(), i32::MAX.into()));
        assert_eq!(ranges, [Some((f64::NEG_INFINITY, f64::INFINITY)), whole, None]);
    }

    #[test]
    fn values_are_serialized_and_read_again() {
        let values = [
            ("on", ParamValue::Bool(true)),
            ("off", ParamValue::Bool(false)),
            ("mode", ParamValue::Int(-3)),
            ("text", ParamValue::String("ä".to_owned())),
            ("gain", ParamValue::Double(0.5)),
        ];
        let config = Config { values: values.map(|(name, value)| (name.to_owned(), value)).into() };
        let bytes = config.serialize();
        let of = message("dynamic_reconfigure/Config").expect("a type");
        validate(&of, &bytes).expect("a message");
        assert_eq!(Config::parse(&bytes), Some(config));
        let state = Config::default().serialize_state();
        validate(&of, &state).expect("a message");
        assert_eq!(Config::parse(&state), Some(Config::default()));
        let with_groups = serialize("dynamic_reconfigure/Config", r#"{"groups": [{"name": "Default", "id": 1}]}"#);
        assert_eq!(Config::parse(&with_groups), Some(Config::default()));
    }

    #[test]
    fn a_node_cannot_make_the_reader_reserve_what_it_did_not_send() {
        assert_eq!(Config::parse(&[0xff; 4]), None);
        let many = (MAX_VALUES as u32 + 1).to_le_bytes();
        assert_eq!(Config::parse(&[&many[..], &[0; 1 << 20]].concat()), None);
        assert_eq!(Config::parse(&vec![0; MAX_BYTES + 1]), None);
    }
}
