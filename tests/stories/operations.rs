//! Every operation of rosbridge, with every grant: answered exactly where the table in docs/access.md says.

use anyhow::{Context, ensure};
use serde_json::{Value, json};
use support::Verdict;
use support::daemon::Daemon;
use support::robot::Robot;

use crate::access::{daemon, expired, pushes_adder, token};

const DOCUMENT: &str = include_str!("../../docs/access.md");
/// What grants are for.
const GRANTS: [&str; 4] = ["publish", "subscribe", "call", "advertise"];

/// The operations, each with what it needs, as the document has it; a unit test holds it to those that are known.
fn needs() -> anyhow::Result<Vec<(String, String)>> {
    let (_, table) = DOCUMENT
        .split_once("| operation | needs |\n")
        .context("the table of operations")?;
    let rows = table.lines().skip(1).take_while(|line| !line.is_empty());
    let cells = |row: &str| {
        let mut cells = row.trim_matches('|').split('|');
        let mut cell = || Some(cells.next()?.trim().trim_matches('`').to_owned());
        Some((cell()?, cell()?))
    };
    let rows: Vec<_> = rows.filter_map(cells).collect();
    ensure!(rows.len() >= 20, "the table was read badly: {rows:?}");
    Ok(rows)
}

/// A message of that operation which would be done where it is granted.
fn message(operation: &str) -> anyhow::Result<Value> {
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

/// The same in the one fragment that it needs.
fn fragmented(message: &Value) -> Value {
    json!({"op": "fragment", "id": "f", "num": 0, "total": 1, "data": message.to_string()})
}

/// Whether the message is refused to who sends it, for want of a grant.
fn is_refused(robot: &mut Robot, message: Value) -> anyhow::Result<bool> {
    robot.says(message)?;
    let not_heard = robot.has_not_heard(|said| said.to_string().contains("is not granted"))?;
    Ok(!not_heard)
}

/// Sends every operation over connections of their own, so that none depends on what was sent before it.
fn walks(daemon: &Daemon, who: &str, path: &str, granted: &[&str]) -> anyhow::Result<usize> {
    let mut walked = 0;
    for (operation, needs) in needs()? {
        if needs == "contents" {
            continue;
        }
        let message = message(&operation)?;
        let allowed = needs == "-" || granted.contains(&&*needs);
        for (message, form) in [
            (message.clone(), "bare"),
            (fragmented(&message), "fragment"),
        ] {
            let mut robot = daemon.robot(path)?;
            let refused = is_refused(&mut robot, message)
                .with_context(|| format!("{who}: {operation} ({form})"))?;
            ensure!(
                refused != allowed,
                "{who}: {operation} ({form}), which needs {needs}, was {}",
                if refused { "refused" } else { "done" }
            );
            robot.leaves()?;
            walked += 1;
        }
    }
    Ok(walked)
}

pub fn every_operation_is_done_where_the_table_says() -> Verdict {
    let daemon = daemon("operations")?;
    let adder = support::binaries::package("adder_py");
    let path = support::deployer::path_str(&adder);
    daemon
        .deployer()
        .types(&["push", path, "--node", "adder.py"])?
        .succeeded()?;
    // On a machine whose configuration names nobody.
    let mut walked = walks(&daemon, "local", "adder_py?robot=r0", &GRANTS)?;
    let alice = token(
        &daemon,
        &["alice", "--role", "deployer", "--service", "adder*"],
    )?;
    pushes_adder(&daemon, &alice, &["--name", "adder_own"])?.succeeded()?;
    let own = format!("adder_own?robot=r3&token={alice}");
    walked += walks(&daemon, "a deployer", &own, &GRANTS)?;
    for role in ["admin", "operator"] {
        let token = token(&daemon, &[role, "--role", role])?;
        walked += walks(
            &daemon,
            role,
            &format!("adder_py?robot={role}&token={token}"),
            &GRANTS,
        )?;
    }
    let robots = ["--role", "robot", "--service", "adder_py", "--robot"];
    let named = |name: &str| token(&daemon, &[&[name], &robots[..], &[name]].concat());
    let rover = named("rover")?;
    walked += walks(
        &daemon,
        "a robot",
        &format!("adder_py?token={rover}"),
        &GRANTS,
    )?;
    // With one grant alone, with all but that, and for other names than those that are used.
    for one in GRANTS {
        let others: Vec<&str> = GRANTS.into_iter().filter(|other| *other != one).collect();
        for (name, granted, names) in [
            (format!("only-{one}"), vec![one], "/**"),
            (format!("but-{one}"), others, "/**"),
        ] {
            let token = named(&name)?;
            let grants: Vec<String> = granted
                .iter()
                .map(|grant| format!("{grant}:{names}"))
                .collect();
            let mut allow = vec!["policy", "allow", &name];
            allow.extend(grants.iter().map(String::as_str));
            daemon.deployer().types(&allow)?.succeeded()?;
            walked += walks(&daemon, &name, &format!("adder_py?token={token}"), &granted)?;
        }
    }
    let elsewhere = named("elsewhere")?;
    let allow = ["policy", "allow", "elsewhere", "*:/other/**"];
    daemon.deployer().types(&allow)?.succeeded()?;
    walked += walks(
        &daemon,
        "elsewhere",
        &format!("adder_py?token={elsewhere}"),
        &[],
    )?;
    ensure!(walked > 300, "{walked} were walked");
    Ok(())
}

pub fn without_a_good_token_no_operation_is_heard() -> Verdict {
    let daemon = daemon("unheard")?;
    let adder = support::binaries::package("adder_py");
    let path = support::deployer::path_str(&adder);
    daemon
        .deployer()
        .types(&["push", path, "--node", "adder.py"])?
        .succeeded()?;
    let robot = |name: &str, robot: &str| {
        let words = [
            name,
            "--role",
            "robot",
            "--service",
            "adder_py",
            "--robot",
            robot,
        ];
        token(&daemon, &words)
    };
    let another = robot("another", "r2")?;
    let over = robot("over", "r1")?;
    daemon
        .deployer()
        .types(&["token", "revoke", "over"])?
        .succeeded()?;
    let expired = expired(&daemon)?;
    let viewer = token(
        &daemon,
        &["eve", "--role", "viewer", "--service", "adder_py"],
    )?;
    // At the door: as a query, which is checked as a header is.
    for (token, status) in [
        (&over, 401),
        (&expired, 401),
        (&another, 403),
        (&viewer, 403),
    ] {
        let url = daemon.url(&format!("adder_py?robot=r1&token={token}"));
        let Err(refusal) = Robot::try_connect(&url) else {
            anyhow::bail!("a connection was let in that should have got {status}")
        };
        ensure!(refusal.status == status, "{status}: {refusal}");
    }
    // Within, where the first message is to say who it is: nothing else is.
    for (operation, _) in needs()? {
        let Ok(first) = message(&operation) else {
            continue;
        };
        let messages = match &*operation {
            "auth" => vec![
                json!({"op": "auth", "mac": over}),
                json!({"op": "auth", "mac": expired}),
                json!({"op": "auth", "mac": another}),
                json!({"op": "auth", "mac": viewer}),
                fragmented(&json!({"op": "auth", "mac": another})),
            ],
            _ => vec![first.clone(), fragmented(&first)],
        };
        for message in messages {
            let mut robot = daemon.robot("adder_py?robot=r1")?;
            robot.says(message.clone())?;
            let close = robot
                .hears_close()
                .with_context(|| format!("after {message}"))?;
            ensure!(u16::from(close.code) == 1008, "{message}: {close:?}");
        }
    }
    ensure!(
        daemon.servant_of("adder_py", "r1").is_err(),
        "a servant was started for who never said who it is"
    );
    Ok(())
}
