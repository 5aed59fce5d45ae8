//! All that a robot does of ROS 2, against the herald.

use std::time::Duration;

use anyhow::{Context, Result};
use roslibrust::rosbridge::ClientHandle;
use roslibrust::{MessageDescriptor, RosMessageType, RosServiceType};
use serde::{Deserialize, Serialize};
use tokio::time::timeout;

use crate::{check, message, patience, service};

/// A message that will come is nearly always there by then.
const MOMENT: Duration = Duration::from_millis(200);

message!(Text, "std_msgs/msg/String", { data: String });
message!(Stamp, "builtin_interfaces/msg/Time", { sec: i32, nanosec: u32 });
message!(Point, "geometry_msgs/msg/Point", { x: f64, y: f64, z: f64 });
message!(Greeting, "herald_msgs/msg/Greeting", { stamp: Stamp, manner: u8, text: String, wide: String,
    at: Vec<Point> });
message!(Named, "herald_msgs/srv/Greet_Request", { name: String });
message!(Greeted, "herald_msgs/srv/Greet_Response", { greeting: Greeting, known: bool });
message!(Switch, "std_srvs/srv/SetBool_Request", { data: bool });
message!(Switched, "std_srvs/srv/SetBool_Response", { success: bool, message: String });
message!(Nothing, "std_srvs/srv/Empty_Request", {});
message!(Names, "rosapi_msgs/srv/Services_Response", { services: Vec<String> });
message!(Now, "rosapi_msgs/srv/GetTime_Response", { time: Stamp });
message!(Key, "rosapi_msgs/srv/GetParam_Request", { name: String });
message!(Value, "rosapi_msgs/srv/GetParam_Response", { value: String, successful: bool, reason: String });
message!(Entry, "rosapi_msgs/srv/SetParam_Request", { name: String, value: String });
message!(Done, "rosapi_msgs/srv/SetParam_Response", { successful: bool, reason: String });
service!(Greet, "herald_msgs/srv/Greet", Named, Greeted);
service!(SetBool, "std_srvs/srv/SetBool", Switch, Switched);
service!(Services, "rosapi_msgs/srv/Services", Nothing, Names);
service!(GetTime, "rosapi_msgs/srv/GetTime", Nothing, Now);
service!(GetParam, "rosapi_msgs/srv/GetParam", Key, Value);
service!(SetParam, "rosapi_msgs/srv/SetParam", Entry, Done);

fn text(data: &str) -> Text {
    let data = data.to_owned();
    Text { data }
}

fn greet_request(name: &str) -> Named {
    let name = name.to_owned();
    Named { name }
}

/// `ros` and `other` are of one robot.
pub async fn does_all(ros: ClientHandle, other: ClientHandle) -> Result<()> {
    let talk = ros.advertise::<Text>("/talk").await?;
    let said = ros.subscribe::<Text>("/talk").await?;
    talk.publish(&text("to myself")).await?;
    let heard = timeout(patience(), said.next()).await?;
    check("a topic both ways", heard == text("to myself"))?;
    let greetings = ros.subscribe::<Greeting>("/greeting").await?;
    let names = ros.advertise::<Text>("/name").await?;
    // What the node says before it hears of the subscription is lost, as in every ROS.
    let greeted = async {
        loop {
            names.publish(&text("crowd")).await?;
            if let Ok(greeting) = timeout(MOMENT, greetings.next()).await {
                return anyhow::Ok(greeting);
            }
        }
    };
    let greeting = timeout(patience(), greeted).await??;
    check("a node's topic", greeting.text == "Hello, crowd")?;
    let is_now = greeting.stamp.sec > 1_500_000_000;
    check(
        "its fields",
        is_now && greeting.manner == 1 && greeting.at.len() == 2,
    )?;

    let greeted = ros.call_service::<Greet>("/greet", greet_request("Jürgen")).await?;
    let greets = greeted.greeting.wide == "HELLO, JÜRGEN" && !greeted.known;
    check("a node's service", greets)?;
    let light = |request: Switch| {
        Ok(Switched {
            success: request.data,
            message: "lit".to_owned(),
        })
    };
    let _lamp = ros.advertise_service::<SetBool, _>("/lamp", light).await?;
    while !other
        .call_service::<Services>("/rosapi/services", Nothing {})
        .await?
        .services
        .contains(&"/lamp".to_owned())
    {}
    // As in ROS 1, it is asked again.
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

    let name = "/herald:salutation".to_owned();
    let key = Key { name: name.clone() };
    let kept = ros
        .call_service::<GetParam>("/rosapi/get_param", key)
        .await?;
    check("a parameter", kept.value == "\"Hello\"" && kept.successful)?;
    let value = "\"Hail\"".to_owned();
    let entry = Entry { name, value };
    let done = ros
        .call_service::<SetParam>("/rosapi/set_param", entry)
        .await?;
    check("a parameter set", done.successful)?;
    let greeted = ros.call_service::<Greet>("/greet", greet_request("Jürgen")).await?;
    let hails = greeted.greeting.text == "Hail, Jürgen" && greeted.known;
    check("set in the node", hails)?;
    let now = ros
        .call_service::<GetTime>("/rosapi/get_time", Nothing {})
        .await;
    let now = now.context("the time")?;
    check("time", now.time.sec > 1_500_000_000)?;
    println!("done");
    Ok(())
}
