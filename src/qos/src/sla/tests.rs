use super::*;

fn parse(text: &str) -> Result<QosSla, SlaError> {
    QosSla::parse(toml::Deserializer::parse(text).unwrap())
}

#[test]
fn two_times_are_enough() {
    let sla = parse("t_desire = 0.1\nt_max = '300ms'").unwrap();
    assert_eq!(sla.t_desire, Duration::from_millis(100));
    assert_eq!(sla.t_max, Duration::from_millis(300));
    assert_eq!((sla.threshold, sla.initial, sla.cap), (4.0, 8.0, 16.0));
    assert_eq!((sla.mode, sla.local), (Mode::Stateless, LocalPolicy::Cold));
    assert_eq!(sla.answers, None);
}

#[test]
fn the_cap_follows_the_threshold_unless_it_is_given() {
    let cap = |more: &str| parse(&format!("t_desire = 1\nt_max = 1\n{more}")).map(|sla| sla.cap);
    assert_eq!(cap("threshold = 3"), Ok(12.0));
    assert_eq!(cap("threshold = 3\ncap = 5"), Ok(5.0));
    assert_eq!(cap("cap = inf"), Ok(f64::INFINITY));
}

#[test]
fn everything_can_be_said() {
    let sla = parse(
        "t_desire = 1\nt_max = 2\nthreshold = 3\ninitial = 5.5\nmode = 'stateful'\nlocal = 'warm'\n\
         warm = 'first-sign'\nanswers = ['/image -> /found']\n\
         safe_stop = { topic = '/cmd_vel', type = 'geometry_msgs/Twist', message = { linear = { x = 0 } } }\n\
         [requests.'/plan']\nt_desire = 5\nt_max = '20 s'",
    )
    .unwrap();
    assert_eq!(sla.times("/plan").t_max, Duration::from_secs(20));
    assert_eq!(sla.times("/other").t_max, Duration::from_secs(2));
    assert_eq!(sla.warm, WarmStart::FirstSign);
    assert_eq!(sla.answers.unwrap()[0].outputs, ["/found"]);
    assert_eq!(sla.safe_stop.unwrap().type_name, "geometry_msgs/Twist");
}

#[test]
fn other_measures_bring_their_limits() {
    let sla = parse("measure.frames_per_second = { output = '/map', desire = 10, min = 4 }").unwrap();
    assert_eq!(sla.t_desire, Duration::from_millis(100));
    assert_eq!(sla.t_max, Duration::from_millis(250));
    let sla = parse("measure.age = { output = '/map', desire = 0.5, max = 2 }").unwrap();
    assert_eq!(sla.t_max, Duration::from_secs(2));
    assert_eq!(sla.measure, Measure::Age { output: "/map".into() });
}

#[test]
fn what_is_wrong_is_named_with_its_field() {
    for (text, field, reason) in [
        ("t_max = 1", "t_desire", "missing"),
        ("t_desire = 1", "t_max", "missing"),
        ("t_desire = 2\nt_max = 1", "t_max", "below t_desire"),
        ("t_desire = 0\nt_max = 1", "t_desire", "\"0\" is not a time"),
        ("t_desire = nan\nt_max = 1", "t_desire", "\"NaN\""),
        ("measure.age = { desire = '1 day', max = 2 }", "measure.age.desire", "\"1 day\""),
        ("measure.frames_per_second = { desire = 1e12, min = 1 }", "measure.frames_per_second.desire", "a billion"),
        ("t_desire = 'soon'\nt_max = 1", "t_desire", "\"soon\""),
        ("t_desire = 100\nt_max = 300000", "t_max", "day"),
        ("t_desire = true\nt_max = 1", "t_desire", "a time"),
        ("t_desire = 1\nt_max = 1\nthreshold = -1", "threshold", "positive"),
        ("t_desire = 1\nt_max = 1\nthreshold = 'x'", "threshold", "string"),
        ("t_desire = 1\nt_max = 1\ninitial = inf", "initial", "positive"),
        ("t_desire = 1\nt_max = 1\nthreshold = 3\ncap = 3", "cap", "not above threshold (3)"),
        ("t_desire = 1\nt_max = 1\ncap = nan", "cap", "NaN"),
        ("t_desire = 1\nt_max = 1\ncap = -inf", "cap", "not above"),
        ("t_desire = 1\nt_max = 1\nmode = 'x'", "mode", "stateless"),
        ("t_desire = 1\nt_max = 1\nlocal = 'hot'", "local", "warm"),
        ("t_desire = 1\nt_max = 1\nwarm = 'at-once'", "warm", "local"),
        ("t_desire = 1\nt_max = 1\nt_maximal = 1", "t_maximal", "unknown field"),
        ("t_desire = 1\nt_max = 1\nanswers = ['/a']", "answers[0]", "arrow"),
        ("t_desire = 1\nt_max = 1\nsafe_stop = { topic = 'v', type = 'a/B' }", "safe_stop.topic", "slash"),
        ("t_desire = 1\nt_max = 1\nsafe_stop = { topic = '/v', type = 'B' }", "safe_stop.type", "package/Type"),
        ("t_max = 1\nmeasure.age = { output = '/m', desire = 1, max = 2 }", "t_max", "measure"),
        ("measure.age = { output = '/m', desire = 3, max = 2 }", "measure.age.max", "below desire"),
        (
            "measure.frames_per_second = { output = '/m', desire = 3, min = 4 }",
            "measure.frames_per_second.min",
            "above desire",
        ),
        ("t_desire = 1\nt_max = 1\nrequests.'/p' = { t_desire = 2, t_max = 1 }", "requests./p.t_max", "below"),
    ] {
        let error = parse(text).unwrap_err();
        assert_eq!(error.field, field, "{text}: {error}");
        assert!(error.reason.contains(reason), "{text}: {error}");
    }
}

#[test]
fn ros_parameters_do_as_well() {
    let sla = QosSla::parse(serde_json::json!({"t_desire": 1, "t_max": 2.5})).unwrap();
    assert_eq!(sla.t_max, Duration::from_millis(2500));
    let error = QosSla::parse(serde_json::json!({"t_desire": [1], "t_max": 2.5})).unwrap_err();
    assert_eq!(error.field, "t_desire");
}
