//! Selection of topics.

/// Selection of topics: all if none is named; `/camera/*` selects all below `/camera/`.
#[derive(Debug, Clone, clap::Args)]
pub struct TopicFilter {
    /// Only this topic, or all topics with the prefix before a trailing `*`; may be given several times.
    #[arg(short, long = "topic", value_name = "TOPIC")]
    topics: Vec<String>,
}

impl TopicFilter {
    /// Returns whether a topic is selected.
    pub fn accepts(&self, topic: &str) -> bool {
        // Compare without the leading slash: `tf` is `/tf`, as everywhere in ROS.
        let topic = topic.strip_prefix('/').unwrap_or(topic);
        let matches = |pattern: &String| {
            let pattern = pattern.strip_prefix('/').unwrap_or(pattern);
            match pattern.strip_suffix('*') {
                Some(begins) => topic.starts_with(begins),
                None => topic == pattern,
            }
        };
        self.topics.is_empty() || self.topics.iter().any(matches)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_are_wanted_by_name_or_by_beginning() {
        let topics = |all: &[&str]| TopicFilter { topics: all.iter().map(|one| (*one).to_owned()).collect() };
        assert!(topics(&[]).accepts("/any"));
        let some = topics(&["/tf", "/camera/*"]);
        assert!(some.accepts("/tf") && some.accepts("/camera/left/image"));
        assert!(!some.accepts("/tf_static") && !some.accepts("/camera"));
        let relative = topics(&["tf", "camera/*"]);
        assert!(relative.accepts("/tf") && relative.accepts("/camera/left/image"));
        assert!(!relative.accepts("/tf_static") && topics(&["*"]).accepts("/any"));
    }
}
