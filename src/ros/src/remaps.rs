//! Which names a node's command line gives to what its program calls otherwise, in either ROS.

use crate::bus::RosVersion;
use crate::ros2::arguments::{self, Kind, Renamed};
use crate::{ros1, ros2};

/// The remaps of one node: absolute names as its program has them, and those that are registered.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Remaps(Vec<Remap>);

#[derive(Debug, Clone, PartialEq, Eq)]
struct Remap {
    from: String,
    to: String,
}

impl Remaps {
    /// Reads the remaps of topics from the command line of the node of this absolute name. What no ROS would take
    /// counts for none.
    pub fn of(ros: RosVersion, argv: &[String], node: &str) -> Self {
        match ros {
            RosVersion::One => {
                let given = argv.iter().filter(|word| !word.starts_with('_'));
                let remap = |(from, to): (&str, &str)| Remap {
                    from: ros1::names::resolve(from, node),
                    to: ros1::names::resolve(to, node),
                };
                // Of several for one name the last one counts.
                let given = given
                    .filter_map(|word| word.split_once(":="))
                    .map(remap)
                    .rev();
                Self(given.collect())
            }
            RosVersion::Two => {
                let own = node.rsplit('/').next().unwrap_or(node);
                let parts = arguments::parse(argv).unwrap_or_default().into_iter();
                let remap = |kind: Kind| match kind {
                    Kind::Rule(rule)
                        if rule.of.is_name()
                            && rule.of != Renamed::Service
                            && rule.concerns(own) =>
                    {
                        Some(Remap {
                            from: ros2::names::resolve(&rule.from, node),
                            to: ros2::names::resolve(&rule.to, node),
                        })
                    }
                    _ => None,
                };
                Self(parts.filter_map(|part| remap(part.kind)).collect())
            }
        }
    }

    /// The name that is registered for what the program calls `name`.
    pub fn apply<'a>(&'a self, name: &'a str) -> &'a str {
        let remap = self.0.iter().find(|remap| remap.from == name);
        remap.map_or(name, |remap| &remap.to)
    }

    /// What the program calls the registered `name`.
    pub fn undo<'a>(&'a self, name: &'a str) -> &'a str {
        let remap = self.0.iter().find(|remap| remap.to == name);
        remap.map_or(name, |remap| &remap.from)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(ros: RosVersion, line: &str) -> Remaps {
        let argv: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
        Remaps::of(ros, &argv, "/front/finder")
    }

    #[test]
    fn names_are_found_both_ways() {
        let one =
            "3 image:=/left image:=/camera/image ~out:=boxes _rate:=2 __name:=finder /abs:=other";
        let two = "3 --ros-args -r image:=/camera/image -r image:=/left -r ~/out:=boxes -p rate:=2 -r __node:=finder \
                   -r other:mask:=/m -r finder:/abs:=other";
        for (ros, line) in [(RosVersion::One, one), (RosVersion::Two, two)] {
            let remaps = of(ros, line);
            for (name, registered) in [
                ("/front/image", "/camera/image"),
                ("/front/finder/out", "/front/boxes"),
                ("/abs", "/front/other"),
                ("/front/mask", "/front/mask"),
                ("/image", "/image"),
            ] {
                assert_eq!(remaps.apply(name), registered, "{line}");
                assert_eq!(remaps.undo(registered), name, "{line}");
            }
        }
        assert_eq!(
            of(RosVersion::Two, "--ros-args --nonsense"),
            Remaps::default()
        );
    }
}
