//! Compares the documentation with the repository: ARCHITECTURE.md (dependencies between crates, circles of files),
//! docs/security.md (stories that security rests on) and tests/subjects.rs (crates that stories are about).

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

#[path = "architecture/imports.rs"]
mod imports;
#[path = "../../../tests/subjects.rs"]
mod subjects;

/// Largest number of files of one folder that may import one another.
const LARGEST_CIRCLE: usize = 5;

/// Returns the root of the repository.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().expect("two levels up")
}

fn read(path: &Path) -> toml::Table {
    let text = std::fs::read_to_string(path).expect("a manifest");
    toml::from_str(&text).expect("TOML")
}

/// Returns the names of all crates of the workspace by their directories.
fn members() -> BTreeMap<String, String> {
    let workspace = read(&root().join("Cargo.toml"));
    let members = workspace["workspace"]["members"].as_array().expect("a list");
    let directories = members.iter().filter_map(|member| member.as_str());
    directories
        .map(|directory| {
            let manifest = read(&root().join(directory).join("Cargo.toml"));
            let name = manifest["package"]["name"].as_str().expect("a name");
            (directory.to_owned(), name.to_owned())
        })
        .collect()
}

/// Returns the crates of `known` that the crate in `directory` depends on, without dev-dependencies.
fn dependencies(directory: &str, known: &BTreeSet<&str>) -> BTreeSet<String> {
    let manifest = read(&root().join(directory).join("Cargo.toml"));
    let Some(dependencies) = manifest.get("dependencies").and_then(|all| all.as_table()) else {
        return BTreeSet::new();
    };
    let ours = dependencies.keys().filter(|name| known.contains(name.as_str()));
    ours.cloned().collect()
}

/// Returns the rows of the map: the path in the first column and the crates that it uses.
fn rows() -> Vec<(String, BTreeSet<String>)> {
    let text = std::fs::read_to_string(root().join("ARCHITECTURE.md")).expect("it is there");
    let (_, map) = text.split_once("\n| where | what it is | uses |").expect("the map");
    let (map, _) = map.split_once("\n\n").expect("its end");
    let rows = map.lines().filter(|line| line.starts_with("| `"));
    rows.map(|line| {
        let cells: Vec<&str> = line.trim_matches('|').split(" | ").collect();
        let place = cells[0].trim().trim_matches('`').trim_end_matches('/');
        let uses = cells.get(2).copied().unwrap_or_default();
        let uses = uses.split([',', '|']).map(str::trim);
        let uses = uses.filter(|name| !name.is_empty());
        (place.to_owned(), uses.map(str::to_owned).collect())
    })
    .collect()
}

#[test]
fn the_map_says_what_the_manifests_say() {
    let members = members();
    // Benchmarks and stories use one another; they do not belong to the system.
    let part = |name: &&str| *name != "stories" && !name.starts_with("bench-");
    let known: BTreeSet<&str> = members.values().map(String::as_str).filter(part).collect();
    let rows = rows();
    let mut above = BTreeSet::new();
    for (place, told) in &rows {
        let inside = |directory: &&String| *directory == place || directory.starts_with(&format!("{place}/"));
        let crates: Vec<&String> = members.keys().filter(inside).collect();
        let found: BTreeSet<String> = crates.iter().flat_map(|directory| dependencies(directory, &known)).collect();
        assert_eq!(*told, found, "what {place} uses, in the map and in its manifest");
        for used in &found {
            assert!(above.contains(used.as_str()), "{place} uses {used}, which stands below it: imports run one way");
        }
        above.extend(crates.iter().map(|directory| members[*directory].as_str()));
    }
    let untold: Vec<&&str> = known.iter().filter(|name| !above.contains(**name)).collect();
    assert!(untold.is_empty(), "the map has no row for {untold:?}");
}

/// Circles make files that cannot be read, tested or moved alone. How imports are read is said in `imports`.
#[test]
fn files_that_import_one_another_are_few_and_in_one_folder() {
    let home = root();
    let mut wrong = Vec::new();
    let roots = members().into_keys().flat_map(|directory| {
        let sources = home.join(directory).join("src");
        ["lib.rs", "main.rs"].map(|name| sources.join(name))
    });
    for file in roots.filter(|file| file.exists()) {
        let imports = imports::read_imports(&file);
        assert!(!imports.is_empty(), "{} was read", file.display());
        for circle in imports::find_circles(&imports) {
            if circle.len() <= LARGEST_CIRCLE && imports::is_in_one_folder(&circle) {
                continue;
            }
            let name = |file: &PathBuf| {
                let inside = file.strip_prefix(&home).expect("a file of ours");
                inside.display().to_string()
            };
            let names: Vec<String> = circle.iter().map(name).collect();
            let shortest = imports::shortest_cycle(&circle, &imports);
            let shortest: Vec<String> = shortest.iter().map(name).collect();
            wrong.push(format!(
                "{} files: {}; the shortest circle is {}",
                names.len(),
                names.join(", "),
                shortest.join(" -> ")
            ));
        }
    }
    assert!(
        wrong.is_empty(),
        "more than {LARGEST_CIRCLE} files import one another, or files of several folders do; move what both need to a \
            file below them:\n{}",
        wrong.join("\n")
    );
}

/// Returns whether a cell names unit tests, such as "`one`, `two` (crate `of_these`)", and checks that all of them
/// exist.
fn is_tested(cell: &str) -> bool {
    let crates = members();
    let mut parts = cell.split("(crate `");
    let mut before = parts.next().unwrap_or_default();
    let mut found = false;
    for part in parts {
        let (name, after) = part.split_once("`)").expect(cell);
        let directory = crates.iter().find(|(_, of_it)| *of_it == name);
        let (directory, _) = directory.expect(cell);
        let mut files = Vec::new();
        sources(&root().join(directory), &mut files);
        let text = files.iter().map(|file| std::fs::read_to_string(file).expect("text"));
        let text: String = text.collect();
        for test in before.split('`').skip(1).step_by(2) {
            let is_there = test.contains("::") || text.contains(&format!("fn {test}("));
            assert!(is_there, "the crate {name} has no test {test}");
            found = true;
        }
        before = after;
    }
    found
}

#[test]
fn the_stories_that_security_rests_on_exist() {
    let document = std::fs::read_to_string(root().join("docs/security.md")).expect("it is there");
    let (tables, _) = document.split_once("\n## ").expect("the table's end");
    let (counts, table) = tables.split_once("\n| position |").expect("the table");
    let registered = std::fs::read_to_string(root().join("tests/main.rs")).expect("it is there");
    let mut named = 0;
    for row in table.lines().filter(|line| line.starts_with("| ")) {
        let cells: Vec<&str> = row.trim_matches('|').split(" | ").collect();
        assert_eq!(cells.len(), 4, "{row}");
        let stories: Vec<&str> = cells[3].split('`').filter(|text| text.contains("::")).collect();
        // A limit that one crate enforces is covered by a test of that crate.
        let tested = is_tested(cells[3]);
        assert!(!stories.is_empty() || tested, "nothing shows: {row}");
        for story in stories {
            let (module, name) = story.split_once("::").expect("a module");
            let of_module = registered.split_once(&format!("stories![{module}:"));
            let (of_module, _) = of_module.and_then(|(_, rest)| rest.split_once("],")).expect(story);
            let is_there = of_module.lines().any(|line| line.trim().trim_end_matches(',') == name);
            assert!(is_there, "tests/main.rs has no {story}");
            named += 1;
        }
    }
    assert!(named > 15, "{named} were found");
    // Each story asserts the number of attempts that the document states.
    let directory = root().join("tests/stories/breakin");
    let stories: Vec<String> = std::fs::read_dir(directory)
        .expect("it is there")
        .map(|entry| std::fs::read_to_string(entry.expect("a file").path()).expect("text"))
        .collect();
    let rows = counts.lines().filter_map(|row| {
        let (name, rest) = row.strip_prefix("| `breakin::")?.split_once('`')?;
        Some((name, rest.trim_end_matches(" |").rsplit(' ').next()?))
    });
    let mut counted = 0;
    for (name, least) in rows {
        let holds = stories
            .iter()
            .any(|story| story.contains(&format!("pub fn {name}()")) && story.contains(&format!("> {least}, ")));
        assert!(holds, "{name} does not hold itself to {least} attempts");
        counted += 1;
    }
    assert_eq!(counted, 5, "{counts}");
}

#[test]
fn every_module_of_stories_and_every_crate_has_a_subject() {
    let directory = root().join("tests/stories");
    let files = std::fs::read_dir(directory).expect("it is there");
    let modules: BTreeSet<String> = files
        .map(|entry| entry.expect("a file").path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "rs"))
        .map(|path| path.file_stem().expect("a name").display().to_string())
        .collect();
    let told: Vec<&str> = subjects::SUBJECTS.iter().map(|row| row.0).collect();
    assert!(told.is_sorted_by(|one, other| one < other), "rows stand in the order of their names, each once: {told:?}");
    for module in &modules {
        assert!(
            told.contains(&module.as_str()),
            "tests/subjects.rs has no row for the stories of {module}: name the crates that they are about"
        );
    }
    let members = members();
    let mut named = BTreeSet::new();
    for (module, crates) in subjects::SUBJECTS {
        assert!(
            modules.contains(*module),
            "tests/subjects.rs has a row for {module}, and there is no tests/stories/{module}.rs"
        );
        assert!(!crates.is_empty(), "the row of {module} names no crate");
        for name in *crates {
            assert!(
                members.values().any(|member| member == name),
                "the row of {module} names {name}, which is no crate of the workspace"
            );
            named.insert(*name);
        }
    }
    for (directory, name) in &members {
        let ships = directory.starts_with("src/") || directory == "rootfs_builder";
        assert!(
            !ships || named.contains(name.as_str()),
            "no row of tests/subjects.rs names {name}: no story would be told for a change in it"
        );
    }
}

/// A struct or enum declaration in a file.
struct TypeDefinition {
    file: PathBuf,
    name: String,
    attributes: String,
    /// Identifiers in its body, without comments.
    words: BTreeSet<String>,
}

/// Returns the identifiers in a line: the last segment of each path, unless the path is of another crate.
fn words(line: &str) -> Vec<String> {
    let is_of_path = |character: char| character.is_alphanumeric() || "_:".contains(character);
    let paths = line.split(|character| !is_of_path(character));
    let own = paths.filter_map(|path| match path.trim_matches(':').split_once("::") {
        None => Some(path.trim_matches(':')),
        Some(("crate" | "self" | "super", rest)) => rest.rsplit("::").next(),
        Some(_) => None,
    });
    own.filter(|word| !word.is_empty()).map(str::to_owned).collect()
}

/// Returns the types declared in a file, found by the layout of rustfmt.
fn types(file: &Path) -> Vec<TypeDefinition> {
    let text = std::fs::read_to_string(file).expect("text");
    let lines: Vec<&str> = text.lines().collect();
    let mut types = Vec::new();
    for (at, line) in lines.iter().enumerate() {
        let declared = line.trim_start();
        let indent = line.len() - declared.len();
        let mut head = words(declared).into_iter();
        let is_type = |word: &String| word == "struct" || word == "enum";
        let keyword = head.by_ref().find(|word| !matches!(word.as_str(), "pub" | "crate" | "super"));
        let (true, Some(name)) = (keyword.as_ref().is_some_and(is_type), head.next()) else {
            continue;
        };
        let above = lines[..at].iter().rev().take_while(|line| {
            let line = line.trim();
            !(line.is_empty() || line.ends_with(';') || line == "}")
        });
        let is_code = |line: &&&str| !line.trim_start().starts_with("//");
        let ends = |line: &&str| line.len() - line.trim_start().len() == indent && line.trim() == "}";
        let body = lines[at + 1..].iter().take_while(|line| !ends(line));
        // A type on one line has no body.
        let body = body.take(if line.ends_with('{') { usize::MAX } else { 0 });
        types.push(TypeDefinition {
            file: file.to_owned(),
            name,
            attributes: above.filter(is_code).copied().collect(),
            words: head.chain(body.filter(is_code).flat_map(|line| words(line))).collect(),
        });
    }
    types
}

/// Collects the Rust files below a directory.
fn sources(directory: &Path, into: &mut Vec<PathBuf>) {
    let Ok(entries) = std::fs::read_dir(directory) else {
        return;
    };
    for entry in entries {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            sources(&path, into);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            into.push(path);
        }
    }
}

/// Events are filtered by kinds that `api` lists: one that it lacks could not be asked for by name.
#[test]
fn every_recorded_kind_of_event_is_listed() {
    let mut files = Vec::new();
    for directory in members().keys() {
        sources(&root().join(directory).join("src"), &mut files);
    }
    let mut recorded = BTreeSet::new();
    for file in files {
        let text = std::fs::read_to_string(&file).expect("readable");
        for call in ["journal.info(", "journal.warning(", "journal.error("] {
            let after = text.split(call).skip(1).filter_map(|after| after.trim_start().strip_prefix('"'));
            recorded.extend(after.filter_map(|kind| Some(kind.split_once('"')?.0.to_owned())));
        }
    }
    assert!(recorded.len() > 20, "{recorded:?}");
    for kind in recorded {
        assert!(api::EVENT_KINDS.contains(&kind.as_str()), "api::EVENT_KINDS and docs/operators.md lack {kind}");
    }
}

/// A parser of XML takes cubic time for nested namespaces, which `package::xml` refuses before.
#[test]
fn xml_is_parsed_in_one_place() {
    let mut files = Vec::new();
    for directory in members().keys() {
        sources(&root().join(directory).join("src"), &mut files);
    }
    let parses = |file: &&PathBuf| {
        let text = std::fs::read_to_string(file).expect("readable");
        text.contains("roxmltree") && text.contains("Document::parse(")
    };
    let found: Vec<&PathBuf> = files.iter().filter(parses).collect();
    assert_eq!(found, [&root().join("src/package/src/xml.rs")], "use package::xml::parse instead");
}

/// The code that serde derives for an untagged enum keeps a copy of its input: a recursive one keeps a copy for each
/// level, so that a short nested text takes all memory. Such a type must be read by a visitor, as
/// `ros::bus::ParamValue` is.
#[test]
fn no_untagged_enum_is_read_that_holds_itself() {
    let mut untagged = 0;
    for directory in members().keys() {
        let mut files = Vec::new();
        for part in ["src", "tests", "fuzz_targets", "examples"] {
            sources(&root().join(directory).join(part), &mut files);
        }
        let types: Vec<TypeDefinition> = files.iter().flat_map(|file| types(file)).collect();
        let mut holds: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
        for one in &types {
            let words = one.words.iter().map(String::as_str);
            holds.entry(&one.name).or_default().extend(words);
        }
        let is_read_untagged =
            |one: &&TypeDefinition| one.attributes.contains("untagged") && one.attributes.contains("Deserialize");
        for one in types.iter().filter(is_read_untagged) {
            untagged += 1;
            let mut reached = BTreeSet::new();
            let mut next: Vec<&str> = one.words.iter().map(String::as_str).collect();
            while let Some(name) = next.pop() {
                if reached.insert(name) {
                    next.extend(holds.get(name).into_iter().flatten());
                }
            }
            assert!(
                !reached.contains(one.name.as_str()) && !one.words.contains("Self"),
                "{} in {} is untagged, read, and holds itself",
                one.name,
                one.file.display()
            );
        }
    }
    assert!(untagged > 5, "{untagged} untagged enums were found");
}
