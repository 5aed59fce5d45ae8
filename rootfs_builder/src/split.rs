//! Where a set of Debian packages is cut in two layers: first what other software stands on, then what belongs to ROS.
//!
//! Two ROS packages of one field share nearly all of their libraries (OpenCV, PCL, VTK: hundreds of megabytes) and
//! differ in what is ROS's own (a few megabytes). As one layer nothing of it could serve both. The lower layer is
//! closed: nothing in it needs anything of the upper one, so it is a complete system by itself.

use std::collections::{BTreeMap, BTreeSet};

use crate::apt::{Deb, Relations};

/// Fewer packages than this are not worth a layer of their own.
const FEW: usize = 8;

/// Whether as many packages as this can be worth a cut, whatever they are.
pub(crate) fn may_cut(count: usize) -> bool {
    count > FEW
}

/// Cuts `debs`; both parts keep the order. The first part is empty where a cut is not worth it. `of_ros`: whether a
/// source package is one of ROS.
pub(crate) fn split(
    debs: &[Deb],
    relations: &BTreeMap<String, Relations>,
    of_ros: impl Fn(&str) -> bool,
) -> (Vec<Deb>, Vec<Deb>) {
    let mut late: BTreeSet<&str> = BTreeSet::new();
    // Names by which a late package may be needed: its own and what it provides.
    let mut late_names: BTreeSet<&str> = BTreeSet::new();
    loop {
        let before = late.len();
        for deb in debs {
            let name = deb.name.as_str();
            if late.contains(name) {
                continue;
            }
            // What nothing is known of may need anything.
            let is_late = match relations.get(name) {
                None => true,
                Some(about) => {
                    of_ros(&about.source)
                        || about
                            .needs
                            .iter()
                            .any(|need| late_names.contains(need.as_str()))
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
    let (last, first): (Vec<Deb>, Vec<Deb>) = debs
        .iter()
        .cloned()
        .partition(|deb| late.contains(deb.name.as_str()));
    if !may_cut(debs.len()) || first.len() < FEW || last.is_empty() {
        (Vec::new(), debs.to_vec())
    } else {
        (first, last)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn deb(name: &str) -> Deb {
        Deb {
            name: name.to_owned(),
            version: "1".into(),
            architecture: "amd64".into(),
        }
    }

    /// `NAME SOURCE NEEDS… / PROVIDES…`
    fn lab(lines: &[&str]) -> (Vec<Deb>, BTreeMap<String, Relations>) {
        let mut debs = Vec::new();
        let mut relations = BTreeMap::new();
        for line in lines {
            let (words, provides) = line.split_once('/').unwrap_or((line, ""));
            let mut words = words.split_whitespace().map(str::to_owned);
            let (name, source) = (
                words.next().expect("a name"),
                words.next().expect("a source"),
            );
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

    const LIBRARIES: [&str; 8] = [
        "liba0 a",
        "liba1 a liba0",
        "liba2 a liba1",
        "liba3 a",
        "liba4 a",
        "liba5 a",
        "liba6 a",
        "liba7 a",
    ];

    #[test]
    fn libraries_come_first_and_the_cut_is_closed() {
        let mut lines = LIBRARIES.to_vec();
        lines.extend([
            "libcv-bridge1d ros-vision liba2",
            // Not of ROS, but of no use without it, by another name.
            "tool other cv-plugin",
            "plugin ros-vision / cv-plugin",
            "ros-image-proc ros-image liba7 libcv-bridge1d",
        ]);
        let (debs, relations) = lab(&lines);
        let (first, last) = split(&debs, &relations, |source| source.starts_with("ros-"));
        assert_eq!(first.len(), 8);
        assert_eq!(
            names(&last),
            ["libcv-bridge1d", "tool", "plugin", "ros-image-proc"]
        );
        for deb in &first {
            let needs = &relations[&deb.name].needs;
            assert!(
                needs
                    .iter()
                    .all(|need| names(&first).contains(&need.as_str()))
            );
        }
    }

    #[test]
    fn a_few_packages_are_not_cut_and_unknown_ones_are_never_below() {
        let (debs, relations) = lab(&["liba0 a", "ros-x ros-x liba0"]);
        let ros = |source: &str| source.starts_with("ros-");
        assert_eq!(split(&debs, &relations, ros), (Vec::new(), debs));
        let (mut debs, relations) = lab(&LIBRARIES);
        debs.insert(0, deb("strange"));
        let (first, last) = split(&debs, &relations, ros);
        assert_eq!((first.len(), names(&last)), (8, vec!["strange"]));
    }
}
