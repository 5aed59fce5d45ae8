//! Imports between the files of a crate, read from its sources, and the circles among them.
//!
//! A file imports another if a `use` or a path in its code (`crate::a::b`, `super::a`, `self::a`, or `a::b` with a
//! module or an imported name `a`) names something that the other defines. A name is followed through re-exports to
//! the file that defines it; where that is not found, the module that was asked for it counts. `mod a;`, `pub use` and
//! the module in a visibility are no imports: they say where a name is, and need nothing of it. Items with
//! `#[cfg(test)]` are left out, and so are methods, whose files no path names.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::path::{Path, PathBuf};

/// Longest chain of re-exports that is followed.
const MOST_STEPS: usize = 24;

/// Returns the length of a string literal that begins at the first quotation mark of `text`.
fn string_length(text: &str) -> usize {
    let bytes = text.as_bytes();
    let mut at = 1;
    while at < bytes.len() && bytes[at] != b'"' {
        at += if bytes[at] == b'\\' { 2 } else { 1 };
    }
    at + 1
}

/// Returns the length of the character literal or the lifetime at the beginning of `text`.
fn character_length(text: &str) -> usize {
    let mut characters = text.char_indices().skip(1);
    match (characters.next(), characters.next()) {
        // The escaped character may itself be a quotation mark.
        (Some((_, '\\')), _) => 3 + text.get(3..).and_then(|rest| rest.find('\'')).unwrap_or(0) + 1,
        (Some(_), Some((end, '\''))) => end + 1,
        _ => 1 + word_length(&text[1..]),
    }
}

fn word_length(text: &str) -> usize {
    let is_of_word = |character: char| character.is_alphanumeric() || character == '_';
    text.find(|character| !is_of_word(character)).unwrap_or(text.len())
}

/// Returns the length of a comment at the beginning of `text`, which may contain others.
fn comment_length(text: &str) -> usize {
    if text.starts_with("//") {
        return text.find('\n').unwrap_or(text.len());
    }
    let mut depth = 0;
    let mut at = 0;
    while at < text.len() {
        let rest = &text.as_bytes()[at..];
        if rest.starts_with(b"/*") {
            depth += 1;
            at += 2;
        } else if rest.starts_with(b"*/") {
            depth -= 1;
            at += 2;
            if depth == 0 {
                break;
            }
        } else {
            at += 1;
        }
    }
    at
}

/// Returns the length of the literal that begins with `prefix` at the beginning of `text`, such as `r#"…"#` or `b'x'`.
fn prefixed_length(text: &str, prefix: &str) -> Option<usize> {
    let rest = &text[prefix.len()..];
    if matches!(prefix, "r" | "br" | "cr") {
        let marks = rest.len() - rest.trim_start_matches('#').len();
        let inside = rest[marks..].strip_prefix('"')?;
        let end = format!("\"{}", "#".repeat(marks));
        return Some(prefix.len() + marks + 1 + inside.find(&end)? + end.len());
    }
    match (prefix, rest.as_bytes().first()) {
        ("b" | "c", Some(b'"')) => Some(1 + string_length(rest)),
        ("b", Some(b'\'')) => Some(1 + character_length(rest)),
        _ => None,
    }
}

/// Splits source text into words, `::` and other characters, without comments and literals.
fn tokens(text: &str) -> Vec<&str> {
    let mut tokens = Vec::new();
    let mut rest = text;
    while let Some(first) = rest.chars().next() {
        let word = word_length(rest);
        let (length, is_token) = if rest.starts_with("//") || rest.starts_with("/*") {
            (comment_length(rest), false)
        } else if first == '"' {
            (string_length(rest), false)
        } else if first == '\'' {
            (character_length(rest), false)
        } else if let Some(length) = prefixed_length(rest, &rest[..word]) {
            (length, false)
        } else if word > 0 {
            (word, true)
        } else if rest.starts_with("::") {
            (2, true)
        } else {
            (first.len_utf8(), !first.is_whitespace())
        };
        let (token, after) = rest.split_at(length.min(rest.len()));
        if is_token {
            tokens.push(token);
        }
        rest = after;
    }
    tokens
}

/// Returns the number of tokens of an item, attributes before it included.
fn item_length(tokens: &[&str]) -> usize {
    let mut depth = 0;
    for (at, token) in tokens.iter().enumerate() {
        match *token {
            "(" | "[" | "{" => depth += 1,
            ")" | "]" => depth -= 1,
            "}" if depth == 1 => {
                // A list of imports goes on with a semicolon.
                let goes_on = tokens.get(at + 1) == Some(&";");
                return at + 1 + usize::from(goes_on);
            }
            "}" => depth -= 1,
            ";" | "," if depth == 0 => return at + 1,
            _ => {}
        }
        if depth < 0 {
            return at;
        }
    }
    tokens.len()
}

/// Returns the number of tokens up to the brace that closes the one at the beginning.
fn block_length(tokens: &[&str]) -> usize {
    let mut depth = 0;
    for (at, token) in tokens.iter().enumerate() {
        match *token {
            "{" => depth += 1,
            "}" => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return at + 1;
        }
    }
    tokens.len()
}

fn is_word(token: &str) -> bool {
    token.starts_with(|first: char| first.is_alphabetic() || first == '_')
}

fn words(tokens: &[&str]) -> Vec<String> {
    let words = tokens.iter().filter(|token| is_word(token));
    words.map(|word| (*word).to_owned()).collect()
}

/// A name that a module takes from elsewhere; `*` stands for all names.
struct Import {
    path: Vec<String>,
    name: String,
    is_reexport: bool,
}

#[derive(Default)]
struct Module {
    file: PathBuf,
    parent: Option<usize>,
    children: BTreeMap<String, usize>,
    imports: Vec<Import>,
    definitions: BTreeSet<String>,
    /// Paths in the code, besides those of imports.
    paths: BTreeSet<Vec<String>>,
}

impl Module {
    fn import_of(&self, name: &str) -> Option<&Import> {
        self.imports.iter().find(|import| import.name == name)
    }
}

/// The modules of a crate; the first is its root.
#[derive(Default)]
struct Modules(Vec<Module>);

/// Reads the tree of a `use`, whose tokens end before its semicolon.
fn read_use(tokens: &[&str], before: &[String], is_reexport: bool, into: &mut Vec<Import>) {
    if let Some(open) = tokens.iter().position(|token| *token == "{") {
        let mut path = before.to_vec();
        path.extend(words(&tokens[..open]));
        let mut depth = 0;
        let inside = &tokens[open + 1..tokens.len() - 1];
        let parts = inside.split(|token| {
            match *token {
                "{" => depth += 1,
                "}" => depth -= 1,
                _ => {}
            }
            *token == "," && depth == 0
        });
        for part in parts.filter(|part| !part.is_empty()) {
            read_use(part, &path, is_reexport, into);
        }
        return;
    }
    let renamed = tokens.iter().position(|token| *token == "as");
    let (named, alias) = match renamed {
        Some(at) => (&tokens[..at], tokens.get(at + 1)),
        None => (tokens, None),
    };
    let mut path = before.to_vec();
    path.extend(words(named));
    if path.len() > 1 && path.last().is_some_and(|last| last == "self") {
        path.pop();
    }
    let last = path.last().cloned().unwrap_or_default();
    let name = match (named.last(), alias) {
        (Some(&"*"), _) => "*".to_owned(),
        (_, Some(alias)) => (*alias).to_owned(),
        _ => last,
    };
    into.push(Import { path, name, is_reexport });
}

impl Modules {
    /// Reads a file and the files of its modules. `below` is the directory of the latter.
    fn read_file(&mut self, file: &Path, below: &Path, parent: Option<usize>) -> usize {
        let text = std::fs::read_to_string(file).expect("a source file");
        self.read_module(&tokens(&text), file, below, parent)
    }

    fn read_module(&mut self, tokens: &[&str], file: &Path, below: &Path, parent: Option<usize>) -> usize {
        let number = self.0.len();
        self.0.push(Module { file: file.to_owned(), parent, ..Module::default() });
        let mut at = 0;
        while at < tokens.len() {
            let rest = &tokens[at..];
            at += match rest {
                ["#", "[", "cfg", "(", "test", ..] | ["#", "[", "cfg", "(", "all", "(", "test", ..] => {
                    item_length_after_attribute(rest)
                }
                // A visibility needs nothing of the module that it names.
                ["pub", "(", "in", ..] => rest.iter().position(|token| *token == ")").unwrap_or(rest.len()),
                ["mod", name, ";", ..] => {
                    let own = below.join(format!("{name}.rs"));
                    if own.exists() {
                        let child = self.read_file(&own, &below.join(name), Some(number));
                        self.0[number].children.insert((*name).to_owned(), child);
                    }
                    3
                }
                ["mod", name, "{", ..] => {
                    let length = block_length(&rest[2..]);
                    let (inside, below) = (&rest[3..1 + length], below.join(name));
                    let child = self.read_module(inside, file, &below, Some(number));
                    self.0[number].children.insert((*name).to_owned(), child);
                    2 + length
                }
                // `use<…>` names captured lifetimes, and `use ::a` another crate.
                ["use", next, ..] if !matches!(*next, "<" | "::") => {
                    let end = rest.iter().position(|token| *token == ";").unwrap_or(rest.len());
                    let is_reexport = at > 0 && matches!(tokens[at - 1], "pub" | ")");
                    read_use(&rest[1..end], &[], is_reexport, &mut self.0[number].imports);
                    end
                }
                ["fn" | "struct" | "enum" | "trait" | "type" | "const" | "static" | "union", name, ..]
                    if is_word(name) =>
                {
                    self.0[number].definitions.insert((*name).to_owned());
                    1
                }
                ["macro_rules", "!", name, ..] => {
                    self.0[number].definitions.insert((*name).to_owned());
                    3
                }
                [word, "::", next, ..] if is_word(word) && is_word(next) && (at == 0 || tokens[at - 1] != "::") => {
                    let words = rest.chunks(2).take_while(|pair| is_word(pair[0]));
                    let mut path = Vec::new();
                    for pair in words {
                        path.push(pair[0].to_owned());
                        if pair.get(1) != Some(&"::") {
                            break;
                        }
                    }
                    let length = 2 * path.len() - 1;
                    self.0[number].paths.insert(path);
                    length
                }
                _ => 1,
            };
        }
        number
    }

    /// Returns the module that defines what `path` names in the code of a module; `None` if another crate does.
    fn resolve(&self, module: usize, path: &[String], steps: usize) -> Option<usize> {
        let (first, rest) = path.split_first()?;
        match first.as_str() {
            _ if steps > MOST_STEPS => None,
            "crate" => self.walk(0, rest, steps),
            "self" => self.walk(module, rest, steps),
            "super" => self.walk(self.0[module].parent?, rest, steps),
            name => match self.0[module].children.get(name) {
                Some(child) => self.walk(*child, rest, steps),
                None => self.follow(module, self.0[module].import_of(name)?, rest, steps),
            },
        }
    }

    /// Returns the module that defines what an import names, or what `rest` names in it.
    fn follow(&self, module: usize, import: &Import, rest: &[String], steps: usize) -> Option<usize> {
        let first = import.path.first()?;
        // Names of other crates look like those of modules.
        let is_own = matches!(first.as_str(), "crate" | "self" | "super")
            || self.0[module].children.contains_key(first)
            || (*first != import.name && self.0[module].import_of(first).is_some());
        if !is_own {
            return None;
        }
        let path: Vec<String> = import.path.iter().chain(rest).cloned().collect();
        self.resolve(module, &path, steps + 1)
    }

    /// Returns the module that defines what `path` names in a module, seen from outside.
    fn walk(&self, number: usize, path: &[String], steps: usize) -> Option<usize> {
        let Some((first, rest)) = path.split_first() else {
            return Some(number);
        };
        let module = &self.0[number];
        if first == "super" {
            return self.walk(module.parent?, rest, steps);
        }
        if let Some(child) = module.children.get(first) {
            return self.walk(*child, rest, steps);
        }
        if module.definitions.contains(first) || steps > MOST_STEPS {
            return Some(number);
        }
        if let Some(import) = module.import_of(first) {
            return self.follow(number, import, rest, steps);
        }
        for import in module.imports.iter().filter(|import| import.name == "*") {
            let from = self.follow(number, import, &[], steps);
            let Some(from) = from.filter(|from| *from != number) else {
                continue;
            };
            if self.0[from].definitions.contains(first) || self.0[from].import_of(first).is_some() {
                return self.walk(from, path, steps + 1);
            }
        }
        Some(number)
    }

    /// Returns the files that each file imports.
    fn imports(&self) -> Imports {
        let mut imports = Imports::new();
        for (number, module) in self.0.iter().enumerate() {
            let used = module.imports.iter().filter(|import| !import.is_reexport);
            let used = used.map(|import| &import.path).chain(&module.paths);
            let from = used.filter_map(|path| self.resolve(number, path, 0));
            let files = from.map(|from| &self.0[from].file);
            let files = files.filter(|file| **file != module.file).cloned();
            imports.entry(module.file.clone()).or_default().extend(files);
        }
        imports
    }
}

/// Returns the number of tokens of an attribute and of what it stands before.
fn item_length_after_attribute(tokens: &[&str]) -> usize {
    let end = tokens.iter().position(|token| *token == "]").unwrap_or(tokens.len() - 1);
    let attribute = end + 1;
    attribute + item_length(&tokens[attribute..])
}

/// Files by the file that imports them.
pub type Imports = BTreeMap<PathBuf, BTreeSet<PathBuf>>;

/// Returns the imports between the files of the crate with this root file.
pub fn read_imports(root: &Path) -> Imports {
    let mut modules = Modules::default();
    modules.read_file(root, root.parent().expect("a directory"), None);
    modules.imports()
}

/// Returns the shortest way along imports from a file to itself through files of `within`.
fn shortest_cycle_of(file: &Path, imports: &Imports, within: &BTreeSet<PathBuf>) -> Option<Vec<PathBuf>> {
    let mut ways = VecDeque::from([vec![file.to_owned()]]);
    let mut seen = BTreeSet::new();
    while let Some(way) = ways.pop_front() {
        for next in imports.get(way.last()?)?.intersection(within) {
            if next.as_path() == file {
                return Some(way);
            }
            if seen.insert(next.clone()) {
                let mut longer = way.clone();
                longer.push(next.clone());
                ways.push_back(longer);
            }
        }
    }
    None
}

/// Returns the shortest circle among these files; among those, one that no folder holds if there is one.
pub fn shortest_cycle(files: &BTreeSet<PathBuf>, imports: &Imports) -> Vec<PathBuf> {
    let cycles = files.iter().filter_map(|file| shortest_cycle_of(file, imports, files));
    cycles.min_by_key(|cycle| (is_in_one_folder(cycle), cycle.len())).unwrap_or_default()
}

fn reachable(file: &Path, imports: &Imports) -> BTreeSet<PathBuf> {
    let mut reached = BTreeSet::new();
    let mut next = vec![file];
    while let Some(file) = next.pop() {
        for imported in imports.get(file).into_iter().flatten() {
            if reached.insert(imported.clone()) {
                next.push(imported);
            }
        }
    }
    reached
}

/// Returns the sets of several files that all import one another, directly or through others.
pub fn find_circles(imports: &Imports) -> BTreeSet<BTreeSet<PathBuf>> {
    let reached: BTreeMap<&PathBuf, BTreeSet<PathBuf>> =
        imports.keys().map(|file| (file, reachable(file, imports))).collect();
    let circle = |file: &PathBuf| -> BTreeSet<PathBuf> {
        let reaches_back = |other: &&PathBuf| reached.get(other).is_some_and(|back| back.contains(file));
        reached[file].iter().filter(reaches_back).cloned().collect()
    };
    imports.keys().map(circle).filter(|circle| circle.len() > 1).collect()
}

/// Returns true if one folder holds all files. The file of a module with a folder, such as `local.rs` beside `local/`,
/// belongs to both.
pub fn is_in_one_folder<'a>(files: impl IntoIterator<Item = &'a PathBuf>) -> bool {
    let folders = files.into_iter().map(|file| {
        let of_module = file.with_extension("");
        let parent = file.parent().map(Path::to_owned);
        BTreeSet::from_iter(parent.into_iter().chain(of_module.is_dir().then_some(of_module)))
    });
    folders.reduce(|all, folders| &all & &folders).is_none_or(|common| !common.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn circles_of(files: &[(&str, &str)]) -> Vec<Vec<String>> {
        let home = tempfile::tempdir().expect("a directory");
        for (name, text) in files {
            let path = home.path().join(name);
            std::fs::create_dir_all(path.parent().expect("a folder")).expect("made");
            std::fs::write(path, text).expect("written");
        }
        let imports = read_imports(&home.path().join("lib.rs"));
        let name = |file: &PathBuf| {
            let inside = file.strip_prefix(home.path()).expect("a file of it");
            inside.display().to_string()
        };
        let circles = find_circles(&imports);
        circles.iter().map(|circle| circle.iter().map(name).collect()).collect()
    }

    #[test]
    fn circles_are_found_through_re_exports_and_paths() {
        let circles = circles_of(&[
            ("lib.rs", "mod a;\nmod b;\nmod c;\npub use a::A;\n"),
            ("a.rs", "use crate::b::{self, B};\npub struct A(B);"),
            // The root re-exports A, which is in a.rs.
            ("b.rs", "pub struct B;\nfn f() { let _ = crate::A::default(); }"),
            ("c.rs", "use crate::a::A;\n/* use crate::d; */ const TEXT: &str = \"crate::c::D\";"),
        ]);
        assert_eq!(circles, [["a.rs", "b.rs"]]);
    }

    #[test]
    fn tests_and_declarations_are_no_imports() {
        let circles = circles_of(&[
            ("lib.rs", "mod a;\nmod c;\npub(crate) use a::A;\npub struct B;"),
            ("a.rs", "use super::B;\npub struct A(B, char);\nfn f() -> char { '\"' }\nfn g<'a>(_: &'a str) {}\nmod b;"),
            ("a/b.rs", "#[cfg(test)]\nmod tests { use super::super::A; }\n#[cfg(test)]\nuse crate::a::A;\nfn f() {}"),
            ("c.rs", "mod d;\nuse self::d::D;\nstruct C(D);"),
            ("c/d.rs", "pub(in crate::c) struct D;"),
        ]);
        assert_eq!(circles, Vec::<Vec<String>>::new());
    }
}
