//! Claims about a person, from an ID token or the userinfo endpoint.

use serde_json::{Map, Value};

/// Maximum number of groups of a person and maximum length of a group's name in characters; further or longer ones
/// are ignored.
const MAX_GROUPS: usize = 1000;
const LONGEST: usize = 200;

/// Claims with a subject.
pub struct Claims {
    subject: String,
    all: Map<String, Value>,
}

impl Claims {
    /// Parses a JSON object.
    pub fn from_slice(text: &[u8]) -> Result<Claims, serde_json::Error> {
        serde_json::from_slice(text).and_then(Claims::from_value)
    }

    /// Converts a JSON object.
    pub fn from_value(value: Value) -> Result<Claims, serde_json::Error> {
        let all: Map<String, Value> = serde_json::from_value(value)?;
        let subject = all.get("sub").cloned().unwrap_or_default();
        Ok(Claims { subject: serde_json::from_value(subject)?, all })
    }

    /// Returns the subject identifier (`sub`).
    pub fn subject(&self) -> &str {
        &self.subject
    }

    /// Returns the claim of this name or, if the name has dots, the nested value (`realm_access.roles`).
    pub fn find(&self, name: &str) -> Option<&Value> {
        if let Some(found) = self.all.get(name) {
            return Some(found);
        }
        let (first, rest) = name.split_once('.')?;
        let mut found = self.all.get(first)?;
        for part in rest.split('.') {
            found = found.get(part)?;
        }
        Some(found)
    }

    /// Returns a claim that is a non-empty string.
    pub fn find_text(&self, name: &str) -> Option<String> {
        let text = self.find(name)?.as_str()?;
        (!text.is_empty()).then(|| text.to_owned())
    }

    /// Returns the groups of a claim that is a list of strings or one string. An `email` claim counts only if the
    /// provider has verified it.
    pub fn find_groups(&self, name: &str) -> Option<Vec<String>> {
        let found = self.find(name)?;
        if name == "email" && self.all.get("email_verified") != Some(&Value::Bool(true)) {
            return Some(Vec::new());
        }
        let texts = match found {
            Value::Array(all) => all.as_slice(),
            one => std::slice::from_ref(one),
        };
        let texts = texts.iter().filter_map(Value::as_str);
        let short = texts.filter(|text| text.chars().count() <= LONGEST);
        Some(short.take(MAX_GROUPS).map(str::to_owned).collect())
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn claims(value: Value) -> Claims {
        Claims::from_value(value).expect("claims")
    }

    #[test]
    fn groups_are_found_by_the_name_of_their_claim() {
        let all = claims(json!({
            "sub": "1",
            "groups": ["a", 2, "b"],
            "one": "c",
            "https://lab.example/groups": ["d"],
            "realm_access": {"roles": ["e"]},
            "number": 3,
        }));
        let groups = |name: &str| all.find_groups(name).map(|found| found.join(" "));
        assert_eq!(groups("groups").as_deref(), Some("a b"));
        assert_eq!(groups("one").as_deref(), Some("c"));
        assert_eq!(groups("https://lab.example/groups").as_deref(), Some("d"));
        assert_eq!(groups("realm_access.roles").as_deref(), Some("e"));
        assert_eq!(groups("number").as_deref(), Some(""));
        assert_eq!(groups("realm_access.none"), None);
        assert_eq!(groups("none"), None);
    }

    #[test]
    fn an_address_that_is_not_verified_is_no_group() {
        for (verified, count) in [(json!(true), 1), (json!(false), 0), (json!("true"), 0), (json!(null), 0)] {
            let all = claims(json!({"sub": "1", "email": "a@lab.example", "email_verified": verified}));
            assert_eq!(all.find_groups("email").expect("there").len(), count, "{verified}");
        }
    }

    #[test]
    fn more_groups_than_anybody_has_are_not_looked_at() {
        let many: Vec<String> = (0..MAX_GROUPS + 1).map(|number| number.to_string()).collect();
        let all = claims(json!({"sub": "1", "groups": many, "long": ["x".repeat(LONGEST + 1)]}));
        assert_eq!(all.find_groups("groups").expect("there").len(), MAX_GROUPS);
        assert_eq!(all.find_groups("long").expect("there").len(), 0);
    }

    #[test]
    fn without_a_subject_there_is_nobody() {
        for text in ["{}", "[]", "{\"sub\": 1}", "{\"sub\": ", "\"sub\""] {
            assert!(Claims::from_slice(text.as_bytes()).is_err(), "{text}");
        }
    }
}
