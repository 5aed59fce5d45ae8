//! All that a robot does, with roslibrust against rosbridge_fixture. Prints `end my servant` and expects to be
//! connected to a new one; ends with `done`. Of ROS 2 all that it does against the herald.
//!
//! usage: robot-with-roslibrust URL [ros2]

mod ros2;

use std::time::Duration;

use anyhow::{Context, Result, ensure};
use roslibrust::rosbridge::{ClientHandle, ClientHandleOptions};
use roslibrust::{MessageDescriptor, RosMessageType, RosServiceType};
use serde::{Deserialize, Serialize};
use serde_json::json;
use tokio::time::{sleep, timeout};

/// How long it waits: longer on a busy machine.
pub(crate) fn patience() -> Duration {
    let seconds = std::env::var("STORY_PATIENCE").ok();
    let seconds = seconds.and_then(|seconds| seconds.parse().ok());
    Duration::from_secs(seconds.unwrap_or(60))
}

macro_rules! message {
    ($name:ident, $ros:literal, { $($field:ident: $kind:ty),* $(,)? }) => {
        #[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
        struct $name { $($field: $kind),* }

        impl RosMessageType for $name {
            const DESCRIPTION: MessageDescriptor = MessageDescriptor::new::<Self>($ros, "", "", "", &[0; 32]);
        }
    };
}

macro_rules! service {
    ($name:ident, $ros:literal, $request:ident, $response:ident) => {
        struct $name;

        impl RosServiceType for $name {
            const ROS_SERVICE_NAME: &'static str = $ros;
            type Request = $request;
            type Response = $response;
        }
    };
}

message!(Text, "std_msgs/String", { data: String });
message!(Pair, "rospy_tutorials/AddTwoIntsRequest", { a: i64, b: i64 });
message!(Sum, "rospy_tutorials/AddTwoIntsResponse", { sum: i64 });
message!(Switch, "std_srvs/SetBoolRequest", { data: bool });
message!(Switched, "std_srvs/SetBoolResponse", { success: bool, message: String });
message!(Nothing, "std_srvs/EmptyRequest", {});
message!(Names, "rosapi/ServicesResponse", { services: Vec<String> });
message!(Time, "std_msgs/Time", { secs: u32, nsecs: u32 });
message!(Now, "rosapi/GetTimeResponse", { time: Time });
message!(Entry, "rosapi/SetParamRequest", { name: String, value: String });
message!(Key, "rosapi/GetParamRequest", { name: String });
message!(Value, "rosapi/GetParamResponse", { value: String });
message!(GoalId, "actionlib_msgs/GoalID", { stamp: Time, id: String });
message!(Order, "actionlib_tutorials/FibonacciGoal", { order: i32 });
message!(Goal, "actionlib_tutorials/FibonacciActionGoal", { goal_id: GoalId, goal: Order });
message!(Sequence, "actionlib_tutorials/FibonacciResult", { sequence: Vec<i32> });
message!(Outcome, "actionlib_tutorials/FibonacciActionResult", { result: Sequence });
service!(AddTwoInts, "rospy_tutorials/AddTwoInts", Pair, Sum);
service!(SetBool, "std_srvs/SetBool", Switch, Switched);
service!(Services, "rosapi/Services", Nothing, Names);
service!(GetTime, "rosapi/GetTime", Nothing, Now);
service!(SetParam, "rosapi/SetParam", Entry, Nothing);
service!(GetParam, "rosapi/GetParam", Key, Value);

pub(crate) use {message, service};

fn check(what: &str, truth: bool) -> Result<()> {
    ensure!(truth, "{what}: not so");
    println!("{what}");
    Ok(())
}

#[tokio::main]
async fn main() -> Result<()> {
    let url = std::env::args().nth(1).context("a URL")?;
    let options = ClientHandleOptions::new(url).timeout(patience());
    let ros = ClientHandle::new_with_options(options.clone()).await?;
    if std::env::args().nth(2).is_some_and(|word| word == "ros2") {
        let other = ClientHandle::new_with_options(options).await?;
        return ros2::does_all(ros, other).await;
    }

    let talk = ros.advertise::<Text>("/talk").await?;
    let said = ros.subscribe::<Text>("/talk").await?;
    let words = Text {
        data: "to myself".to_owned(),
    };
    talk.publish(&words).await?;
    check(
        "a topic both ways",
        timeout(patience(), said.next()).await? == words,
    )?;
    let listener = ros.subscribe::<Text>("/listener").await?;
    let greeting = timeout(patience(), listener.next()).await?;
    check("a node's topic", greeting.data == "Hello, World")?;

    let answer = ros
        .call_service::<AddTwoInts>("/add_two_ints", Pair { a: 40, b: 2 })
        .await?;
    check("a node's service", answer.sum == 42)?;
    let light = |request: Switch| {
        Ok(Switched {
            success: request.data,
            message: "lit".to_owned(),
        })
    };
    let _lamp = ros.advertise_service::<SetBool, _>("/lamp", light).await?;
    let other = ClientHandle::new_with_options(options).await?;
    while !other
        .call_service::<Services>("/rosapi/services", Nothing {})
        .await?
        .services
        .contains(&"/lamp".to_owned())
    {}
    // Now and then roslibrust takes a call in and does not answer it: it is asked again.
    let answer = loop {
        let call = other.call_service::<SetBool>("/lamp", Switch { data: true });
        if let Ok(answer) = timeout(Duration::from_secs(3), call).await {
            break answer?;
        }
    };
    check(
        "a service of its own",
        answer.success && answer.message == "lit",
    )?;

    // It has no actions: their topics do.
    let results = ros.subscribe::<Outcome>("/fibonacci/result").await?;
    let goals = ros.advertise::<Goal>("/fibonacci/goal").await?;
    let id = GoalId {
        id: "of roslibrust".to_owned(),
        ..GoalId::default()
    };
    goals
        .publish(&Goal {
            goal_id: id,
            goal: Order { order: 5 },
        })
        .await?;
    let outcome = timeout(patience(), results.next()).await?;
    check(
        "an action's result",
        outcome.result.sequence == [0, 1, 1, 2, 3, 5, 8],
    )?;

    let name = "/with_roslibrust/word".to_owned();
    let value = json!({ "of": ["many", 1, 2.5] });
    let entry = Entry {
        name: name.clone(),
        value: value.to_string(),
    };
    ros.call_service::<SetParam>("/rosapi/set_param", entry)
        .await?;
    let kept = ros
        .call_service::<GetParam>("/rosapi/get_param", Key { name: name.clone() })
        .await?;
    check(
        "a parameter",
        serde_json::from_str::<serde_json::Value>(&kept.value)? == value,
    )?;
    let now = ros
        .call_service::<GetTime>("/rosapi/get_time", Nothing {})
        .await?;
    check("time", now.time.secs > 1_500_000_000)?;

    // It connects again by itself and subscribes again to what it had. The new servant does not know the parameter.
    println!("end my servant");
    loop {
        let ask = ros.call_service::<GetParam>("/rosapi/get_param", Key { name: name.clone() });
        match timeout(Duration::from_secs(3), ask).await {
            Ok(Ok(found)) if found.value != kept.value => break,
            _ => sleep(Duration::from_millis(10)).await,
        }
    }
    check("a new servant", true)?;
    while !listener.is_empty() {
        listener.next().await;
    }
    let greeting = timeout(patience(), listener.next()).await?;
    check("heard again", greeting.data == "Hello, World")?;
    println!("done");
    Ok(())
}
