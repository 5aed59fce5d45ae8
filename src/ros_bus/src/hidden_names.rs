//! Names of ROS 2 that tools hide by default. A graph has them in [`Graph::ends`](crate::Graph::ends) only.

/// Separator between an action's name and the names of its parts.
const ACTION: &str = "/_action/";

/// Returns true if tools hide the name by default: a part of it begins with `_`.
pub fn is_hidden(name: &str) -> bool {
    name.split('/').any(|part| part.starts_with('_'))
}

/// Splits the name of a part of an action into the action and the part: `/fib` and `send_goal`.
pub fn action_part(name: &str) -> Option<(&str, &str)> {
    let (action, part) = name.rsplit_once(ACTION)?;
    (!action.is_empty() && !is_hidden(action)).then_some((action, part))
}

/// Returns the name of a part of an action: `/fib` and `send_goal` make `/fib/_action/send_goal`.
pub fn action_part_name(action: &str, part: &str) -> String {
    format!("{action}{ACTION}{part}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_an_action_are_told_by_their_names() {
        let part = action_part_name("/a/fib", "status");
        assert_eq!(action_part(&part), Some(("/a/fib", "status")));
        assert_eq!(action_part("/a/fib/_action/send_goal"), Some(("/a/fib", "send_goal")));
        for other in ["/send_goal", "/_action/send_goal", "/_a/_action/send_goal"] {
            assert_eq!(action_part(other), None, "{other}");
        }
    }
}
