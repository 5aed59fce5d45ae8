//! Tokens of IDL.

use std::fmt;

use super::IdlError;

/// A word, a text, or a punctuation mark.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum IdlToken<'a> {
    /// Name, keyword or number.
    Word(&'a str),
    /// Quoted text, with escapes resolved.
    Text(String),
    Mark(char),
}

impl fmt::Display for IdlToken<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            IdlToken::Word(word) => write!(f, "{word}"),
            IdlToken::Text(text) => write!(f, "{text:?}"),
            IdlToken::Mark(mark) => write!(f, "{mark}"),
        }
    }
}

impl IdlToken<'_> {
    pub(super) fn describe(token: Option<IdlToken<'_>>) -> String {
        token.map_or("the end of the text".to_owned(), |token| token.to_string())
    }
}

/// Tokenizer.
pub(super) struct Tokens<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Tokens<'a> {
    pub(super) fn new(text: &'a str) -> Self {
        Tokens { text, at: 0 }
    }

    /// Returns the current line, from 1.
    pub(super) fn line(&self) -> usize {
        self.text[..self.at].matches('\n').count() + 1
    }

    pub(super) fn next(&mut self) -> Result<Option<IdlToken<'a>>, IdlError> {
        self.skip_space()?;
        let rest = &self.text[self.at..];
        let Some(first) = rest.chars().next() else {
            return Ok(None);
        };
        if first == '"' || (first == 'L' && rest.starts_with("L\"")) {
            self.at += rest.find('"').unwrap_or_default() + 1;
            return self.take_quoted().map(|text| Some(IdlToken::Text(text)));
        }
        // A number is a word with a sign, a point or an exponent.
        let is_number = first.is_ascii_digit() || matches!(first, '-' | '+' | '.');
        let in_word = |(at, byte): (usize, char)| {
            let before = rest[..at].chars().next_back();
            byte.is_ascii_alphanumeric()
                || byte == '_'
                || (is_number && byte == '.')
                || (is_number && matches!(byte, '-' | '+') && matches!(before, None | Some('e' | 'E')))
        };
        let end = rest.char_indices().find(|it| !in_word(*it));
        let end = end.map_or(rest.len(), |(at, _)| at);
        if end == 0 {
            self.at += first.len_utf8();
            return Ok(Some(IdlToken::Mark(first)));
        }
        self.at += end;
        Ok(Some(IdlToken::Word(&rest[..end])))
    }

    pub(super) fn word(&mut self) -> Result<&'a str, IdlError> {
        match self.next()? {
            Some(IdlToken::Word(word)) => Ok(word),
            other => Err(IdlError::NotAName(IdlToken::describe(other))),
        }
    }

    pub(super) fn expect(&mut self, mark: char) -> Result<(), IdlError> {
        match self.next()? {
            Some(IdlToken::Mark(found)) if found == mark => Ok(()),
            other => Err(IdlError::MissingMark { expected: mark, found: IdlToken::describe(other) }),
        }
    }

    /// Skips the mark if it follows.
    pub(super) fn skip(&mut self, mark: char) -> Result<bool, IdlError> {
        self.skip_if(|token| *token == IdlToken::Mark(mark)).map(|skipped| skipped.is_some())
    }

    /// Skips the word if it follows.
    pub(super) fn skip_word(&mut self, word: &str) -> Result<bool, IdlError> {
        self.skip_if(|token| *token == IdlToken::Word(word)).map(|skipped| skipped.is_some())
    }

    /// Skips and returns a text if one follows.
    pub(super) fn skip_text(&mut self) -> Result<Option<String>, IdlError> {
        let skipped = self.skip_if(|token| matches!(token, IdlToken::Text(_)))?;
        Ok(match skipped {
            Some(IdlToken::Text(text)) => Some(text),
            _ => None,
        })
    }

    fn skip_if(&mut self, is: impl Fn(&IdlToken<'_>) -> bool) -> Result<Option<IdlToken<'a>>, IdlError> {
        let before = self.at;
        match self.next()? {
            Some(token) if is(&token) => Ok(Some(token)),
            _ => {
                self.at = before;
                Ok(None)
            }
        }
    }

    /// Skips white space, comments and preprocessor lines.
    fn skip_space(&mut self) -> Result<(), IdlError> {
        loop {
            let rest = &self.text[self.at..];
            let space = rest.len() - rest.trim_start().len();
            self.at += space;
            let rest = &rest[space..];
            if rest.starts_with("//") || rest.starts_with('#') {
                self.at += rest.find('\n').unwrap_or(rest.len());
            } else if rest.starts_with("/*") {
                let end = rest.find("*/").ok_or(IdlError::UnclosedComment)?;
                self.at += end + 2;
            } else {
                return Ok(());
            }
        }
    }

    /// Reads a quoted text after its opening quote.
    fn take_quoted(&mut self) -> Result<String, IdlError> {
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
        Err(IdlError::UnclosedText)
    }
}
