//! Limits on the size of interfaces.

use package::interface::Interface;

use crate::Error;

/// Maximum length of a topic, service, action or parameter name, in bytes.
const LONGEST_NAME: usize = 1024;
/// Maximum number of topics, services, actions and parameters together.
const MOST_NAMES: usize = 20_000;

/// Rejects an interface that no robot could use. It is registered by untrusted nodes and goes into the database, to
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
            next: Some("check the names that the nodes register".to_owned()),
            log: Vec::new(),
        })
    };
    let mut count = 0;
    for name in names {
        count += 1;
        if name.len() > LONGEST_NAME || name.chars().any(char::is_control) {
            return refused(format!(
                "the interface has an invalid name: {:?}",
                name.chars().take(100).collect::<String>()
            ));
        }
    }
    if count > MOST_NAMES {
        return refused(format!(
            "the interface has {count} topics, services, actions and parameters; the limit is {MOST_NAMES}"
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
        let interface = |topics| Interface { topics, ..Interface::default() };
        check_interface(&interface(vec![topic("/a"), topic("/b/c")])).expect("possible");
        for bad in ["/a\x1b[2J", &"/a".repeat(1000)] {
            let refused = check_interface(&interface(vec![topic(bad)])).expect_err(bad).message_and_advice();
            assert!(refused.contains("invalid name"), "{refused}");
        }
        let many = (0..=MOST_NAMES).map(|number| topic(&format!("/t{number}")));
        let refused = check_interface(&interface(many.collect())).expect_err("too many");
        assert!(refused.message_and_advice().contains("20001"));
    }
}
