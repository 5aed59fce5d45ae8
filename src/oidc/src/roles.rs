//! Mapping from the provider's groups to roles and services.

use access::{Glob, Role};

/// A group that has a role.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RoleGroup {
    /// Name of the group at the provider.
    pub name: String,
    /// Role of its members.
    pub role: Role,
    /// Services to which the role applies; empty if the role is for all services.
    pub services: Vec<Glob>,
}

/// Role granted to a person.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GrantedRole {
    /// The strongest role of the person's groups.
    pub role: Role,
    /// Services of all the person's groups that have this role.
    pub services: Vec<Glob>,
    /// The person's groups that are mapped, in the order of the configuration.
    pub groups: Vec<String>,
}

/// All groups that have a role.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Roles(pub Vec<RoleGroup>);

/// Roles from the strongest to the weakest; people cannot be robots.
const STRONGEST_FIRST: [Role; 4] = [Role::Admin, Role::Operator, Role::Deployer, Role::Viewer];

impl Roles {
    /// Returns the role of a person with these groups, or `None` if no group has one.
    pub fn grant_for_groups(&self, groups: &[String]) -> Option<GrantedRole> {
        let of_person = |group: &&RoleGroup| groups.contains(&group.name);
        let mine: Vec<&RoleGroup> = self.0.iter().filter(of_person).collect();
        let has = |role: &Role| mine.iter().any(|group| group.role == *role);
        let role = STRONGEST_FIRST.into_iter().find(has)?;
        let mut services: Vec<Glob> = Vec::new();
        for group in mine.iter().filter(|group| group.role == role) {
            let new = group.services.iter().filter(|one| !services.contains(one));
            let new: Vec<Glob> = new.cloned().collect();
            services.extend(new);
        }
        Some(GrantedRole { role, services, groups: mine.iter().map(|group| group.name.clone()).collect() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn group(name: &str, role: Role, services: &[&str]) -> RoleGroup {
        RoleGroup {
            name: name.into(),
            role,
            services: services.iter().map(|one| one.parse().expect("a pattern")).collect(),
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
            let granted = roles.grant_for_groups(&groups)?;
            let services: Vec<String> = granted.services.iter().map(ToString::to_string).collect();
            Some((granted.role, services.join(" "), granted.groups.join(" ")))
        };
        assert_eq!(of(&["all"]), Some((Role::Viewer, "*".into(), "all".into())));
        // A viewer's services do not become a deployer's.
        let both = of(&["b", "all", "a", "unknown"]);
        assert_eq!(both, Some((Role::Deployer, "a_* shared b_*".into(), "all a b".into())));
        assert_eq!(of(&["a", "ops"]), Some((Role::Operator, String::new(), "a ops".into())));
        assert_eq!(of(&["unknown", "ALL", ""]), None);
        assert_eq!(of(&[]), None);
    }
}
