//! Division of Debian packages into two layers: first packages that other software builds on, then those of ROS.
//!
//! Two ROS packages of the same field share nearly all of their libraries (OpenCV, PCL, VTK: hundreds of megabytes) and
//! differ in ROS packages (a few megabytes). A single layer could not be shared at all. The lower layer is closed: it
//! depends on nothing in the upper one, so it is a complete system by itself.

use std::collections::{BTreeMap, BTreeSet};

use crate::debian_package::{Deb, Relations};

/// Minimum number of packages worth a separate layer.
const MIN_PACKAGES: usize = 8;

/// Returns whether this number of packages can be worth a division.
pub(crate) fn is_worth_splitting(count: usize) -> bool {
    count > MIN_PACKAGES
}

/// Divides `debs`; both parts keep the order. The first part is empty if a division is not worthwhile. `of_ros` tells
/// whether a source package belongs to ROS.
pub(crate) fn split(
    debs: &[Deb],
    relations: &BTreeMap<String, Relations>,
    of_ros: impl Fn(&str) -> bool,
) -> (Vec<Deb>, Vec<Deb>) {
    let mut late: BTreeSet<&str> = BTreeSet::new();
    // Names by which a late package may be needed: its own and those it provides.
    let mut late_names: BTreeSet<&str> = BTreeSet::new();
    loop {
        let before = late.len();
        for deb in debs {
            let name = deb.name.as_str();
            if late.contains(name) {
                continue;
            }
            // A package with unknown relations may need anything.
            let is_late = match relations.get(name) {
                None => true,
                Some(about) => {
                    of_ros(&about.source) || about.needs.iter().any(|need| late_names.contains(need.as_str()))
                }
            };
            if is_late {
                late.insert(name);
                late_names.insert(name);
                if let Some(about) = relations.get(name) {
                    late_names.extend(about.provides.iter().map(String::as_str));
                }
            }
        }
        if late.len() == before {
            break;
        }
    }
    let (last, first): (Vec<Deb>, Vec<Deb>) = debs.iter().cloned().partition(|deb| late.contains(deb.name.as_str()));
    if !is_worth_splitting(debs.len()) || first.len() < MIN_PACKAGES || last.is_empty() {
        (Vec::new(), debs.to_vec())
    } else {
        (first, last)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn deb(name: &str) -> Deb {
        Deb { name: name.to_owned(), version: "1".into(), architecture: "amd64".into() }
    }

    /// Parses lines of `NAME SOURCE NEEDS… / PROVIDES…`.
    fn parse_packages(lines: &[&str]) -> (Vec<Deb>, BTreeMap<String, Relations>) {
        let mut debs = Vec::new();
        let mut relations = BTreeMap::new();
        for line in lines {
            let (words, provides) = line.split_once('/').unwrap_or((line, ""));
            let mut words = words.split_whitespace().map(str::to_owned);
            let (name, source) = (words.next().expect("a name"), words.next().expect("a source"));
            debs.push(deb(&name));
            relations.insert(
                name,
                Relations {
                    source,
                    needs: words.collect(),
                    provides: provides.split_whitespace().map(str::to_owned).collect(),
                    ..Relations::default()
                },
            );
        }
        (debs, relations)
    }

    fn names(debs: &[Deb]) -> Vec<&str> {
        debs.iter().map(|deb| deb.name.as_str()).collect()
    }

    const LIBRARIES: [&str; 8] =
        ["liba0 a", "liba1 a liba0", "liba2 a liba1", "liba3 a", "liba4 a", "liba5 a", "liba6 a", "liba7 a"];

    #[test]
    fn libraries_come_first_and_the_cut_is_closed() {
        let mut lines = LIBRARIES.to_vec();
        lines.extend([
            "libcv-bridge1d ros-vision liba2",
            // Not a ROS package, but dependent on one by a virtual name.
            "tool other cv-plugin",
            "plugin ros-vision / cv-plugin",
            "ros-image-proc ros-image liba7 libcv-bridge1d",
        ]);
        let (debs, relations) = parse_packages(&lines);
        let (first, last) = split(&debs, &relations, |source| source.starts_with("ros-"));
        assert_eq!(first.len(), 8);
        assert_eq!(names(&last), ["libcv-bridge1d", "tool", "plugin", "ros-image-proc"]);
        for deb in &first {
            let needs = &relations[&deb.name].needs;
            assert!(needs.iter().all(|need| names(&first).contains(&need.as_str())));
        }
    }

    #[test]
    fn a_few_packages_are_not_cut_and_unknown_ones_are_never_below() {
        let (debs, relations) = parse_packages(&["liba0 a", "ros-x ros-x liba0"]);
        let ros = |source: &str| source.starts_with("ros-");
        assert_eq!(split(&debs, &relations, ros), (Vec::new(), debs));
        let (mut debs, relations) = parse_packages(&LIBRARIES);
        debs.insert(0, deb("strange"));
        let (first, last) = split(&debs, &relations, ros);
        assert_eq!((first.len(), names(&last)), (8, vec!["strange"]));
    }
}
