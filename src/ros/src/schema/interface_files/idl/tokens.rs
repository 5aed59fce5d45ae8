//! The words of IDL.

use std::fmt;

/// A word, a text, or a mark.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Token<'a> {
    /// Names, keywords and numbers.
    Word(&'a str),
    /// What was in quotes, escapes resolved.
    Text(String),
    Mark(char),
}

impl fmt::Display for Token<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Token::Word(word) => write!(f, "{word}"),
            Token::Text(text) => write!(f, "{text:?}"),
            Token::Mark(mark) => write!(f, "{mark}"),
        }
    }
}

impl Token<'_> {
    pub(super) fn or_end(token: Option<Token<'_>>) -> String {
        token.map_or("the end of the text".to_owned(), |token| token.to_string())
    }
}

/// Gives the tokens of a text one by one.
pub(super) struct Tokens<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Tokens<'a> {
    pub(super) fn new(text: &'a str) -> Self {
        Tokens { text, at: 0 }
    }

    /// Where it is, from 1.
    pub(super) fn line(&self) -> usize {
        self.text[..self.at].matches('\n').count() + 1
    }

    pub(super) fn next(&mut self) -> Result<Option<Token<'a>>, String> {
        self.skip_space()?;
        let rest = &self.text[self.at..];
        let Some(first) = rest.chars().next() else {
            return Ok(None);
        };
        if first == '"' || (first == 'L' && rest.starts_with("L\"")) {
            self.at += rest.find('"').unwrap_or_default() + 1;
            return self.quoted().map(|text| Some(Token::Text(text)));
        }
        // Numbers are words with a sign, a point or an exponent.
        let is_number = first.is_ascii_digit() || matches!(first, '-' | '+' | '.');
        let in_word = |(at, byte): (usize, char)| {
            let before = rest[..at].chars().next_back();
            byte.is_ascii_alphanumeric()
                || byte == '_'
                || (is_number && byte == '.')
                || (is_number
                    && matches!(byte, '-' | '+')
                    && matches!(before, None | Some('e' | 'E')))
        };
        let end = rest.char_indices().find(|it| !in_word(*it));
        let end = end.map_or(rest.len(), |(at, _)| at);
        if end == 0 {
            self.at += first.len_utf8();
            return Ok(Some(Token::Mark(first)));
        }
        self.at += end;
        Ok(Some(Token::Word(&rest[..end])))
    }

    pub(super) fn word(&mut self) -> Result<&'a str, String> {
        match self.next()? {
            Some(Token::Word(word)) => Ok(word),
            other => Err(format!("expected a name, got {}", Token::or_end(other))),
        }
    }

    pub(super) fn expect(&mut self, mark: char) -> Result<(), String> {
        match self.next()? {
            Some(Token::Mark(found)) if found == mark => Ok(()),
            other => Err(format!("expected {mark}, got {}", Token::or_end(other))),
        }
    }

    /// Skips the mark if it follows.
    pub(super) fn skip(&mut self, mark: char) -> Result<bool, String> {
        self.skip_if(|token| *token == Token::Mark(mark))
            .map(|skipped| skipped.is_some())
    }

    /// Skips the word if it follows.
    pub(super) fn skip_word(&mut self, word: &str) -> Result<bool, String> {
        self.skip_if(|token| *token == Token::Word(word))
            .map(|skipped| skipped.is_some())
    }

    /// Skips a text if one follows, and gives it.
    pub(super) fn skip_text(&mut self) -> Result<Option<String>, String> {
        let skipped = self.skip_if(|token| matches!(token, Token::Text(_)))?;
        Ok(match skipped {
            Some(Token::Text(text)) => Some(text),
            _ => None,
        })
    }

    fn skip_if(&mut self, is: impl Fn(&Token<'_>) -> bool) -> Result<Option<Token<'a>>, String> {
        let before = self.at;
        match self.next()? {
            Some(token) if is(&token) => Ok(Some(token)),
            _ => {
                self.at = before;
                Ok(None)
            }
        }
    }

    /// White space, comments, and lines for the preprocessor.
    fn skip_space(&mut self) -> Result<(), String> {
        loop {
            let rest = &self.text[self.at..];
            let space = rest.len() - rest.trim_start().len();
            self.at += space;
            let rest = &rest[space..];
            if rest.starts_with("//") || rest.starts_with('#') {
                self.at += rest.find('\n').unwrap_or(rest.len());
            } else if rest.starts_with("/*") {
                let end = rest.find("*/").ok_or("a comment without an end")?;
                self.at += end + 2;
            } else {
                return Ok(());
            }
        }
    }

    /// Behind the opening quote.
    fn quoted(&mut self) -> Result<String, String> {
        let mut text = String::new();
        let mut characters = self.text[self.at..].char_indices();
        while let Some((at, character)) = characters.next() {
            match character {
                '"' => {
                    self.at += at + 1;
                    return Ok(text);
                }
                '\\' => text.push(match characters.next() {
                    Some((_, 'n')) => '\n',
                    Some((_, 't')) => '\t',
                    Some((_, 'r')) => '\r',
                    Some((_, other)) => other,
                    None => break,
                }),
                other => text.push(other),
            }
        }
        Err("a text without a closing quote".to_owned())
    }
}
