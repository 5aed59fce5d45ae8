//! Connections of robots: the identity is that of the token, for the whole connection.

use anyhow::{Context, bail, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::robot::Robot;

use super::scene::{BreakinScene, server_state};

/// Credentials in a handshake: the path of the URL, and headers.
type HandshakeCredentials<'a> = (String, Vec<(&'a str, String)>);

/// Connecting as another robot, to another service, in another class, or with another's token.
pub fn nobody_is_somebody_else(scene: &BreakinScene) -> Verdict {
    let tokens = &scene.tokens;
    let before = server_state(&scene.daemon)?;
    let bearer = |token: &str| vec![("Authorization", format!("Bearer {token}"))];
    let offer = |token: &str| ("Sec-WebSocket-Protocol", format!("rosbridge, bearer.{token}"));
    let mut attempts: Vec<(HandshakeCredentials<'_>, &[u16])> = Vec::new();
    let rover = &tokens.rover;
    for path in [
        "adder_py?robot=r2",
        "adder_py?robot=R1",
        "adder_py?robot=r2&robot=r1",
        "adder_py?robot=r1%00r2",
        "adder_py?robot=r1%2Fr2",
        "adder_py?robot=",
        "adder_py?robot=*",
        "adder_py?robot=~abc",
        "adder_py?robot=%D1%801",
        "adder_py?class=gold",
        "adder_py?class=*",
        "adder_py/?robot=r2",
        "vault",
        "vault/",
        "vault?robot=r1",
        "vault?robot=r9",
        "%76ault",
        "adder_py/../vault",
        "adder_py%2f..%2fvault",
        "VAULT",
        "nothing_such",
        "api/v1/tokens",
        "api",
        "",
    ] {
        attempts.push(((path.to_owned(), bearer(rover)), &[400, 403, 404, 405]));
    }
    // Two tokens at once: the one shown in the more secure way counts, with its own rights only.
    for (path, headers) in [
        (format!("adder_py?robot=r2&token={}", tokens.other), bearer(rover)),
        (format!("adder_py?robot=r2&token={rover}&token={}", tokens.other), vec![]),
        (format!("vault?token={}", tokens.admin), bearer(rover)),
        (format!("vault?robot=r1&token={}", tokens.admin), vec![offer(rover)]),
        ("vault".to_owned(), [bearer(rover), vec![offer(&tokens.admin)]].concat()),
        (
            "vault".to_owned(),
            vec![("Sec-WebSocket-Protocol", format!("rosbridge, bearer.{rover}, bearer.{}", tokens.admin))],
        ),
    ] {
        attempts.push(((path, headers), &[400, 403]));
    }
    // Principals who may view may not connect; those who may publish are no robots of other services, and cannot take
    // another robot's name.
    for token in [&tokens.eve, &tokens.oscar] {
        for path in ["adder_py", "adder_py?robot=r1", "adder_py?robot=new", "vault?robot=new"] {
            attempts.push(((path.to_owned(), bearer(token)), &[403]));
        }
    }
    for (token, path) in [
        (&tokens.alice, "vault?robot=new"),
        (&tokens.alice, "adder_py?robot=r1"),
        (&tokens.alice, "adder_py?robot=r9"),
        (&tokens.bob, "adder_py?robot=new"),
        (&tokens.operator, "adder_py?robot=r1"),
        (&tokens.admin, "vault?robot=r9"),
    ] {
        attempts.push(((path.to_owned(), bearer(token)), &[403]));
    }
    // A servant cannot be looked into without permission to see it: not without a token, and as a robot only with its
    // own.
    let [r1, r2, r9] = &scene.servants;
    for (servant, token, status) in [
        (r2, Some(rover), &[403][..]),
        (r9, Some(rover), &[403]),
        (r1, Some(&tokens.other), &[403]),
        (r1, Some(&tokens.narrow), &[403]),
        (r9, Some(&tokens.eve), &[403]),
        (r9, Some(&tokens.alice), &[403]),
        (r1, Some(&tokens.over), &[401]),
        (r1, None, &[401]),
    ] {
        let headers = token.map_or_else(Vec::new, |token| bearer(token));
        for path in [
            format!("api/v1/servants/{servant}/inside"),
            format!("api/v1/servants/{servant}/inside?robot=r1"),
            format!("api/v1/servants/{servant}/inside/"),
            format!("api/v1/servants/x/../{servant}/inside"),
            format!("api/v1/servants/{servant}/%69nside"),
            format!("foxglove/{servant}"),
            format!("foxglove/{servant}/"),
            format!("foxglove/%2e%2e/{servant}"),
        ] {
            let door = [format!("api/v1/servants/{servant}/inside"), format!("foxglove/{servant}")];
            let plain = door.contains(&path);
            let status = if plain { status } else { &[400, 401, 403, 404] };
            attempts.push(((path, headers.clone()), status));
        }
    }
    // The stub's protocol has the same checks.
    let stub = ("Sec-WebSocket-Protocol", link::SUBPROTOCOL.to_owned());
    for (path, token, status) in [
        ("vault?robot=r1", Some(rover), &[403][..]),
        ("adder_py?robot=r2", Some(rover), &[403]),
        ("adder_py?robot=r3", Some(&tokens.narrow), &[403]),
        ("adder_py?robot=r1", Some(&tokens.eve), &[403]),
        ("adder_py?robot=r1", None, &[401]),
        ("adder_py?robot=r1", Some(&tokens.over), &[401]),
    ] {
        let mut headers = token.map_or_else(Vec::new, |token| bearer(token));
        headers.push(stub.clone());
        attempts.push(((path.to_owned(), headers), status));
    }
    for ((path, headers), status) in attempts {
        let headers: Vec<(&str, &str)> = headers.iter().map(|(name, value)| (*name, value.as_str())).collect();
        let url = scene.daemon.url(&path);
        match Robot::try_connect_with_headers(&url, &headers) {
            Ok(_) => bail!("{path} {headers:?} was let in"),
            Err(refusal) => ensure!(status.contains(&refusal.status), "{path} {headers:?}: {refusal}"),
        }
        scene.count_attempt();
    }
    // Without a token in the URL, and with an auth message later: only as the robot of the token.
    for (path, token) in [
        ("vault", rover),
        ("vault?robot=r9", rover),
        ("adder_py?robot=r2", rover),
        ("adder_py?robot=r1", &tokens.eve),
        ("adder_py?robot=r1", &tokens.alice),
        ("adder_py?class=gold", rover),
        ("nothing_such", rover),
    ] {
        let mut robot = scene.daemon.robot(path)?;
        robot.send(json!({"op": "auth", "mac": token}))?;
        let close = robot.wait_for_close().with_context(|| path.to_owned())?;
        ensure!(u16::from(close.code) == 1008, "{path}: {close:?}");
        scene.count_attempt();
    }
    ensure!(server_state(&scene.daemon)? == before, "{before:#}");
    Ok(())
}

/// A robot that may only subscribe to `/rosout`, and tries the other operations with other names and in other forms.
pub fn nobody_uses_what_it_is_not_granted(scene: &BreakinScene) -> Verdict {
    let tokens = &scene.tokens;
    let mut robot = scene.daemon.robot(&format!("adder_py?token={}", tokens.narrow))?;
    // It has authenticated already; authenticating again as an admin changes nothing.
    for who in [&tokens.admin, &tokens.other, &tokens.narrow] {
        robot.send(json!({"op": "auth", "mac": who}))?;
    }
    let call = |service: &str| json!({"op": "call_service", "service": service, "args": {"a": 1, "b": 2}});
    let fragment = |message: &Value, num: usize, total: usize, data: &str| {
        json!({"op": "fragment",
        "id": message["id"], "num": num, "total": total, "data": data})
    };
    let mut number = 0;
    for service in [
        "/add_two",
        "add_two",
        "//add_two",
        "/add_two/",
        "/./add_two",
        "/rosout/../add_two",
        "/ADD_TWO",
        "/add_two\u{0}",
        " /add_two",
        "/add_two ",
        "/add%5Ftwo",
        "/\u{430}dd_two",
        "/**",
        "*",
        "~add_two",
        "",
        "/rosapi/get_param",
        "/rosapi/set_param",
        "/rosapi/delete_param",
        "rosapi/set_param",
        "/rosapi//set_param",
        "/rosapi/../rosapi/set_param",
        "/adder/set_logger_level",
        "/rosout/get_loggers",
    ] {
        for form in ["whole", "one fragment", "fragments", "png"] {
            number += 1;
            let mut message = call(service);
            message["id"] = format!("n{number}").into();
            let text = message.to_string();
            // At a character boundary.
            let middle = text.char_indices().nth(text.chars().count() / 2);
            let (head, tail) = text.split_at(middle.map_or(0, |(at, _)| at));
            match form {
                "whole" => robot.send(message.clone())?,
                "one fragment" => robot.send(fragment(&message, 0, 1, &text))?,
                "fragments" => {
                    robot.send(fragment(&message, 1, 2, tail))?;
                    // An operation that is granted, in between.
                    robot.send(json!({"op": "subscribe", "topic": "/rosout"}))?;
                    robot.send(fragment(&message, 0, 2, head))?;
                }
                _ => robot.send(json!({"op": "png", "data": text}))?,
            }
            scene.count_attempt();
        }
    }
    for (operation, names) in [
        ("publish", json!({"topic": "/rosout", "msg": {"msg": "x"}})),
        ("publish", json!({"topic": "rosout", "msg": {}})),
        ("publish", json!({"topic": "/clock", "type": "rosgraph_msgs/Clock", "msg": {}})),
        ("advertise", json!({"topic": "/tf", "type": "tf2_msgs/TFMessage"})),
        ("advertise", json!({"topic": "/rosout", "type": "rosgraph_msgs/Log"})),
        ("subscribe", json!({"topic": "/tf"})),
        ("subscribe", json!({"topic": "/rosout/../tf"})),
        ("subscribe", json!({"topic": "/rosout_agg"})),
        ("subscribe", json!({"topic": "/**"})),
        ("subscribe", json!({"topic": "*"})),
        ("advertise_service", json!({"service": "/add_two", "type": "adder_py/AddTwo"})),
        ("advertise_service", json!({"service": "/rosout", "type": "std_srvs/Trigger"})),
        ("advertise_action", json!({"action": "/rosout", "type": "actionlib/Test"})),
        ("send_action_goal", json!({"action": "/rosout", "action_type": "actionlib/Test", "args": {"goal": 1}})),
        ("service_response", json!({"service": "/add_two", "id": "n1", "values": {"sum": 9}, "result": true})),
        ("Call_Service", json!({"service": "/add_two"})),
        ("call_service\u{0}", json!({"service": "/add_two"})),
    ] {
        let mut message = names;
        message["op"] = operation.into();
        message["id"] = "other".into();
        robot.send(message)?;
        scene.count_attempt();
    }
    // Answers are in order: an operation that was not refused before this answer was not executed either.
    robot.send(json!({"op": "call_service", "service": "/rosapi/get_time", "id": "last"}))?;
    let done = |said: &Value| said["op"] == "service_response" && said["result"] == true && said["id"] != "last";
    robot.wait_for("the last answer", |said| said["id"] == "last")?;
    ensure!(robot.has_not_heard(done)?, "something was done that is not granted");
    // Queries do not reveal more than it may use.
    for (asked, arguments) in [
        ("/rosapi/services", json!({})),
        ("/rosapi/topics", json!({})),
        ("/rosapi/nodes", json!({})),
        ("/rosapi/service_type", json!({"service": "/add_two"})),
        ("/rosapi/service_providers", json!({"service": "adder_py/AddTwo"})),
        ("/rosapi/services_for_type", json!({"type": "adder_py/AddTwo"})),
        ("/rosapi/node_details", json!({"node": "/adder"})),
        ("/rosapi/get_param_names", json!({})),
    ] {
        let told = robot.call(asked, arguments)?;
        ensure!(!told["values"].to_string().contains("add_two"), "{asked}: {told}");
        scene.count_attempt();
    }
    Ok(())
}
