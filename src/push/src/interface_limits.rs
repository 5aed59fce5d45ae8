//! Interfaces that no robot could use.

use package::interface::Interface;

use crate::Error;

/// Bytes of a topic's, service's, action's or parameter's name.
const LONGEST_NAME: usize = 1024;
/// Of those together.
const MOST_NAMES: usize = 20_000;

/// Refuses an interface that no robot could use: it is what untrusted nodes registered, and goes into the database, to
/// every client and into stubs.
pub(super) fn check_interface(interface: &Interface) -> Result<(), Error> {
    let topics = interface.topics.iter().map(|topic| &topic.name);
    let services = interface.services.iter().map(|service| &service.name);
    let actions = interface.actions.iter().map(|action| &action.name);
    let parameters = interface.parameters.iter().map(|parameter| &parameter.name);
    let names = topics.chain(services).chain(actions).chain(parameters);
    let refused = |message: String| {
        Err(Error::Failed {
            message,
            next: Some("look at what the nodes register".to_owned()),
            log: Vec::new(),
        })
    };
    let mut count = 0;
    for name in names {
        count += 1;
        if name.len() > LONGEST_NAME || name.chars().any(char::is_control) {
            return refused(format!(
                "the interface has a name that is not valid: {:?}",
                name.chars().take(100).collect::<String>()
            ));
        }
    }
    if count > MOST_NAMES {
        return refused(format!(
            "the interface has {count} topics, services, actions and parameters, and {MOST_NAMES} are allowed at most"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interface_of_impossible_names_is_refused() {
        let topic = |name: &str| package::interface::Topic {
            name: name.into(),
            type_name: "p/T".into(),
            md5: String::new(),
            direction: package::interface::Direction::Output,
            nodes: Vec::new(),
            latched: false,
            lazy: false,
            qos: None,
        };
        let interface = |topics| Interface {
            topics,
            ..Interface::default()
        };
        check_interface(&interface(vec![topic("/a"), topic("/b/c")])).expect("possible");
        for bad in ["/a\x1b[2J", &"/a".repeat(1000)] {
            let refused = check_interface(&interface(vec![topic(bad)]))
                .expect_err(bad)
                .words();
            assert!(refused.contains("not valid"), "{refused}");
        }
        let many = (0..=MOST_NAMES).map(|number| topic(&format!("/t{number}")));
        let refused = check_interface(&interface(many.collect())).expect_err("too many");
        assert!(refused.words().contains("20001"));
    }
}
