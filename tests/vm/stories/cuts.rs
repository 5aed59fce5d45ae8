//! The power is cut in the middle of something. After the boot the store verifies, services are published, and
//! nothing is left of what was half-made.

pub mod in_the_middle_of_a_start {
    use anyhow::ensure;
    use serde_json::json;
    use support::Told;

    use crate::machine::daemon;

    pub fn before() -> Told {
        let daemon = daemon()?;
        let _ready = daemon
            .robot("greeter_cpp?robot=ready")?
            .calls("/greeter/count", json!({}))?;
        Ok(())
    }

    pub fn after() -> Told {
        let daemon = daemon()?;
        ensure!(daemon.servants_of("greeter_cpp")?.is_empty());
        let mut robot = daemon.robot("greeter_cpp?robot=ready")?;
        ensure!(robot.calls("/greeter/count", json!({}))?["result"] == true);
        Ok(())
    }
}
