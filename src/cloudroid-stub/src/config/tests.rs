use toml::Table;

use super::sources::{apply_overrides, key_for_variable};
use super::*;

const FILE: &str = "server = 'ws://cloud:9090/'\nservice = 'opencv_apps'\ndesire = 0.1\nmax = 1\n";

fn config(instead: &[(&str, &str)]) -> anyhow::Result<Config> {
    let instead = instead.iter().map(|(key, value)| ((*key).to_owned(), (*value).to_owned()));
    apply_overrides(toml::from_str(FILE)?, instead)
}

#[test]
fn the_file_is_enough() {
    let config = config(&[]).unwrap();
    assert_eq!(config.server, "ws://cloud:9090");
    assert_eq!((config.desire, config.max), (Some(0.1), Some(1.0)));
    assert_eq!((config.local, config.codec), (LocalMode::Cold, CodecSetting::Auto));
    let local = toml::from_str::<Config>(&format!("{FILE}local = 'first-sign'"));
    assert_eq!(local.unwrap().local, LocalMode::FirstSign);
}

#[test]
fn the_environment_says_otherwise() {
    assert_eq!(key_for_variable("CLOUDROID_LOCAL").as_deref(), Some("local"));
    assert_eq!(key_for_variable("CLOUDROID_HOME"), None);
    let config = config(&[("local", "warm"), ("max", "0.5"), ("stateful", "true")]).unwrap();
    assert_eq!((config.local, config.max, config.stateful), (LocalMode::Warm, Some(0.5), true));
}

#[test]
fn a_codec_that_one_side_has_not_is_named_with_what_to_do() {
    let has = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>();
    let with = |codec: &str| config(&[("codec", codec)]).unwrap().codec;
    assert_eq!(with("auto").unsupported_reason(&[]), None);
    assert_eq!(with("jpeg").unsupported_reason(&has(&["raw", "jpeg"])), None);
    let unmet = with("jpeg").unsupported_reason(&has(&["raw"])).unwrap();
    assert!(unmet.contains("codec = \"jpeg\" is not supported by the server"), "{unmet}");
    let unmet = with("video").unsupported_reason(&has(&["raw"])).unwrap();
    assert!(unmet.contains("codec = \"video\" is not"), "{unmet}");
    assert!(unmet.contains("set codec = \"jpeg\""), "{unmet}");
    let built = with("video").unsupported_reason(&has(&["raw", "video"]));
    assert_eq!(built.is_none(), codec::Codec::Video.is_available(), "{built:?}");
}

#[test]
fn quality_is_one_of_jpeg() {
    let given = config(&[("codec", "jpeg"), ("quality", "90")]).unwrap();
    assert_eq!((given.codec.lossy(), given.quality()), (Some(codec::Codec::Jpeg), Some(90)));
    given.with_parameters(&[]).unwrap();
    let alone = config(&[("quality", "90")]).unwrap().with_parameters(&[]);
    let error = format!("{:#}", alone.unwrap_err());
    assert!(error.contains("quality is given without codec = \"jpeg\""), "{error}");
}

#[test]
fn nonsense_is_named() {
    for (key, value, named) in [
        ("server", "cloud:9090", "server"),
        ("desire", "2", "desire"),
        ("local", "hot", "hot"),
        ("max", "soon", "max"),
        ("max", "nan", "max is NaN"),
        ("desire", "-1", "desire is -1"),
        ("age", "inf", "age is inf"),
        ("cap", "-1", "cap is -1"),
        ("desired_age", "nan", "desired_age is NaN"),
        ("codec", "mpeg", "mpeg"),
        ("quality", "0", "quality is 0; it should be a number from 1 to 100"),
        ("quality", "best", "quality"),
    ] {
        let error = format!("{:#}", config(&[(key, value)]).unwrap_err());
        assert!(error.contains(named), "{error}");
    }
}

/// Parses the `key = value` lines of a file, without comments.
fn parse_settings(lines: &str) -> Table {
    let settings = lines.lines().filter(|line| line.contains(" = "));
    toml::from_str(&settings.collect::<Vec<_>>().join("\n")).unwrap()
}

#[test]
fn what_comments_show_as_defaults_are_the_defaults() {
    let own = include_str!("../config.rs").lines();
    let own: String = own
        .filter_map(|line| line.strip_prefix("//! "))
        // The other form of the same key.
        .filter(|line| !line.starts_with("safe_stop = {"))
        .map(|line| format!("{line}\n"))
        .collect();
    let handed_out = include_str!("../../../package/src/stub/inside/settings.toml").lines();
    let handed_out: String =
        handed_out.filter_map(|line| line.strip_prefix("# ")).map(|line| format!("{line}\n")).collect();
    let minimal: Config = toml::from_str("server = 'ws://s'\nservice = 's'").unwrap();
    let mut defaults = Table::try_from(&minimal).unwrap();
    let sla = serde_json::json!({"t_desire": 1, "t_max": 1});
    let sla = qos::QosSla::parse(sla).unwrap();
    defaults.insert("threshold".to_owned(), sla.threshold.into());
    defaults.insert("initial".to_owned(), sla.initial.into());
    defaults.insert("cap".to_owned(), sla.cap.into());
    defaults.insert("request".to_owned(), "auto".into());
    // The values of these keys are examples, not defaults.
    defaults.retain(|key, _| !["server", "service", "nodes"].contains(&key));
    for (whose, text) in [("the code's", own), ("stub.toml's", handed_out)] {
        let mut all = parse_settings(&text);
        let mut seen = 0;
        for (key, default) in &defaults {
            if let Some(shown) = all.get(key) {
                assert_eq!(shown, default, "{whose} comment on {key}");
                seen += 1;
            }
        }
        assert!(seen >= 3, "{whose} comments show {seen} defaults");
        // All values that the comments show are valid.
        for (key, value) in [("server", "ws://s"), ("service", "s")] {
            all.insert(key.to_owned(), value.into());
        }
        all.try_into::<Config>().expect(whose);
    }
}
