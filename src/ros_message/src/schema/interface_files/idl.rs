//! OMG IDL 4.2, the subset that rosidl reads: modules, structures, constants, `typedef` for arrays, annotations.

mod error;
mod tokens;

use std::collections::BTreeMap;

use crate::schema::interface_files::description::tuple_to_list;
use crate::schema::interface_files::idl::tokens::{IdlToken, Tokens};
use crate::schema::interface_files::{FieldLine, InterfaceFile, assemble, quote};
use crate::schema::limits::{MAX_NAME_BYTES, MOST_MODULES};
use crate::schema::{ExceededLimit, MAX_TEXT_BYTES, SchemaError, SyntaxError};

pub use self::error::IdlError;

pub(super) fn read(key: &str, idl: &str) -> Result<InterfaceFile, SchemaError> {
    if idl.len() > MAX_TEXT_BYTES {
        return Err(SchemaError::TooLarge { name: key.to_owned(), reason: ExceededLimit::IdlBytes });
    }
    let mut reader = IdlReader {
        tokens: Tokens::new(idl),
        scope: Vec::new(),
        aliases: BTreeMap::new(),
        constants: BTreeMap::new(),
        structures: BTreeMap::new(),
        written: 0,
    };
    reader.items().map_err(|reason| SchemaError::Syntax {
        name: key.to_owned(),
        line: reader.tokens.line(),
        reason: Box::new(reason),
    })?;
    // Constants of a structure are in a module of their own, because IDL structures cannot contain any.
    let mut texts = reader.structures;
    for (module, text) in reader.constants {
        let owner = module.strip_suffix("_Constants").unwrap_or(&module);
        if let Some(structure) = texts.get_mut(owner) {
            structure.insert_str(0, &text);
        }
    }
    let own = assemble(key, &texts)?;
    let mut definitions: BTreeMap<String, String> =
        texts.into_iter().filter(|(name, _)| name.split('/').nth(1) == Some("msg")).collect();
    definitions.insert(key.to_owned(), own);
    Ok(InterfaceFile { definitions, hashes: BTreeMap::new() })
}

struct IdlReader<'a> {
    tokens: Tokens<'a>,
    /// Enclosing modules.
    scope: Vec<String>,
    /// `typedef`s: type and brackets, by name.
    aliases: BTreeMap<String, FieldLine>,
    /// Lines by module, `a/msg/A_Constants`.
    constants: BTreeMap<String, String>,
    /// Lines by structure, `a/msg/A`.
    structures: BTreeMap<String, String>,
    /// Bytes of all lines, limited because short aliases may stand for long types.
    written: usize,
}

impl IdlReader<'_> {
    /// Parses items up to the end of the text, or to the brace that closes a module.
    fn items(&mut self) -> Result<(), SyntaxError> {
        loop {
            match self.tokens.next()? {
                None if self.scope.is_empty() => return Ok(()),
                None => return Err(IdlError::UnclosedModule.into()),
                Some(IdlToken::Mark('}')) if !self.scope.is_empty() => return Ok(()),
                Some(IdlToken::Mark(';')) => {}
                Some(IdlToken::Mark('@')) => drop(self.annotation()?),
                Some(IdlToken::Word("module")) => self.module()?,
                Some(IdlToken::Word("struct")) => self.structure()?,
                Some(IdlToken::Word("const")) => self.constant()?,
                Some(IdlToken::Word("typedef")) => {
                    let alias = self.declaration()?;
                    self.aliases.insert(alias.name.clone(), alias);
                }
                Some(other) => {
                    return Err(IdlError::NotADefinition(other.to_string()).into());
                }
            }
        }
    }

    fn module(&mut self) -> Result<(), SyntaxError> {
        let name = self.name()?.to_owned();
        if self.scope.len() >= MOST_MODULES {
            return Err(IdlError::DeepModules.into());
        }
        self.tokens.expect('{')?;
        self.scope.push(name);
        self.items()?;
        self.scope.pop();
        Ok(())
    }

    fn structure(&mut self) -> Result<(), SyntaxError> {
        let name = self.full_name()?;
        self.tokens.expect('{')?;
        let (mut text, mut value) = (String::new(), None);
        while !self.tokens.skip('}')? {
            if self.tokens.skip('@')? {
                value = self.annotation()?.or(value);
                continue;
            }
            let mut field = self.declaration()?;
            if let Some(value) = value.take() {
                field.value = value.to_msg_text(&field);
            }
            if field.name != crate::schema::description::PLACEHOLDER {
                self.append(&field, &mut text)?;
            }
        }
        self.structures.insert(name, text);
        Ok(())
    }

    fn constant(&mut self) -> Result<(), SyntaxError> {
        let mut constant = self.declarator()?;
        self.tokens.expect('=')?;
        let value = self.literal()?;
        self.tokens.expect(';')?;
        constant.value = format!("= {}", value.to_msg_text(&constant));
        // The bound of a string is irrelevant for a constant.
        let bare = constant.one.split("<=").next().unwrap_or_default();
        constant.one = bare.to_owned();
        let module = self.scope.join("/");
        let mut text = self.constants.remove(&module).unwrap_or_default();
        self.append(&constant, &mut text)?;
        self.constants.insert(module, text);
        Ok(())
    }

    fn append(&mut self, line: &FieldLine, text: &mut String) -> Result<(), SyntaxError> {
        let before = text.len();
        line.append_to(text)?;
        self.written += text.len() - before;
        if self.written > MAX_TEXT_BYTES {
            return Err(IdlError::TooMuchText.into());
        }
        Ok(())
    }

    fn name(&mut self) -> Result<&str, SyntaxError> {
        let name = self.tokens.word()?;
        match name.len() {
            0..=MAX_NAME_BYTES => Ok(name),
            _ => Err(SyntaxError::LongName),
        }
    }

    /// Parses `TYPE NAME;` or `TYPE NAME[N];`
    fn declaration(&mut self) -> Result<FieldLine, SyntaxError> {
        let line = self.declarator()?;
        self.tokens.expect(';')?;
        Ok(line)
    }

    fn declarator(&mut self) -> Result<FieldLine, SyntaxError> {
        let mut line = self.parse_type(0)?;
        line.name = self.name()?.to_owned();
        if self.tokens.skip('[')? {
            if !line.brackets.is_empty() {
                return Err(IdlError::ArrayOfArrays(line.name).into());
            }
            line.brackets = format!("[{}]", self.name()?);
            self.tokens.expect(']')?;
        }
        Ok(line)
    }

    fn full_name(&mut self) -> Result<String, SyntaxError> {
        let name = self.name()?.to_owned();
        let outer = self.scope.iter().map(|module| format!("{module}/"));
        Ok(outer.chain([name]).collect())
    }

    /// Parses a type: its name in the `.msg` language, and its brackets.
    fn parse_type(&mut self, depth: usize) -> Result<FieldLine, SyntaxError> {
        let first = self.name()?.to_owned();
        let one = match &*first {
            "sequence" => return self.sequence(depth),
            "string" | "wstring" => {
                let mut one = first;
                if self.tokens.skip('<')? {
                    one.push_str("<=");
                    one.push_str(self.name()?);
                    self.tokens.expect('>')?;
                }
                one
            }
            "boolean" => "bool".to_owned(),
            "octet" => "byte".to_owned(),
            "float" => "float32".to_owned(),
            "double" => "float64".to_owned(),
            "short" => "int16".to_owned(),
            "long" if self.tokens.skip_word("double")? => {
                return Err(IdlError::NotInMessages("long double".to_owned()).into());
            }
            "long" => self.long("int")?,
            "unsigned" => match self.tokens.word()? {
                "short" => "uint16".to_owned(),
                "long" => self.long("uint")?,
                other => return Err(IdlError::NotUnsigned(other.to_owned()).into()),
            },
            "int8" | "uint8" | "int16" | "uint16" | "int32" | "uint32" | "int64" | "uint64" => first,
            // `char` in `.msg` is uint8, which has another hash.
            "char" | "wchar" | "fixed" | "any" | "enum" | "union" | "map" => {
                return Err(IdlError::NotInMessages(first).into());
            }
            name => {
                let mut path = vec![name.to_owned()];
                while self.tokens.skip(':')? {
                    self.tokens.expect(':')?;
                    path.push(self.name()?.to_owned());
                    if path.len() > MOST_MODULES {
                        return Err(IdlError::DeepType(name.to_owned()).into());
                    }
                }
                if let [name] = &path[..] {
                    if let Some(alias) = self.aliases.get(name) {
                        return Ok(alias.clone());
                    }
                }
                match path.len() {
                    1 => format!("{}/{}", self.scope.join("/"), path[0]),
                    _ => path.join("/"),
                }
            }
        };
        Ok(FieldLine { one, ..FieldLine::default() })
    }

    fn sequence(&mut self, depth: usize) -> Result<FieldLine, SyntaxError> {
        self.tokens.expect('<')?;
        if depth > 0 {
            return Err(IdlError::NotInMessages("sequences of sequences".to_owned()).into());
        }
        let mut line = self.parse_type(depth + 1)?;
        if !line.brackets.is_empty() {
            return Err(IdlError::NotInMessages("sequences of arrays".to_owned()).into());
        }
        line.brackets = if self.tokens.skip(',')? { format!("[<={}]", self.name()?) } else { "[]".to_owned() };
        self.tokens.expect('>')?;
        Ok(line)
    }

    /// Parses the rest of a type that began with `long`: 64 bits if another `long` follows, otherwise 32.
    fn long(&mut self, kind: &str) -> Result<String, SyntaxError> {
        let bits = if self.tokens.skip_word("long")? { 64 } else { 32 };
        Ok(format!("{kind}{bits}"))
    }

    /// Parses an annotation after the `@`; returns the value of a `default`.
    fn annotation(&mut self) -> Result<Option<Literal>, SyntaxError> {
        let is_default = self.tokens.word()? == "default";
        let mut value = None;
        if !self.tokens.skip('(')? {
            return Ok(None);
        }
        while !self.tokens.skip(')')? {
            let name = self.tokens.word()?;
            let is_value = is_default && name == "value";
            self.tokens.expect('=')?;
            let literal = self.literal()?;
            if is_value {
                value = Some(literal);
            }
            self.tokens.skip(',')?;
        }
        Ok(value)
    }

    fn literal(&mut self) -> Result<Literal, SyntaxError> {
        let mut text = match self.tokens.next()? {
            Some(IdlToken::Text(text)) => text,
            Some(IdlToken::Word(word)) => return Ok(Literal::Word(word.to_owned())),
            other => return Err(IdlError::NotAValue(IdlToken::describe(other)).into()),
        };
        // Adjacent texts are concatenated.
        while let Some(more) = self.tokens.skip_text()? {
            text.push_str(&more);
        }
        Ok(Literal::Text(text))
    }
}

/// A literal value.
enum Literal {
    Text(String),
    Word(String),
}

impl Literal {
    /// Returns the value of the field in the notation of `.msg`.
    fn to_msg_text(&self, field: &FieldLine) -> String {
        match self {
            Literal::Text(list) if !field.brackets.is_empty() => tuple_to_list(list),
            Literal::Text(text) if matches!(field.one.split("<=").next(), Some("string" | "wstring")) => quote(text),
            Literal::Text(text) => text.clone(),
            Literal::Word(word) => word.clone(),
        }
    }
}
