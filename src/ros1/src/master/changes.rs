//! Parts of the graph that changed lately: a caller that knows an earlier generation is told these alone.

use std::collections::{BTreeSet, VecDeque};

use super::graph::GraphPart;

/// Maximum number of recent changes; a caller that knows only older ones gets the whole graph.
const MAX_RECENT: usize = 4096;

/// The most recent changes of the graph.
#[derive(Debug, Default)]
pub(super) struct GraphChanges {
    /// Changed parts with the generation that has the change, oldest first.
    recent: VecDeque<(u64, GraphPart)>,
    /// Latest generation with a change that is no longer in the list.
    forgotten: u64,
}

impl GraphChanges {
    /// Records that parts change with this generation.
    pub(super) fn record(&mut self, generation: u64, parts: impl IntoIterator<Item = GraphPart>) {
        for part in parts {
            if self.recent.len() >= MAX_RECENT {
                if let Some((oldest, _)) = self.recent.pop_front() {
                    self.forgotten = oldest;
                }
            }
            self.recent.push_back((generation, part));
        }
    }

    /// Returns the parts that changed after a generation; `None` if some of these changes were forgotten.
    pub(super) fn parts_since(&self, known: u64) -> Option<BTreeSet<GraphPart>> {
        if known < self.forgotten {
            return None;
        }
        let newer = self.recent.iter().rev().take_while(|(generation, _)| *generation > known);
        Some(newer.map(|(_, part)| part.clone()).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_told_once_each_until_they_are_forgotten() {
        let part = |number: u64| GraphPart::Topic(format!("/t{number}"));
        let mut changes = GraphChanges::default();
        for generation in 1..=10 {
            changes.record(generation, [part(generation), GraphPart::Node("/n".to_owned())]);
        }
        assert_eq!(changes.parts_since(10), Some([].into()));
        assert_eq!(changes.parts_since(8), Some([part(9), part(10), GraphPart::Node("/n".to_owned())].into()));
        assert_eq!(changes.parts_since(0).map(|parts| parts.len()), Some(11));
        let many = MAX_RECENT as u64;
        for generation in 11..11 + many {
            changes.record(generation, [part(generation)]);
        }
        assert_eq!(changes.parts_since(9), None);
        assert_eq!(changes.parts_since(10).map(|parts| parts.len()), Some(MAX_RECENT));
    }
}
