//! Name remapping by a node's command line, for ROS 1 and ROS 2.

use crate::bus::RosVersion;
use crate::ros2::arguments::{self, Kind, RemapTarget};
use crate::{ros1, ros2};

/// The remappings of one node, from absolute names used by its program to the registered names.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Remaps(Vec<Remap>);

#[derive(Debug, Clone, PartialEq, Eq)]
struct Remap {
    from: String,
    to: String,
}

impl Remaps {
    /// Parses the remappings of topics from the command line of the node of this absolute name. Arguments that no ROS
    /// accepts are ignored.
    pub fn parse(ros: RosVersion, argv: &[String], node: &str) -> Self {
        match ros {
            RosVersion::One => {
                let given = argv.iter().filter(|word| !word.starts_with('_'));
                let remap = |(from, to): (&str, &str)| Remap {
                    from: ros1::names::resolve(from, node),
                    to: ros1::names::resolve(to, node),
                };
                // If there are several for one name, the last one applies.
                let given = given.filter_map(|word| word.split_once(":=")).map(remap).rev();
                Self(given.collect())
            }
            RosVersion::Two => {
                let own = node.rsplit('/').next().unwrap_or(node);
                let parts = arguments::parse(argv).unwrap_or_default().into_iter();
                let remap = |kind: Kind| match kind {
                    Kind::Rule(rule)
                        if rule.of.is_name() && rule.of != RemapTarget::Service && rule.applies_to(own) =>
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

    /// Returns the registered name for the program's `name`.
    pub fn apply<'a>(&'a self, name: &'a str) -> &'a str {
        let remap = self.0.iter().find(|remap| remap.from == name);
        remap.map_or(name, |remap| &remap.to)
    }

    /// Returns the program's name for the registered `name`.
    pub fn undo<'a>(&'a self, name: &'a str) -> &'a str {
        let remap = self.0.iter().find(|remap| remap.to == name);
        remap.map_or(name, |remap| &remap.from)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse_remaps(ros: RosVersion, line: &str) -> Remaps {
        let argv: Vec<String> = line.split_whitespace().map(str::to_owned).collect();
        Remaps::parse(ros, &argv, "/front/finder")
    }

    #[test]
    fn names_are_found_both_ways() {
        let one = "3 image:=/left image:=/camera/image ~out:=boxes _rate:=2 __name:=finder /abs:=other";
        let two = "3 --ros-args -r image:=/camera/image -r image:=/left -r ~/out:=boxes -p rate:=2 -r __node:=finder \
                   -r other:mask:=/m -r finder:/abs:=other";
        for (ros, line) in [(RosVersion::One, one), (RosVersion::Two, two)] {
            let remaps = parse_remaps(ros, line);
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
        assert_eq!(parse_remaps(RosVersion::Two, "--ros-args --nonsense"), Remaps::default());
    }
}
