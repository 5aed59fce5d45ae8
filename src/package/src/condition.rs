//! `condition` attributes of `package.xml` (REP 149, format 3).
//!
//! ```text
//!   or_expression   := and_expression { "or" and_expression }
//!   and_expression  := comparison { "and" comparison }
//!   comparison      := value operator value | "(" or_expression ")"
//!   value           := $VARIABLE | bare word | "quoted" | 'quoted'
//! ```
//! All values are strings and are compared as strings. An unset variable is empty.

use std::cmp::Ordering;
use std::collections::BTreeMap;

/// Variables available to conditions.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Variables(BTreeMap<String, String>);

impl Variables {
    /// Returns the variables of a distribution, such as `noetic`, of this ROS version, with Python 3.
    pub fn for_distribution(version: u8, distribution: &str) -> Self {
        Self::from_iter([
            ("ROS_VERSION", &*version.to_string()),
            ("ROS_DISTRO", distribution),
            ("ROS_PYTHON_VERSION", "3"),
        ])
    }

    fn get(&self, name: &str) -> &str {
        self.0.get(name).map_or("", String::as_str)
    }

    /// Evaluates a condition. Fails if it cannot be parsed.
    pub fn evaluate(&self, condition: &str) -> Result<bool, ConditionError> {
        let tokens = tokenize(condition)?;
        let mut parser = Parser { tokens: &tokens, variables: self, depth: 0 };
        let holds = parser.or_expression()?;
        match parser.tokens {
            [] => Ok(holds),
            [extra, ..] => Err(ConditionError::UnexpectedToken(extra.clone())),
        }
    }
}

impl<K: Into<String>, V: Into<String>> FromIterator<(K, V)> for Variables {
    fn from_iter<I: IntoIterator<Item = (K, V)>>(pairs: I) -> Self {
        Self(pairs.into_iter().map(|(name, value)| (name.into(), value.into())).collect())
    }
}

/// Error of parsing a condition.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ConditionError {
    /// The condition ends where more is expected.
    #[error("it ends too early")]
    EndsEarly,
    /// This quote is not closed.
    #[error("the quote {0} is not closed")]
    OpenQuote(char),
    /// No token begins with this character.
    #[error("unexpected {0:?}")]
    UnexpectedCharacter(char),
    /// The condition is complete before this token.
    #[error("unexpected {0:?}")]
    UnexpectedToken(Token),
    /// There are too many nested brackets.
    #[error("more than {MAX_DEPTH} nested brackets")]
    TooDeep,
    /// A closing bracket is missing before this token.
    #[error("a closing bracket is missing before {0:?}")]
    NoBracket(Token),
    /// A comparison operator is missing before this token.
    #[error("a comparison is missing before {0:?}")]
    NoComparison(Token),
    /// A value is missing before this token.
    #[error("a value is missing before {0:?}")]
    NoValue(Token),
}

/// A token of a condition.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Token {
    /// A bare word: a value, `and` or `or`.
    Word(String),
    /// A value, without its quotes.
    Quoted(String),
    /// A variable, without its `$`.
    Variable(String),
    /// A comparison operator.
    Operator(&'static str),
    /// An opening bracket.
    Open,
    /// A closing bracket.
    Close,
}

/// Maximum nesting of parentheses.
const MAX_DEPTH: usize = 32;

const OPERATORS: [&str; 6] = ["==", "!=", "<=", ">=", "<", ">"];

fn tokenize(text: &str) -> Result<Vec<Token>, ConditionError> {
    let mut tokens = Vec::new();
    let mut rest = text.trim_start();
    while let Some(first) = rest.chars().next() {
        let operator = OPERATORS.into_iter().find(|operator| rest.starts_with(operator));
        let (token, length) = match (operator, first) {
            (Some(operator), _) => (Token::Operator(operator), operator.len()),
            (_, '(') => (Token::Open, 1),
            (_, ')') => (Token::Close, 1),
            (_, quote @ ('"' | '\'')) => {
                let end = rest[1..].find(quote).ok_or(ConditionError::OpenQuote(quote))?;
                (Token::Quoted(rest[1..=end].to_owned()), end + 2)
            }
            (_, '$') => {
                let name = word(&rest[1..]);
                (Token::Variable(name.to_owned()), 1 + name.len())
            }
            _ => {
                let found = word(rest);
                (Token::Word(found.to_owned()), found.len())
            }
        };
        if matches!(&token, Token::Word(name) | Token::Variable(name) if name.is_empty()) {
            return Err(ConditionError::UnexpectedCharacter(first));
        }
        tokens.push(token);
        rest = rest[length..].trim_start();
    }
    Ok(tokens)
}

fn word(text: &str) -> &str {
    let end = text.find(|c: char| !(c.is_alphanumeric() || "_-.".contains(c)));
    &text[..end.unwrap_or(text.len())]
}

struct Parser<'a> {
    tokens: &'a [Token],
    variables: &'a Variables,
    depth: usize,
}

impl Parser<'_> {
    fn next(&mut self) -> Result<&Token, ConditionError> {
        let (first, rest) = self.tokens.split_first().ok_or(ConditionError::EndsEarly)?;
        self.tokens = rest;
        Ok(first)
    }

    fn take_word(&mut self, wanted: &str) -> bool {
        let there = matches!(self.tokens.first(), Some(Token::Word(word)) if word == wanted);
        if there {
            self.tokens = &self.tokens[1..];
        }
        there
    }

    fn or_expression(&mut self) -> Result<bool, ConditionError> {
        let mut holds = self.and_expression()?;
        while self.take_word("or") {
            holds |= self.and_expression()?;
        }
        Ok(holds)
    }

    fn and_expression(&mut self) -> Result<bool, ConditionError> {
        let mut holds = self.comparison()?;
        while self.take_word("and") {
            holds &= self.comparison()?;
        }
        Ok(holds)
    }

    fn comparison(&mut self) -> Result<bool, ConditionError> {
        if self.tokens.first() == Some(&Token::Open) {
            self.tokens = &self.tokens[1..];
            self.depth += 1;
            if self.depth > MAX_DEPTH {
                return Err(ConditionError::TooDeep);
            }
            let holds = self.or_expression()?;
            self.depth -= 1;
            return match self.next()? {
                Token::Close => Ok(holds),
                other => Err(ConditionError::NoBracket(other.clone())),
            };
        }
        let left = self.value()?;
        let operator = match self.next()? {
            Token::Operator(operator) => *operator,
            other => return Err(ConditionError::NoComparison(other.clone())),
        };
        let right = self.value()?;
        let order = left.cmp(&right);
        Ok(match operator {
            "==" => order == Ordering::Equal,
            "!=" => order != Ordering::Equal,
            "<=" => order != Ordering::Greater,
            ">=" => order != Ordering::Less,
            "<" => order == Ordering::Less,
            _ => order == Ordering::Greater,
        })
    }

    fn value(&mut self) -> Result<String, ConditionError> {
        let variables = self.variables;
        match self.next()? {
            Token::Word(text) | Token::Quoted(text) => Ok(text.clone()),
            Token::Variable(name) => Ok(variables.get(name).to_owned()),
            other => Err(ConditionError::NoValue(other.clone())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn holds(condition: &str) -> bool {
        Variables::for_distribution(1, "noetic").evaluate(condition).unwrap()
    }

    #[test]
    fn conditions_in_use_are_understood() {
        assert!(holds("$ROS_VERSION == 1"));
        assert!(!holds("$ROS_VERSION==2"));
        assert!(holds("$ROS_PYTHON_VERSION >= 3"));
        assert!(holds("$ROS_DISTRO != melodic and $ROS_DISTRO > 'kinetic'"));
        assert!(holds("$ROS_VERSION == 2 or ($ROS_DISTRO == \"noetic\" and $UNSET == '')"));
        // "and" binds more tightly.
        assert!(holds("1 == 1 or 1 == 2 and 1 == 2"));
        assert!(!holds("(1 == 1 or 1 == 2) and 1 == 2"));
    }

    #[test]
    fn nonsense_is_told() {
        for (condition, reason) in [
            ("", "ends too early"),
            ("$ROS_VERSION", "ends too early"),
            ("$ROS_VERSION 1", "comparison is missing"),
            ("1 == 1 1", "unexpected"),
            ("(1 == 1", "ends too early"),
            ("'x == 1", "not closed"),
            ("1 == $", "unexpected"),
            ("1 & 2", "unexpected"),
            ("== 1", "value is missing"),
            (&"(".repeat(1000), "brackets"),
        ] {
            let problem = Variables::default().evaluate(condition).unwrap_err().to_string();
            assert!(problem.contains(reason), "{condition}: {problem}");
        }
    }
}
