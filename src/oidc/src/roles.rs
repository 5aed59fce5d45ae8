//! Which groups of a provider have which role, for which services.

use access::{Glob, Role};

/// A group that may do something.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Group {
    /// As the provider calls it.
    pub name: String,
    /// Its people's role.
    pub role: Role,
    /// For which services; none where the role is for all.
    pub services: Vec<Glob>,
}

/// What somebody may do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Granted {
    /// The strongest of the roles that the person's groups have.
    pub role: Role,
    /// The services of those of its groups that have this role, together.
    pub services: Vec<Glob>,
    /// Those groups of the person that are named here, in the order of the configuration.
    pub groups: Vec<String>,
}

/// All groups that may do something.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Roles(pub Vec<Group>);

/// Who may more comes first; people are no robots.
const STRONGEST_FIRST: [Role; 4] = [Role::Admin, Role::Operator, Role::Deployer, Role::Viewer];

impl Roles {
    /// What somebody of these groups may do; none: nothing.
    pub fn of(&self, groups: &[String]) -> Option<Granted> {
        let of_person = |group: &&Group| groups.contains(&group.name);
        let mine: Vec<&Group> = self.0.iter().filter(of_person).collect();
        let has = |role: &Role| mine.iter().any(|group| group.role == *role);
        let role = STRONGEST_FIRST.into_iter().find(has)?;
        let mut services: Vec<Glob> = Vec::new();
        for group in mine.iter().filter(|group| group.role == role) {
            let new = group.services.iter().filter(|one| !services.contains(one));
            let new: Vec<Glob> = new.cloned().collect();
            services.extend(new);
        }
        Some(Granted {
            role,
            services,
            groups: mine.iter().map(|group| group.name.clone()).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group(name: &str, role: Role, services: &[&str]) -> Group {
        Group {
            name: name.into(),
            role,
            services: services
                .iter()
                .map(|one| one.parse().expect("a pattern"))
                .collect(),
        }
    }

    #[test]
    fn the_strongest_role_counts_with_its_own_services() {
        let roles = Roles(vec![
            group("all", Role::Viewer, &["*"]),
            group("a", Role::Deployer, &["a_*", "shared"]),
            group("b", Role::Deployer, &["b_*", "shared"]),
            group("ops", Role::Operator, &[]),
        ]);
        let of = |groups: &[&str]| {
            let groups: Vec<String> = groups.iter().map(|&one| one.to_owned()).collect();
            let granted = roles.of(&groups)?;
            let services: Vec<String> = granted.services.iter().map(ToString::to_string).collect();
            Some((granted.role, services.join(" "), granted.groups.join(" ")))
        };
        assert_eq!(of(&["all"]), Some((Role::Viewer, "*".into(), "all".into())));
        // What a viewer sees is no deployer's.
        let both = of(&["b", "all", "a", "unknown"]);
        assert_eq!(
            both,
            Some((Role::Deployer, "a_* shared b_*".into(), "all a b".into()))
        );
        assert_eq!(
            of(&["a", "ops"]),
            Some((Role::Operator, String::new(), "a ops".into()))
        );
        assert_eq!(of(&["unknown", "ALL", ""]), None);
        assert_eq!(of(&[]), None);
    }
}
