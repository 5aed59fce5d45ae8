//! How fast messages pass the bridge, beside a relay that only moves bytes over the same hops:
//! `cargo run --release -p bridge --example speed [PART OF A TITLE]`.
//!
//! Node, bridge and client have a runtime each, all on loopback. Sender and receiver keep a window of messages under
//! way, so nothing is dropped and the slowest hop decides.

mod round_trip;
mod throughput;
mod world;

use round_trip::{relay_round_trip, round_trip};
use throughput::{inward, out, relayed};
use world::{message, world};

type Failure = Box<dyn std::error::Error + Send + Sync>;

fn main() -> Result<(), Failure> {
    let only = std::env::args().nth(1).unwrap_or_default();
    let world = world()?;
    if "round trip".contains(&only) {
        let (floor, string, service) = (
            world.ours.block_on(relay_round_trip(&world))?,
            round_trip(&world, false)?,
            round_trip(&world, true)?,
        );
        println!("round trip, µs at p50 and p99 (and as multiples of the byte relay's)");
        for (what, found) in [
            ("byte relay", floor),
            ("string there and back", string),
            ("service call", service),
        ] {
            let [p50, p99] = found.map(|time| time.as_secs_f64() * 1e6);
            let [floor50, floor99] = floor.map(|time| time.as_secs_f64() * 1e6);
            println!(
                "  {what:<24}{p50:>8.0} ({:.2}) {p99:>8.0} ({:.2})",
                p50 / floor50,
                p99 / floor99
            );
        }
    }
    for (title, type_name, size, window) in [
        ("string", "std_msgs/String", 20, 64),
        ("image", "sensor_msgs/Image", 921_600, 8),
    ] {
        let message = message(&world, type_name, size)?;
        let floor = world
            .theirs
            .block_on(relayed(&world, message.len(), window))?;
        println!(
            "\n{title}, {} bytes of ROS; byte relay {floor:.0}/s",
            message.len()
        );
        let show = |what: &str, rate: f64| {
            println!("  {what:<24}{rate:>10.0}/s {:>6.1} %", rate / floor * 100.0)
        };
        for encoding in ["none", "cbor", "cbor-raw"] {
            let what = format!("{title} out {encoding}");
            if what.contains(&only) {
                show(&what, out(&world, type_name, &message, encoding, window)?);
            }
        }
        for encoding in ["none", "cbor", "cbor-raw"] {
            let what = format!("{title} in {encoding}");
            if what.contains(&only) {
                show(
                    &what,
                    inward(&world, type_name, &message, encoding, window)?,
                );
            }
        }
    }
    Ok(())
}
