//! Requirements for services whose servants are shared by robots.

use api::PushOptions;
use package::interface::Interface;
use reach::group::shareable;
use ros::bus::RosVersion;

use crate::{Error, OptionsError};

/// Maximum number of servants of a service, and of concurrent calls of a servant.
const MAX_SERVANTS: u32 = 64;

/// Rejects contradictory numbers of servants.
pub(crate) fn check_options(options: &PushOptions) -> Result<(), OptionsError> {
    let Some(shared) = &options.shared else {
        return Ok(());
    };
    if options.stateful {
        return Err(OptionsError::StatefulShared);
    }
    let (min, max) = (shared.min, shared.max);
    // Checked first: it is the default of --min.
    if !(1..=max).contains(&shared.replicas) {
        let replicas = shared.replicas;
        return Err(OptionsError::Replicas { replicas, max });
    }
    if !(1..=MAX_SERVANTS).contains(&max) || !(1..=max).contains(&min) {
        return Err(OptionsError::ServantRange { min, max, most: MAX_SERVANTS });
    }
    if !(1..=MAX_SERVANTS).contains(&shared.calls) {
        return Err(OptionsError::Calls { calls: shared.calls, most: MAX_SERVANTS });
    }
    Ok(())
}

/// Advice on alternatives to sharing.
const ALONE: &str = "push it without --shared, so that each robot gets its own servant";

/// Rejects an interface that robots cannot share, naming the reason.
pub(crate) fn check_interface(ros: RosVersion, interface: &Interface) -> Result<(), Error> {
    shareable::check_shareable(ros, interface).map_err(|error| Error::Failed {
        message: error.to_string(),
        next: Some(format!("{ALONE}; or push only the nodes that answer services and actions, with --node")),
        log: Vec::new(),
    })
}

#[cfg(test)]
mod tests {
    use api::Shared;

    use super::*;

    #[test]
    fn numbers_that_contradict_each_other_are_refused() {
        let check = |shared: Shared, stateful| {
            let options = PushOptions { shared: Some(shared), stateful, ..PushOptions::default() };
            check_options(&options).err().map(|error| error.to_string())
        };
        let fine = Shared::default();
        assert_eq!(check(fine, false), None);
        for (shared, stateful, expected) in [
            (fine, true, "--stateful and --shared"),
            (Shared { min: 0, ..fine }, false, "--min 0"),
            (Shared { min: 5, ..fine }, false, "--max 4"),
            (Shared { max: 65, ..fine }, false, "--max 65"),
            (Shared { replicas: 0, ..fine }, false, "--replicas 0"),
            (Shared { replicas: 5, ..fine }, false, "--replicas 5"),
            (Shared { replicas: 5, min: 5, max: 2, ..fine }, false, "--replicas 5"),
            (Shared { calls: 0, ..fine }, false, "--calls 0"),
        ] {
            let refused = check(shared, stateful).expect("refused");
            assert!(refused.contains(expected), "{refused}");
        }
        assert!(check_options(&PushOptions::default()).is_ok());
    }
}
