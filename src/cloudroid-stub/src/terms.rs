//! Requirements that the robot states when it requests its servant, before it is admitted, in the query of each
//! handshake. A server of an earlier version ignores them.

use std::fmt::Write;

use crate::config::{Aux, Config, OUTPUT_MEASURES, Scalar};

/// Maximum length of a name or of an auxiliary parameter's value in bytes; the server has the same limit.
const LONGEST: usize = 64;
/// Maximum number of auxiliary parameters; the server has the same limit.
const MOST_AUX: usize = 16;
/// Minimum memory in bytes; no node works with less.
const LEAST_MEMORY: f64 = (4 << 20) as f64;
/// Range of the number of cores; the server has the same limits.
const CPUS: std::ops::RangeInclusive<f64> = 0.01..=4096.0;

/// Rejects settings that the server would reject. The error is the key, and the reason with the expected value.
pub fn check(config: &Config) -> Result<(), (&'static str, String)> {
    if let Some(cpus) = config.cpus.filter(|cpus| !CPUS.contains(cpus)) {
        let reason = format!("is {cpus}; it should be a number of cores from {} to {}", CPUS.start(), CPUS.end());
        return Err(("cpus", reason));
    }
    if let Some(memory) = &config.memory {
        match parse_size(memory) {
            Some(bytes) if bytes >= LEAST_MEMORY => {}
            Some(_) => {
                return Err(("memory", format!("is {memory}, too little for any node; it should be at least 4M")));
            }
            None => {
                return Err((
                    "memory",
                    format!("is {memory}; it should be bytes, or a number with K, M, G or T, such as \"512M\""),
                ));
            }
        }
    }
    if let Some(class) = &config.class {
        let fits = |byte: u8| byte.is_ascii_alphanumeric() || b"-_".contains(&byte);
        if class.is_empty() || class.len() > LONGEST || !class.bytes().all(fits) {
            let reason = format!("is {class:?}; it should be the name of a class, of letters, digits, - and _");
            return Err(("class", reason));
        }
    }
    if let Some(aux) = &config.aux {
        let pairs = aux.pairs();
        let pairs = pairs.map_err(|error| ("aux", error.to_string()))?;
        if pairs.len() > MOST_AUX {
            let reason = format!("has {} parameters; give at most {MOST_AUX}", pairs.len());
            return Err(("aux", reason));
        }
        let fits = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.".contains(&byte);
        for (key, value) in pairs {
            if key.is_empty() || key.len() > LONGEST || !key.bytes().all(fits) {
                let reason =
                    format!("names {key:?}; a name should be of letters, digits, -, _ and ., at most {LONGEST}");
                return Err(("aux", reason));
            }
            if value.is_empty() || value.len() > LONGEST || value.chars().any(char::is_control) {
                let reason =
                    format!("gives {key} the value {value:?}; it should have 1 to {LONGEST} bytes, such as 640");
                return Err(("aux", reason));
            }
        }
    }
    Ok(())
}

/// Parses a size in bytes.
fn parse_size(size: &Scalar) -> Option<f64> {
    let text = match size {
        Scalar::Number(number) => return Some(*number).filter(|number| number.is_finite()),
        Scalar::Text(text) => text.trim().to_ascii_uppercase(),
    };
    let bare = text.trim_end_matches('B').trim_end_matches('I').trim_end();
    let (digits, unit) = match bare.char_indices().last() {
        Some((at, 'K')) => (&bare[..at], 1_u64 << 10),
        Some((at, 'M')) => (&bare[..at], 1 << 20),
        Some((at, 'G')) => (&bare[..at], 1 << 30),
        Some((at, 'T')) => (&bare[..at], 1 << 40),
        _ => (bare, 1),
    };
    let number: f64 = digits.trim().parse().ok()?;
    Some(number * unit as f64).filter(|bytes| bytes.is_finite())
}

/// Returns the requirements of a node as query parameters, each preceded by `&`, including the first.
pub fn to_query(config: &Config, node: &str) -> String {
    let number = |value: Option<f64>| value.map(|value| value.to_string());
    let mut pairs = vec![("node".to_owned(), node.to_owned())];
    let times = [("rrt", config.desire), ("max_rrt", config.max)];
    let measured =
        OUTPUT_MEASURES.iter().flat_map(|measure| measure.stated_keys.into_iter().zip(measure.values(config)));
    let numbers = times.into_iter().chain(measured);
    let numbers = numbers.map(|(key, value)| (key, number(value)));
    let others = [
        ("class", config.class.clone()),
        ("cpus", number(config.cpus)),
        (
            "memory",
            config.memory.as_ref().map(|memory| match memory {
                Scalar::Number(bytes) => format!("{bytes:.0}"),
                text => text.to_string(),
            }),
        ),
    ];
    for (key, value) in numbers.chain(others) {
        pairs.extend(value.map(|value| (key.to_owned(), value)));
    }
    let aux = config.aux.as_ref().map(Aux::pairs);
    for (key, value) in aux.and_then(Result::ok).unwrap_or_default() {
        pairs.push((format!("aux.{key}"), value));
    }
    let mut query = String::new();
    for (key, value) in pairs {
        let _ = write!(query, "&{key}=");
        for byte in value.bytes() {
            match byte {
                b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'_' | b'.' | b'~' | b'/' => {
                    query.push(char::from(byte));
                }
                other => {
                    let _ = write!(query, "%{other:02X}");
                }
            }
        }
    }
    query
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(settings: &str) -> Config {
        toml::from_str(&format!("server = 'ws://cloud:9090'\nservice = 's'\n{settings}")).unwrap()
    }

    #[test]
    fn all_that_is_set_is_stated() {
        for (settings, expected) in [
            ("", "&node=/a/b"),
            ("desire = 0.1\nmax = 0.3", "&node=/a/b&rrt=0.1&max_rrt=0.3"),
            ("frames_per_second = 5", "&node=/a/b&min_fps=5"),
            ("frames_per_second = 5\ndesired_frames_per_second = 10", "&node=/a/b&fps=10&min_fps=5"),
            ("age = 0.5", "&node=/a/b&max_age=0.5"),
            ("age = 0.5\ndesired_age = 0.25", "&node=/a/b&age=0.25&max_age=0.5"),
            ("class = 'urgent'\ncpus = 1.5\nmemory = '1G'", "&node=/a/b&class=urgent&cpus=1.5&memory=1G"),
            ("memory = 1073741824", "&node=/a/b&memory=1073741824"),
            ("aux = { width = 640, model = 'a b&c' }", "&node=/a/b&aux.model=a%20b%26c&aux.width=640"),
            ("aux = 'width=640 model=big'", "&node=/a/b&aux.width=640&aux.model=big"),
        ] {
            let config = config(settings);
            check(&config).unwrap();
            assert_eq!(to_query(&config, "/a/b"), expected, "{settings}");
        }
    }

    #[test]
    fn what_the_server_would_refuse_is_named_with_what_to_write() {
        for (settings, key, words) in [
            ("cpus = 0", "cpus", "is 0; it should be a number of cores from 0.01"),
            ("cpus = nan", "cpus", "is NaN"),
            ("memory = 'lots'", "memory", "is lots; it should be bytes"),
            ("memory = '1K'", "memory", "too little for any node"),
            ("memory = ''", "memory", "such as \"512M\""),
            ("class = ''", "class", "should be the name of a class"),
            ("class = 'a b'", "class", "is \"a b\""),
            ("aux = 'width'", "aux", "write KEY=VALUE"),
            ("aux = { 'a b' = 1 }", "aux", "names \"a b\""),
            ("aux = { width = '' }", "aux", "gives width the value \"\""),
        ] {
            let (named, reason) = check(&config(settings)).unwrap_err();
            assert_eq!(named, key);
            assert!(reason.contains(words), "{settings}: {reason}");
        }
        let many: Vec<String> = (0..17).map(|n| format!("k{n}=1")).collect();
        let (_, reason) = check(&config(&format!("aux = '{}'", many.join(" ")))).unwrap_err();
        assert!(reason.contains("at most 16"), "{reason}");
    }
}
