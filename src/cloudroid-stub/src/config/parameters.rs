//! ROS parameters that override `stub.toml`. In ROS 1: `cloudroid/KEY` in the node's own namespace, or in one around
//! it, where it holds for all nodes of that namespace; the nearest wins. In ROS 2: the node's own `cloudroid.KEY`.

use std::collections::{BTreeMap, HashMap};

use anyhow::bail;
use ros::bus::ParamValue;
use toml::{Table, Value};

use super::sources::apply_overrides;
use super::{Config, OUTPUT_MEASURES};

/// Name of the group of parameters, after the namespace.
const GROUP: &str = "cloudroid";

/// The settings of one namespace (ROS 1), or of the node (ROS 2).
pub struct ParameterGroup {
    /// Name of the parameter that holds them, such as `/front/cloudroid`; `None` for the node's own parameters in ROS
    /// 2.
    pub name: Option<String>,
    /// Values by key.
    pub settings: BTreeMap<String, ParamValue>,
}

impl ParameterGroup {
    /// Returns the name of the parameter that sets a key, and how to remove it.
    fn source(&self, key: &str) -> (String, String) {
        match &self.name {
            Some(name) => {
                let giver = format!("{name}/{key}");
                let removal = format!("remove it with: rosparam delete {giver}");
                (giver, removal)
            }
            None => {
                let removal = "remove it from the command line (-p), or from the parameters file";
                (format!("{GROUP}.{key}"), removal.to_owned())
            }
        }
    }
}

/// Returns the names of the parameters that may hold settings for a node, the nearest last: `/cloudroid`,
/// `/front/cloudroid`, `/front/reporter/cloudroid`.
pub fn group_names(node: &str) -> Vec<String> {
    let ends = node.match_indices('/').map(|(at, _)| at).skip(1);
    let namespaces = std::iter::once("").chain(ends.map(|at| &node[..at]));
    let namespaces = namespaces.chain([node.trim_end_matches('/')]);
    namespaces.map(|namespace| format!("{namespace}/{GROUP}")).collect()
}

impl Config {
    /// Returns the configuration with the overrides of these groups, the nearest last.
    ///
    /// # Errors
    /// A parameter has an invalid value; the error names it, the reason and what to do.
    pub fn with_parameters(&self, given: &[ParameterGroup]) -> anyhow::Result<Config> {
        let mut table = Table::try_from(self)?;
        // Sources of the keys.
        let mut givers: HashMap<&str, (String, String)> = HashMap::new();
        for group in given {
            for (key, value) in &group.settings {
                let (giver, removal) = group.source(key);
                let refused = |reason: &str| {
                    let value = format_value(value);
                    anyhow::anyhow!("parameter {giver} is {value}: {reason}; correct it, or {removal}")
                };
                let given = Value::try_from(value).map_err(|error| refused(&error.to_string()))?;
                table.insert(key.clone(), given);
                if let Err(error) = table.clone().try_into::<Config>() {
                    return Err(refused(error.message().trim()));
                }
                givers.insert(key, (giver, removal));
            }
        }
        let config: Config = table.clone().try_into()?;
        if let Err(wrong) = config.check().and_then(|()| config.check_combined()) {
            let mut measures = OUTPUT_MEASURES.iter();
            let other = match wrong.key {
                "desire" => "max",
                "max" => "desire",
                "request" => "requests",
                key => measures.find(|measure| measure.desired_key == key).map_or("", |measure| measure.key),
            };
            let giver = givers.get(wrong.key).or_else(|| givers.get(other));
            match giver {
                Some((giver, removal)) => {
                    bail!("parameter {giver}: {wrong}; correct it, or {removal}")
                }
                None => return Err(wrong.into()),
            }
        }
        apply_overrides(table, std::iter::empty())
    }
}

fn format_value(value: &ParamValue) -> String {
    match value {
        ParamValue::String(text) => format!("{text:?}"),
        ParamValue::Int(number) => number.to_string(),
        ParamValue::Double(number) => number.to_string(),
        ParamValue::Bool(yes) => yes.to_string(),
        _ => "not a single value".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::LocalMode;

    fn group(name: &str, settings: &[(&str, ParamValue)]) -> ParameterGroup {
        let settings = settings.iter();
        ParameterGroup {
            name: Some(name.to_owned()),
            settings: settings.map(|(key, value)| ((*key).to_owned(), value.clone())).collect(),
        }
    }

    fn config(given: &[ParameterGroup]) -> anyhow::Result<Config> {
        let file: Config = toml::from_str("server = 'ws://cloud:9090'\nservice = 's'\n")?;
        file.with_parameters(given)
    }

    fn text(text: &str) -> ParamValue {
        ParamValue::String(text.to_owned())
    }

    #[test]
    fn a_node_is_in_its_namespaces() {
        assert_eq!(group_names("/reporter"), ["/cloudroid", "/reporter/cloudroid"]);
        assert_eq!(
            group_names("/a/b/reporter"),
            ["/cloudroid", "/a/cloudroid", "/a/b/cloudroid", "/a/b/reporter/cloudroid"]
        );
    }

    #[test]
    fn the_nearest_wins() {
        let (half, two) = (ParamValue::Double(0.5), ParamValue::Int(2));
        let config = config(&[
            group("/cloudroid", &[("desire", half.clone()), ("max", two.clone())]),
            group("/front/cloudroid", &[("max", ParamValue::Int(1)), ("local", text("warm"))]),
            group("/front/reporter/cloudroid", &[("local", text("first-sign"))]),
        ])
        .unwrap();
        assert_eq!((config.desire, config.max), (Some(0.5), Some(1.0)));
        assert_eq!(config.local, LocalMode::FirstSign);
    }

    #[test]
    fn half_a_promise_may_be_in_the_file() {
        let file = "server = 'ws://cloud:9090'\nservice = 's'\ndesire = 0.5";
        let file: Config = toml::from_str(file).unwrap();
        let max = [group("/cloudroid", &[("max", ParamValue::Int(1))])];
        assert_eq!(file.with_parameters(&max).unwrap().max, Some(1.0));
        let error = file.with_parameters(&[]).unwrap_err().to_string();
        assert!(error.contains("desire is given without max"), "{error}");
    }

    #[test]
    fn what_cannot_be_is_named_with_its_parameter() {
        let (one, two) = (ParamValue::Int(1), ParamValue::Int(2));
        for (settings, words) in [
            (
                vec![("desire", two.clone()), ("max", one.clone())],
                vec!["desire (2 s) is greater than max (1 s)", "lower it"],
            ),
            (
                vec![("desire", ParamValue::Double(-0.5)), ("max", one.clone())],
                vec!["desire is -0.5", "greater than 0"],
            ),
            (vec![("desire", text("soon"))], vec!["desire is \"soon\"", "expected f64"]),
            (vec![("desire", one.clone())], vec!["desire is given without max"]),
            (vec![("desre", one.clone())], vec!["desre is 1", "unknown field"]),
            (vec![("local", text("hot"))], vec!["local is \"hot\"", "first-sign"]),
            (
                vec![("desired_frames_per_second", one.clone()), ("frames_per_second", two.clone())],
                vec!["(1) is less than frames_per_second (2)", "raise it"],
            ),
            (
                vec![("desired_age", two.clone()), ("age", one.clone())],
                vec!["desired_age (2 s) is greater than age (1 s)"],
            ),
            (vec![("desired_age", two.clone())], vec!["desired_age is given without age"]),
            (vec![("request", text("auto")), ("requests", text("/a -> /b"))], vec!["both given"]),
            (vec![("max", ParamValue::List(vec![]))], vec!["max is not a single value", "f64"]),
        ] {
            let error = config(&[group("/front/cloudroid", &settings)]).unwrap_err();
            let error = format!("{error:#}");
            let named = format!("parameter /front/cloudroid/{}", settings[0].0);
            assert!(error.starts_with(&named), "{error}");
            assert!(error.contains(&format!("rosparam delete /front/cloudroid/{}", settings[0].0)), "{error}");
            for words in words {
                assert!(error.contains(words), "{words}: {error}");
            }
        }
    }
}
