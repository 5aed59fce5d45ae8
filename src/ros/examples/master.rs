//! A ROS Master for the command line: `cargo run -p ros --example master [-- ADDRESS]`, 127.0.0.1:11311 by
//! default. Prints what changes in the graph. A line on its standard input asks for more: `exited` looks for dead
//! nodes, `graph` and `snapshot` print everything.

use std::sync::Arc;

use ros::bus::Graph;
use ros::net::HostSockets;
use ros::ros1::master::{Master, MasterOptions};
use tokio::io::{AsyncBufReadExt as _, BufReader};
use tokio::net::TcpListener;

#[tokio::main(flavor = "current_thread")]
async fn main() -> std::io::Result<()> {
    let address = std::env::args().nth(1);
    let listener = TcpListener::bind(address.as_deref().unwrap_or("127.0.0.1:11311")).await?;
    let uri = format!("http://{}/", listener.local_addr()?);
    println!("export ROS_MASTER_URI={uri}");
    let master = Master::new(MasterOptions {
        uri,
        ..MasterOptions::default()
    });
    tokio::spawn(report(master.clone()));
    tokio::spawn(obey(master.clone()));
    master.serve(listener, Arc::new(HostSockets)).await;
    Ok(())
}

/// Prints every change of topics, services and nodes.
async fn report(master: Master) {
    let mut generation = master.generation();
    let mut before = Graph::default();
    while generation.changed().await.is_ok() {
        let now = master.graph();
        for line in lines(&before).filter(|line| !lines(&now).any(|other| other == *line)) {
            println!("- {line}");
        }
        for line in lines(&now).filter(|line| !lines(&before).any(|other| other == *line)) {
            println!("+ {line}");
        }
        before = now;
    }
}

fn lines(graph: &Graph) -> impl Iterator<Item = String> {
    let nodes = graph
        .nodes
        .iter()
        .map(|(name, uri)| format!("node {name} {uri}"));
    let topics = graph.topics.iter().flat_map(|(name, topic)| {
        let end = move |node: &String, does: &str| {
            format!("topic {name} [{}] {does} {node}", topic.type_name)
        };
        let publishers = topic.publishers.iter().map(move |node| end(node, "from"));
        let subscribers = topic.subscribers.iter().map(move |node| end(node, "to"));
        publishers.chain(subscribers)
    });
    let services = graph.services.iter();
    let services = services.map(|(name, node)| format!("service {name} of {node}"));
    nodes.chain(topics).chain(services)
}

async fn obey(master: Master) {
    let mut commands = BufReader::new(tokio::io::stdin()).lines();
    while let Ok(Some(command)) = commands.next_line().await {
        match command.trim() {
            "exited" => println!("gone: {:?}", master.process_exited().await),
            "graph" => println!("{:#?}", master.graph()),
            "snapshot" => match serde_json::to_string(&master.snapshot()) {
                Ok(text) => println!("{text}"),
                Err(error) => println!("{error}"),
            },
            other => println!("{other:?} is none of exited, graph, snapshot"),
        }
    }
}
