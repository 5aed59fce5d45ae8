//! Which topics are wanted.

/// Topics that are wanted: all where none is named; `/camera/*` is all below `/camera/`.
#[derive(Debug, Clone, clap::Args)]
pub struct Topics {
    /// Only this topic, or all that begin with what stands before a last `*`. May be given several times.
    #[arg(short, long = "topic", value_name = "TOPIC")]
    topics: Vec<String>,
}

impl Topics {
    /// Whether this one is among them.
    pub fn want(&self, topic: &str) -> bool {
        // As a servant names them; `tf` is `/tf`, as everywhere in ROS.
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
        let topics = |all: &[&str]| Topics {
            topics: all.iter().map(|one| (*one).to_owned()).collect(),
        };
        assert!(topics(&[]).want("/any"));
        let some = topics(&["/tf", "/camera/*"]);
        assert!(some.want("/tf") && some.want("/camera/left/image"));
        assert!(!some.want("/tf_static") && !some.want("/camera"));
        let relative = topics(&["tf", "camera/*"]);
        assert!(relative.want("/tf") && relative.want("/camera/left/image"));
        assert!(!relative.want("/tf_static") && topics(&["*"]).want("/any"));
    }
}
