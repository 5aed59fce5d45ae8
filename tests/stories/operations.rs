//! Every operation of rosbridge with every grant: permitted exactly as the table in docs/access.md specifies.

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;

use crate::access::{create_token, daemon, expired_token, push_adder};

const DOCUMENT: &str = include_str!("../../docs/access.md");
/// Kinds of grants.
const GRANTS: [&str; 4] = ["publish", "subscribe", "call", "advertise"];

/// Returns the operations and the grants that they need from the document, which a unit test compares with the known
/// operations.
fn documented_needs() -> anyhow::Result<Vec<(String, String)>> {
    let (_, table) = DOCUMENT.split_once("| needs | operations |\n").context("the table of operations")?;
    let rows = table.lines().skip(1).take_while(|line| !line.is_empty());
    let rows: Vec<(String, String)> = rows
        .filter_map(|row| row.trim_matches('|').split_once('|'))
        .flat_map(|(needs, names)| {
            let names = names.split('`').skip(1).step_by(2);
            names.map(|name| (name.to_owned(), needs.trim().to_owned()))
        })
        .collect();
    ensure!(rows.len() >= 20, "the table was read badly: {rows:?}");
    Ok(rows)
}

/// Returns a message of an operation that would be executed if it is granted.
fn sample_message(operation: &str) -> anyhow::Result<Value> {
    let names = match operation {
        "publish" => json!({"topic": "/said", "type": "std_msgs/String", "msg": {"data": "x"}}),
        "advertise" => json!({"topic": "/said", "type": "std_msgs/String"}),
        "unadvertise" => json!({"topic": "/said"}),
        "subscribe" => json!({"topic": "/rosout", "type": "rosgraph_msgs/Log"}),
        "unsubscribe" => json!({"topic": "/rosout"}),
        "call_service" => json!({"service": "/add_two", "args": {"a": 1, "b": 2}}),
        "service_response" => {
            json!({"service": "/mine", "id": "none", "values": {}, "result": true})
        }
        "advertise_service" => json!({"service": "/mine", "type": "std_srvs/Trigger"}),
        "unadvertise_service" => json!({"service": "/mine"}),
        "send_action_goal" => {
            json!({"action": "/goes", "action_type": "actionlib/Test", "id": "g", "args": {"goal": 1}})
        }
        "cancel_action_goal" => json!({"action": "/goes", "id": "g"}),
        "action_feedback" => json!({"action": "/mine", "id": "g", "values": {"feedback": 1}}),
        "action_result" => {
            json!({"action": "/mine", "id": "g", "values": {"result": 1}, "status": 4, "result": true})
        }
        "advertise_action" => json!({"action": "/mine", "type": "actionlib/Test"}),
        "unadvertise_action" => json!({"action": "/mine"}),
        "set_level" => json!({"level": "info"}),
        "status" => json!({"level": "info", "msg": "well"}),
        "auth" => json!({"mac": "none"}),
        _ => anyhow::bail!("the story has no message of {operation}"),
    };
    let mut message = names;
    message["op"] = operation.into();
    Ok(message)
}

/// Wraps a message in a single fragment.
fn to_fragment(message: &Value) -> Value {
    json!({"op": "fragment", "id": "f", "num": 0, "total": 1, "data": message.to_string()})
}

/// Returns whether the message is refused for lack of a grant.
fn is_refused(robot: &mut Robot, message: Value) -> anyhow::Result<bool> {
    robot.send(message)?;
    let not_heard = robot.has_not_heard(|said| said.to_string().contains("is not granted"))?;
    Ok(!not_heard)
}

/// Sends every operation on a connection of its own, so that none depends on earlier ones.
fn try_operations(daemon: &Daemon, who: &str, path: &str, granted: &[&str]) -> anyhow::Result<usize> {
    let mut walked = 0;
    for (operation, needs) in documented_needs()? {
        if needs == "contents" {
            continue;
        }
        let message = sample_message(&operation)?;
        let allowed = needs == "-" || granted.contains(&&*needs);
        for (message, form) in [(message.clone(), "bare"), (to_fragment(&message), "fragment")] {
            let mut robot = daemon.robot(path)?;
            let refused = is_refused(&mut robot, message).with_context(|| format!("{who}: {operation} ({form})"))?;
            ensure!(
                refused != allowed,
                "{who}: {operation} ({form}), which needs {needs}, was {}",
                if refused { "refused" } else { "done" }
            );
            robot.leave()?;
            walked += 1;
        }
    }
    Ok(walked)
}

pub fn every_operation_is_done_where_the_table_says() -> Verdict {
    let daemon = daemon("operations")?;
    let adder = support::binaries::package("adder_py");
    let path = support::deployer::path_str(&adder);
    daemon.deployer().run(&["push", path, "--node", "adder.py"])?.expect_success()?;
    // On a machine without principals.
    let mut walked = try_operations(&daemon, "local", "adder_py?robot=r0", &GRANTS)?;
    let alice = create_token(&daemon, &["alice", "--role", "deployer", "--service", "adder*"])?;
    push_adder(&daemon, &alice, &["--name", "adder_own"])?.expect_success()?;
    let own = format!("adder_own?robot=r3&token={alice}");
    walked += try_operations(&daemon, "a deployer", &own, &GRANTS)?;
    for role in ["admin", "operator"] {
        let token = create_token(&daemon, &[role, "--role", role])?;
        walked += try_operations(&daemon, role, &format!("adder_py?robot={role}&token={token}"), &GRANTS)?;
    }
    let robots = ["--role", "robot", "--service", "adder_py", "--robot"];
    let named = |name: &str| create_token(&daemon, &[&[name], &robots[..], &[name]].concat());
    let rover = named("rover")?;
    walked += try_operations(&daemon, "a robot", &format!("adder_py?token={rover}"), &GRANTS)?;
    // With a single grant, with all others, and with grants for other names.
    for one in GRANTS {
        let others: Vec<&str> = GRANTS.into_iter().filter(|other| *other != one).collect();
        for (name, granted, names) in [(format!("only-{one}"), vec![one], "/**"), (format!("but-{one}"), others, "/**")]
        {
            let token = named(&name)?;
            let grants: Vec<String> = granted.iter().map(|grant| format!("{grant}:{names}")).collect();
            let mut allow = vec!["policy", "allow", &name];
            allow.extend(grants.iter().map(String::as_str));
            daemon.deployer().run(&allow)?.expect_success()?;
            walked += try_operations(&daemon, &name, &format!("adder_py?token={token}"), &granted)?;
        }
    }
    let elsewhere = named("elsewhere")?;
    let allow = ["policy", "allow", "elsewhere", "*:/other/**"];
    daemon.deployer().run(&allow)?.expect_success()?;
    walked += try_operations(&daemon, "elsewhere", &format!("adder_py?token={elsewhere}"), &[])?;
    ensure!(walked > 300, "{walked} were walked");
    Ok(())
}

pub fn without_a_good_token_no_operation_is_heard() -> Verdict {
    let daemon = daemon("unheard")?;
    let adder = support::binaries::package("adder_py");
    let path = support::deployer::path_str(&adder);
    daemon.deployer().run(&["push", path, "--node", "adder.py"])?.expect_success()?;
    let robot = |name: &str, robot: &str| {
        let words = [name, "--role", "robot", "--service", "adder_py", "--robot", robot];
        create_token(&daemon, &words)
    };
    let another = robot("another", "r2")?;
    let over = robot("over", "r1")?;
    daemon.deployer().run(&["token", "revoke", "over"])?.expect_success()?;
    let expired = expired_token(&daemon)?;
    let viewer = create_token(&daemon, &["eve", "--role", "viewer", "--service", "adder_py"])?;
    // In the handshake, as a query, which is checked like a header.
    for (token, status) in [(&over, 401), (&expired, 401), (&another, 403), (&viewer, 403)] {
        let url = daemon.url(&format!("adder_py?robot=r1&token={token}"));
        let Err(refusal) = Robot::try_connect(&url) else {
            anyhow::bail!("a connection was let in that should have got {status}")
        };
        ensure!(refusal.status == status, "{status}: {refusal}");
    }
    // On an open connection the first message must be auth, and all others are ignored.
    for (operation, _) in documented_needs()? {
        let Ok(first) = sample_message(&operation) else {
            continue;
        };
        let messages = match &*operation {
            "auth" => vec![
                json!({"op": "auth", "mac": over}),
                json!({"op": "auth", "mac": expired}),
                json!({"op": "auth", "mac": another}),
                json!({"op": "auth", "mac": viewer}),
                to_fragment(&json!({"op": "auth", "mac": another})),
            ],
            _ => vec![first.clone(), to_fragment(&first)],
        };
        for message in messages {
            let mut robot = daemon.robot("adder_py?robot=r1")?;
            robot.send(message.clone())?;
            let close = robot.wait_for_close().with_context(|| format!("after {message}"))?;
            ensure!(u16::from(close.code) == 1008, "{message}: {close:?}");
        }
    }
    ensure!(daemon.servant_of("adder_py", "r1").is_err(), "a servant was started for who never said who it is");
    Ok(())
}
