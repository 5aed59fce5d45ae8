//! Descriptions of how a node exited.

use servant::engine::NodeExit;

/// Describes how a node exited, beginning with a verb; `limits` are those of its servant.
pub fn describe_exit(exit: &NodeExit, limits: &api::Limits) -> String {
    if let Some(error) = &exit.exec_error {
        return format!("could not be executed: {error}");
    }
    if exit.out_of_memory {
        let limit = limits.memory.map_or_else(|| "the limit".to_owned(), |memory| memory.to_string());
        return format!("was killed because the servant needed more memory than its limit of {limit}");
    }
    match (exit.code, exit.signal) {
        (Some(code), _) => format!("exited with status {code}"),
        (None, Some(signal)) => match nix::sys::signal::Signal::try_from(signal) {
            Ok(name) => format!("was killed by {name}"),
            Err(_) => format!("was killed by signal {signal}"),
        },
        (None, None) => "ended".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn exit() -> NodeExit {
        NodeExit { code: None, signal: None, out_of_memory: false, exec_error: None }
    }

    #[test]
    fn ends_are_told_in_words() {
        let limits = api::Limits { memory: Some(api::Size(128 << 20)), ..api::Limits::default() };
        let cases = [
            (NodeExit { code: Some(3), ..exit() }, "exited with status 3"),
            (NodeExit { signal: Some(11), ..exit() }, "was killed by SIGSEGV"),
            (
                NodeExit { signal: Some(9), out_of_memory: true, ..exit() },
                "was killed because the servant needed more memory than its limit of 128M",
            ),
            (NodeExit { exec_error: Some("no such file".into()), ..exit() }, "could not be executed: no such file"),
        ];
        for (exit, words) in cases {
            assert_eq!(describe_exit(&exit, &limits), words);
        }
    }
}
