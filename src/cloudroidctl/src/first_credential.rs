//! Warning before the first account or token of a server: robots without credentials are cut off by it.

use std::collections::BTreeSet;

use access::Role;
use anyhow::bail;
use api::Servant;
use api::people::Session;

use crate::client::DaemonClient;
use crate::confirm::{YesFlag, ask};
use crate::output;

/// Maximum number of robots that the warning names.
const MAX_NAMED_ROBOTS: usize = 10;

/// Connected robots without credentials.
#[derive(Debug, Default, PartialEq, Eq)]
struct OpenRobots {
    named: BTreeSet<String>,
    nameless: usize,
}

impl OpenRobots {
    /// Collects the robots of connected servants; on an open server none of them has a credential.
    fn find(servants: &[Servant]) -> OpenRobots {
        let connected = servants.iter().filter(|servant| servant.connections > 0);
        OpenRobots::collect(connected.map(|servant| &*servant.robot))
    }

    /// Sorts names of robots. `~` and letters is the name of a robot without one; `~PURPOSE-…` is no robot's, but that
    /// of a servant of a group or of a measurement.
    fn collect<'a>(names: impl Iterator<Item = &'a str>) -> OpenRobots {
        let mut robots = OpenRobots::default();
        for name in names {
            match name.strip_prefix('~') {
                None => {
                    robots.named.insert(name.to_owned());
                }
                Some(generated) if !generated.contains('-') => robots.nameless += 1,
                Some(_) => {}
            }
        }
        robots
    }

    fn count(&self) -> usize {
        self.named.len() + self.nameless
    }

    /// Returns the names, shortened, for a sentence.
    fn names(&self) -> String {
        let mut names: Vec<String> = self.named.iter().take(MAX_NAMED_ROBOTS).cloned().collect();
        if let Some(more) = self.named.len().checked_sub(MAX_NAMED_ROBOTS).filter(|more| *more > 0) {
            names.push(format!("{more} more"));
        }
        if self.nameless > 0 {
            names.push(format!("{} without a name", self.nameless));
        }
        names.join(", ")
    }

    /// Returns the warning; `stay` is true if the operator admits robots of the server's machine without credentials.
    fn describe(&self, stay: bool) -> String {
        const FIRST: &str = "this is the server's first credential: from now on every connection over TCP needs one";
        if stay {
            return format!("{FIRST}, except those of robots on the server's machine (loopback_robots)");
        }
        let whom = match self.count() {
            0 => "no robot is connected now, and later ones need one too".to_owned(),
            1 => format!("1 robot that is connected without one is cut off: {}", self.names()),
            several => format!("{several} robots that are connected without one are cut off: {}", self.names()),
        };
        format!(
            "{FIRST}; {whom}\nfor each robot: cloudroidctl token create NAME --role robot --robot ID --service '*'; or \
                keep robots on the server's machine: loopback_robots = \"allowed\" under [portal] of the configuration"
        )
    }
}

/// Warns if the server has no credentials yet, and asks at a terminal if robots would be cut off. Fails if the answer
/// is no.
pub async fn confirm_first_credential(client: &DaemonClient, yes: YesFlag) -> anyhow::Result<()> {
    let session: Session = client.get("/api/v1/session").await?;
    // Others are refused by the request itself.
    if session.needed || session.role != Some(Role::Admin) {
        return Ok(());
    }
    let servants: Vec<Servant> = client.get("/api/v1/servants").await?;
    let robots = OpenRobots::find(&servants);
    output::eprint_line(&robots.describe(session.loopback_robots));
    let cuts_off = robots.count() > 0 && !session.loopback_robots;
    if cuts_off && yes.is_to_ask() && !ask("go on?".to_owned()).await? {
        bail!("nothing was created; repeat the command to go on, with --yes to be asked nothing");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn robots(named: &[&str], nameless: usize) -> OpenRobots {
        OpenRobots { named: named.iter().map(|name| (*name).to_owned()).collect(), nameless }
    }

    #[test]
    fn those_who_are_cut_off_are_counted_and_named() {
        for (of, words) in [
            (robots(&[], 0), "no robot is connected now"),
            (robots(&["r1"], 0), "1 robot that is connected without one is cut off: r1"),
            (robots(&["r2", "r1"], 1), "3 robots that are connected without one are cut off: r1, r2, 1 without a name"),
        ] {
            let told = of.describe(false);
            assert!(told.contains(words) && told.contains("loopback_robots"), "{told}");
        }
        let many: Vec<String> = (10..25).map(|number| format!("r{number}")).collect();
        let many: Vec<&str> = many.iter().map(String::as_str).collect();
        let told = robots(&many, 0).describe(false);
        assert!(told.contains("15 robots") && told.contains("r19, 5 more") && !told.contains("r20"), "{told}");
    }

    #[test]
    fn a_robot_is_counted_once_and_what_is_none_is_not() {
        let names = ["r1", "~abc0", "r1", "~group-1-1", "r2"];
        assert_eq!(OpenRobots::collect(names.into_iter()), robots(&["r1", "r2"], 1));
    }

    #[test]
    fn nobody_is_cut_off_where_robots_stay() {
        let told = robots(&["r1"], 0).describe(true);
        assert!(told.contains("first credential") && !told.contains("cut off"), "{told}");
    }
}
