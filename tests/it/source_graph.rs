//! Which source file uses which, in all crates of the workspace. The whole file counts, unit tests included, and a name is
//! followed through re-exports to the file that defines it.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

/// A file's crate and its module path there: `["foreframe_core", "frame", "codec"]`.
pub(crate) type Module = Vec<String>;

/// A source file.
#[derive(Clone)]
pub(crate) struct SourceFile {
    /// From the root of the repository.
    pub(crate) path: String,
    pub(crate) text: String,
}

/// The source files of all crates, by their modules. The `main.rs` of the program is left out: it only starts the library.
pub(crate) fn source_files() -> BTreeMap<Module, SourceFile> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = BTreeMap::new();
    let mut folders = vec![(vec!["foreframe".to_owned()], root.join("src"))];
    for entry in fs::read_dir(root.join("crates")).unwrap() {
        let path = entry.unwrap().path();
        let name = format!("foreframe_{}", path.file_name().unwrap().to_str().unwrap());
        folders.push((vec![name], path.join("src")));
    }
    while let Some((module, folder)) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_str().unwrap();
            let child = |name: &str| [&module[..], &[name.to_owned()]].concat();
            match name.strip_suffix(".rs") {
                None if path.is_dir() => folders.push((child(name), path)),
                None | Some("main") => {}
                Some(stem) => {
                    let at = if stem == "lib" { module.clone() } else { child(stem) };
                    let text = fs::read_to_string(&path).unwrap();
                    let path = path.strip_prefix(root).unwrap().to_str().unwrap().replace('\\', "/");
                    files.insert(at, SourceFile { path, text });
                }
            }
        }
    }
    assert!(files.len() > 250, "only {} source files were found", files.len());
    files
}

/// The lines of a formatted file without the items that are there only for its unit tests.
pub(crate) fn without_tests(text: &str) -> Vec<&str> {
    let indent = |line: &str| line.len() - line.trim_start().len();
    let (mut lines, mut kept) = (text.lines(), Vec::new());
    while let Some(line) = lines.next() {
        if line.trim() != "#[cfg(test)]" {
            kept.push(line);
            continue;
        }
        // The item ends with the first line that is indented as its attribute and closes it.
        let code = |inner: &str| inner.split(" // ").next().unwrap_or_default().trim_end().to_owned();
        let closes = |inner: &&str| indent(inner) == indent(line) && code(inner).ends_with(['}', ';', ',']);
        assert!(lines.find(closes).is_some(), "an item for tests has no end");
    }
    kept
}

/// What a file names.
#[derive(Default)]
struct Names {
    /// The paths that it uses, from the crate on.
    used: Vec<Module>,
    /// What its `use` declarations bring into scope, by the name there.
    brought: BTreeMap<String, Module>,
}

/// Identifiers and single other characters of the code, without comments, strings and characters.
pub(crate) fn tokens(text: &str) -> Vec<&str> {
    let bytes = text.as_bytes();
    let (mut found, mut at) = (Vec::new(), 0);
    while at < bytes.len() {
        let rest = &text[at..];
        let length = match bytes[at] {
            b'/' if rest.starts_with("//") => rest.find('\n').unwrap_or(rest.len()),
            b'"' => string_length(rest),
            b'r' if rest.starts_with("r\"") => 2 + rest[2..].find('"').unwrap() + 1,
            b'r' if rest.starts_with("r#\"") => 3 + rest[3..].find("\"#").unwrap() + 2,
            b'\'' if rest.starts_with("'\\") => 3 + rest[3..].find('\'').unwrap() + 1,
            b'\'' if rest.chars().nth(2) == Some('\'') => 2 + rest.chars().nth(1).unwrap().len_utf8(),
            byte if byte.is_ascii_alphanumeric() || byte == b'_' => {
                let is_part = |c: char| c.is_ascii_alphanumeric() || c == '_';
                let length = rest.find(|c| !is_part(c)).unwrap_or(rest.len());
                found.push(&rest[..length]);
                length
            }
            byte if byte.is_ascii_whitespace() => 1,
            _ => {
                let length = rest.chars().next().unwrap().len_utf8();
                found.push(&rest[..length]);
                length
            }
        };
        at += length;
    }
    found
}

/// Whether the token goes on a path: two colons stand before it, and the end of a name before them. `use ::zip` begins one.
pub(crate) fn goes_on_a_path(tokens: &[&str], at: usize) -> bool {
    let ends_name = |token: &str| token == ">" || (token != "use" && is_name(token));
    at > 2 && tokens[at - 2..at] == [":", ":"] && ends_name(tokens[at - 3])
}

/// The bytes of the string literal that begins here.
fn string_length(text: &str) -> usize {
    let mut is_escaped = false;
    for (at, c) in text.char_indices().skip(1) {
        match c {
            '"' if !is_escaped => return at + 1,
            _ => is_escaped = c == '\\' && !is_escaped,
        }
    }
    text.len()
}

/// The paths of a `use` declaration's tree with the name that each brings, and the number of tokens.
fn use_tree(tokens: &[&str]) -> (Vec<(Module, String)>, usize) {
    let (mut path, mut found, mut at) = (Module::new(), Vec::new(), 0);
    loop {
        match tokens[at] {
            "{" => {
                at += 1;
                while tokens[at] != "}" {
                    let (inner, length) = use_tree(&tokens[at..]);
                    found.extend(inner.into_iter().map(|(rest, name)| {
                        let rest = if rest == ["self"] { Module::new() } else { rest };
                        ([&path[..], &rest[..]].concat(), name)
                    }));
                    at += length;
                    at += usize::from(tokens[at] == ",");
                }
                return (found, at + 1);
            }
            ":" => at += 1,
            "as" => {
                found.push((path, tokens[at + 1].to_owned()));
                return (found, at + 2);
            }
            ";" | "," | "}" => {
                let name = path.last().cloned().unwrap_or_default();
                found.push((path, name));
                return (found, at);
            }
            name => {
                path.push(name.to_owned());
                at += 1;
            }
        }
    }
}

/// A path from the crate on, if it begins in this workspace. `at` is the module where it stands.
fn absolute(path: &[String], at: &[String], files: &BTreeMap<Module, SourceFile>) -> Option<Module> {
    let (first, rest) = path.split_first()?;
    match first.as_str() {
        "crate" => Some([&at[..1], rest].concat()),
        "self" => Some([at, rest].concat()),
        "super" => {
            let levels = path.iter().take_while(|name| *name == "super").count();
            Some([&at[..at.len() - levels], &path[levels..]].concat())
        }
        name if files.contains_key(&path[..1]) && name.starts_with("foreframe") => Some(path.to_vec()),
        _ => {
            let inside = [at, path].concat();
            files.contains_key(&inside[..=at.len()]).then_some(inside)
        }
    }
}

fn names(module: &Module, text: &str, files: &BTreeMap<Module, SourceFile>) -> Names {
    let tokens = tokens(text);
    // The modules written out in this file that are open, each with the depth of its braces.
    let (mut open, mut depth): (Vec<(usize, String)>, usize) = (Vec::new(), 0);
    let (mut names, mut at) = (Names::default(), 0);
    while at < tokens.len() {
        let here = || -> Module {
            [
                &module[..],
                &open.iter().map(|(_, name)| name.clone()).collect::<Vec<_>>(),
            ]
            .concat()
        };
        match tokens[at] {
            "{" => depth += 1,
            "}" => {
                depth -= 1;
                open.retain(|(opened, _)| *opened < depth + 1);
            }
            "mod" if tokens.get(at + 2) == Some(&"{") => open.push((depth + 1, tokens[at + 1].to_owned())),
            // Not what an opaque type captures: `use<'a>`.
            "use" if tokens[at + 1] != "<" => {
                let (paths, length) = use_tree(&tokens[at + 1..]);
                for (path, name) in paths {
                    let Some(path) = absolute(&path, &here(), files) else {
                        continue;
                    };
                    names.used.push(path.clone());
                    if open.is_empty() {
                        names.brought.insert(name, path);
                    }
                }
                at += length;
            }
            first if tokens.get(at + 1..at + 3) == Some(&[":", ":"]) && !goes_on_a_path(&tokens, at) => {
                let mut path = vec![first.to_owned()];
                while tokens.get(at + 1..at + 3) == Some(&[":", ":"])
                    && tokens.get(at + 3).is_some_and(|name| is_name(name))
                {
                    at += 3;
                    path.push(tokens[at].to_owned());
                }
                names.used.extend(absolute(&path, &here(), files));
            }
            _ => {}
        }
        at += 1;
    }
    names
}

fn is_name(token: &str) -> bool {
    token.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
}

/// The file that defines what this path names.
fn definition(
    path: &[String],
    files: &BTreeMap<Module, SourceFile>,
    brought: &BTreeMap<Module, Names>,
) -> Option<Module> {
    let mut path = path.to_vec();
    // No re-export goes through more files than this.
    for _ in 0..20 {
        let length = (1..=path.len())
            .take_while(|length| files.contains_key(&path[..*length]))
            .last()?;
        let (file, rest) = path.split_at(length);
        let next = rest.first().and_then(|name| brought[file].brought.get(name));
        match next {
            Some(target) if *target != path => path = [&target[..], &rest[1..]].concat(),
            _ => return Some(file.to_vec()),
        }
    }
    None
}

/// Every use of a file by a file of the same crate that is neither its parent nor inside it.
pub(crate) fn uses(files: &BTreeMap<Module, SourceFile>) -> BTreeSet<(Module, Module)> {
    let named: BTreeMap<Module, Names> = files
        .iter()
        .map(|(module, file)| (module.clone(), names(module, &file.text, files)))
        .collect();
    let mut uses = BTreeSet::new();
    for (module, names) in &named {
        for used in names.used.iter().filter_map(|path| definition(path, files, &named)) {
            let is_same_branch = used.starts_with(module) || module.starts_with(&used);
            if used[0] == module[0] && !is_same_branch {
                uses.insert((module.clone(), used));
            }
        }
    }
    uses
}

/// The uses that lie in a circle. In each folder, its files and folders are compared: a file counts with the folder of its
/// name. So a circle of files is found where the files' paths part.
pub(crate) fn circles(uses: &BTreeSet<(Module, Module)>) -> Vec<String> {
    let mut folders: BTreeMap<&[String], Vec<(&Module, &Module)>> = BTreeMap::new();
    for (user, used) in uses {
        let common = user.iter().zip(used).take_while(|(a, b)| a == b).count();
        folders.entry(&user[..common]).or_default().push((user, used));
    }
    let mut found = Vec::new();
    for (folder, uses) in folders {
        let level = folder.len();
        let edges: BTreeSet<(&str, &str)> = uses.iter().map(|(user, used)| (&*user[level], &*used[level])).collect();
        let in_circle = uses
            .iter()
            .filter(|(user, used)| reaches(&edges, &used[level], &user[level]));
        found.extend(in_circle.map(|(user, used)| format!("{} uses {}", user.join("/"), used.join("/"))));
    }
    found
}

/// Whether the edges lead from `start` to `goal`.
fn reaches<'a>(edges: &BTreeSet<(&'a str, &'a str)>, start: &'a str, goal: &str) -> bool {
    let (mut seen, mut open) = (BTreeSet::from([start]), vec![start]);
    while let Some(at) = open.pop() {
        let next = edges.iter().filter(|(from, _)| *from == at).map(|(_, to)| *to);
        open.extend(next.filter(|to| seen.insert(to)));
    }
    seen.contains(goal)
}
