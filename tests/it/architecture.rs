//! The module order: a module uses only earlier modules, and some dependencies are used only in certain modules.

use std::fs;
use std::path::{Path, PathBuf};

/// The modules that each module may use.
const MAY_USE: &[(&str, &[&str])] = &[
    ("types", &[]),
    ("vectorized", &[]),
    ("files", &[]),
    ("settings", &[]),
    ("error_text", &[]),
    ("telemetry", &[]),
    ("frame", &["types", "vectorized"]),
    ("nn", &["types", "vectorized", "frame"]),
    ("sim", &["types", "frame"]),
    ("dataset", &["types", "files", "error_text", "frame", "sim"]),
    ("inspection", &["types", "frame", "dataset"]),
    ("registry", &["types", "files", "error_text", "frame", "nn"]),
    (
        "training",
        &[
            "types",
            "vectorized",
            "files",
            "settings",
            "error_text",
            "frame",
            "nn",
            "dataset",
            "registry",
        ],
    ),
    (
        "evaluation",
        &[
            "types",
            "files",
            "error_text",
            "frame",
            "nn",
            "sim",
            "dataset",
            "registry",
        ],
    ),
    ("serving", &["types", "telemetry", "frame", "nn", "registry"]),
    ("store", &["types", "files"]),
    (
        "versions",
        &[
            "types",
            "files",
            "error_text",
            "telemetry",
            "registry",
            "serving",
            "store",
        ],
    ),
    (
        "jobs",
        &[
            "types",
            "files",
            "error_text",
            "telemetry",
            "frame",
            "nn",
            "sim",
            "dataset",
            "registry",
            "training",
            "evaluation",
            "serving",
            "store",
            "versions",
        ],
    ),
    (
        "server",
        &[
            "types",
            "error_text",
            "telemetry",
            "frame",
            "nn",
            "sim",
            "dataset",
            "registry",
            "training",
            "evaluation",
            "serving",
            "store",
            "versions",
            "jobs",
        ],
    ),
    ("config", &["settings", "telemetry", "server"]),
];

/// The modules in which a dependency may be used.
const USED_IN: &[(&str, &[&str])] = &[
    ("candle_core", &["nn", "registry", "training", "evaluation", "serving"]),
    ("pulp", &["vectorized"]),
    ("axum", &["server"]),
    ("hyper", &["server"]),
    ("figment", &["settings"]),
    ("metrics_exporter_prometheus", &["telemetry"]),
    ("image::", &["frame"]),
    ("tokio", &["server", "jobs", "versions", "store", "serving", "cli"]),
    ("sqlx", &["store"]),
    ("rusqlite", &["dataset"]),
    ("flate2::", &["dataset"]),
    ("zip::", &["dataset"]),
    ("object_store", &["store"]),
    ("rapier3d", &["sim"]),
    ("parquet", &["dataset"]),
    ("rustix", &["dataset", "jobs"]),
];

fn sources() -> Vec<(String, String)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut folders = vec![root.clone()];
    let mut files = Vec::new();
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(folder).unwrap() {
            let path: PathBuf = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let name = path.strip_prefix(&root).unwrap().to_string_lossy().replace('\\', "/");
                files.push((name, fs::read_to_string(&path).unwrap()));
            }
        }
    }
    assert!(files.len() > 50, "only {} source files were found", files.len());
    files
}

fn module(file: &str) -> &str {
    file.split('/').next().unwrap().trim_end_matches(".rs")
}

/// The lines of code before the unit tests, without comments.
fn code(text: &str) -> impl Iterator<Item = &str> {
    text.lines()
        .take_while(|line| line.trim() != "#[cfg(test)]")
        .filter(|line| !line.trim_start().starts_with("//"))
}

#[test]
fn modules_use_only_earlier_modules() {
    for (file, text) in sources() {
        let Some((_, allowed)) = MAY_USE.iter().find(|(name, _)| *name == module(&file)) else {
            continue;
        };
        for line in code(&text) {
            for used in line.split("crate::").skip(1) {
                let used: String = used.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                let is_own = used == module(&file) || used.is_empty();
                assert!(is_own || allowed.contains(&used.as_str()), "{file} uses crate::{used}");
            }
        }
    }
}

#[test]
fn dependencies_are_used_only_in_their_modules() {
    for (file, text) in sources() {
        for (name, modules) in USED_IN.iter().filter(|(_, modules)| !modules.contains(&module(&file))) {
            let uses = |line: &str| line.trim_start().starts_with(&format!("use {name}"));
            assert!(
                !code(&text).any(uses),
                "{file} uses {name}, which is for {modules:?} only"
            );
        }
    }
}

#[test]
fn no_file_is_longer_than_460_lines() {
    for (file, text) in sources() {
        assert!(text.lines().count() <= 460, "{file} has {} lines", text.lines().count());
    }
}

#[test]
fn no_two_types_have_the_same_name() {
    let mut known = std::collections::BTreeMap::new();
    for (file, text) in sources() {
        for line in code(&text) {
            let words: Vec<&str> = line
                .split(|c: char| !c.is_alphanumeric() && c != '_')
                .filter(|word| !word.is_empty() && !["pub", "crate", "super"].contains(word))
                .collect();
            let &[kind, name, ..] = words.as_slice() else { continue };
            // A macro's `$name` begins with a small letter.
            if ["struct", "enum", "trait"].contains(&kind) && name.starts_with(char::is_uppercase) {
                let first = known.insert(name.to_owned(), file.clone());
                assert!(first.is_none(), "{name} is in {file} and in {}", first.unwrap());
            }
        }
    }
}

#[test]
fn every_expect_says_that_its_failure_is_a_bug() {
    for (file, text) in sources() {
        let code: String = code(&text).collect();
        for call in code.split(".expect(").skip(1) {
            let message = call.split('"').nth(1).unwrap_or_default();
            assert!(message.ends_with("is a bug"), "{file} expects {message:?}");
        }
    }
}

/// The rooms of the server in their order. A file uses only files of its own room and of rooms before it.
const SERVER_ROOMS: &[&str] = &[
    "token",
    "config",
    "http",
    "blocking",
    "pictures",
    "images",
    "stream",
    "environments",
    "state",
    "routes",
    "openapi",
    "router",
    "admin",
    "serve",
];

/// The module path of a file below `src/server`: `["http", "keys"]` of `server/http/keys.rs`.
fn server_module(file: &str) -> Option<Vec<String>> {
    let path = file.strip_prefix("server/")?.strip_suffix(".rs")?;
    Some(path.split('/').map(str::to_owned).collect())
}

/// The leading names of a path, up to what is no lower-case name.
fn names_of(path: &str) -> (Vec<String>, &str) {
    let (mut names, mut rest) = (Vec::new(), path);
    loop {
        let length = rest.find(|c: char| !(c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_'));
        let (name, after) = rest.split_at(length.unwrap_or(rest.len()));
        let ends_inside_a_type = after.starts_with(|c: char| c.is_ascii_alphanumeric());
        if name.is_empty() || ends_inside_a_type {
            return (names, rest);
        }
        names.push(name.to_owned());
        match after.strip_prefix("::") {
            Some(more) => rest = more,
            None => return (names, after),
        }
    }
}

/// Every path that begins here, with those in braces spread out.
fn paths(text: &str) -> Vec<Vec<String>> {
    let (names, rest) = names_of(text);
    let Some(inner) = rest.strip_prefix('{') else {
        return vec![names];
    };
    let (mut depth, mut start, mut found) = (0, 0, Vec::new());
    for (at, letter) in inner.char_indices() {
        match letter {
            '{' => depth += 1,
            ',' | '}' if depth == 0 => {
                let part = inner[start..at].trim();
                found.extend(paths(part).into_iter().map(|path| [&names[..], &path[..]].concat()));
                start = at + 1;
                if letter == '}' {
                    break;
                }
            }
            '}' => depth -= 1,
            _ => {}
        }
    }
    found
}

/// The module paths below `src/server` that a file's code names, by `crate::server::` or by `super::`.
fn server_paths(of: &[String], text: &str) -> Vec<Vec<String>> {
    let code: String = code(text).collect::<Vec<_>>().join("\n");
    let mut found = Vec::new();
    for (at, _) in code.match_indices("crate::server::") {
        found.extend(paths(&code[at + "crate::server::".len()..]));
    }
    for (at, _) in code.match_indices("super::") {
        let is_first = !code[..at].ends_with("super::") && !code[..at].ends_with("in ");
        if !is_first {
            continue;
        }
        let (mut rest, mut level) = (&code[at..], of.len());
        while let Some(more) = rest.strip_prefix("super::") {
            (rest, level) = (more, level - 1);
        }
        found.extend(paths(rest).into_iter().map(|path| [&of[..level], &path[..]].concat()));
    }
    found
}

/// The longest file that the path goes through.
fn file_of(path: &[String], files: &[Vec<String>]) -> Option<Vec<String>> {
    let prefixes = (1..=path.len()).rev().map(|length| path[..length].to_vec());
    prefixes.into_iter().find(|prefix| files.contains(prefix))
}

/// What the files of the server use of each other; a file and its own parts count as one.
fn server_uses(sources: &[(String, String)]) -> Vec<(Vec<String>, Vec<String>)> {
    let modules: Vec<_> = sources
        .iter()
        .filter_map(|(file, text)| Some((server_module(file)?, text)))
        .collect();
    let files: Vec<Vec<String>> = modules.iter().map(|(module, _)| module.clone()).collect();
    let mut uses = Vec::new();
    for (module, text) in &modules {
        let used = server_paths(module, text)
            .into_iter()
            .filter_map(|path| file_of(&path, &files));
        let apart = used.filter(|used| !used.starts_with(module) && !module.starts_with(used));
        uses.extend(apart.map(|used| (module.clone(), used)));
    }
    uses
}

/// What is wrong with the uses: against the order of the rooms, or in a circle.
fn server_faults(sources: &[(String, String)]) -> Vec<String> {
    let uses = server_uses(sources);
    let room = |module: &[String]| SERVER_ROOMS.iter().position(|room| *room == module[0]);
    let mut faults = Vec::new();
    for (user, used) in &uses {
        match (room(user), room(used)) {
            (Some(user_room), Some(used_room)) if user_room >= used_room => {}
            _ => faults.push(format!("server/{} uses server/{}", user.join("/"), used.join("/"))),
        }
    }
    // A file that uses no other, or that no other uses, is in no circle: remove such files until nothing changes.
    let same = |one: &[String], other: &[String]| one.starts_with(other) || other.starts_with(one);
    let mut left = uses;
    loop {
        let before = left.clone();
        left.retain(|(user, used)| {
            before.iter().any(|(other, _)| same(other, used)) && before.iter().any(|(_, other)| same(other, user))
        });
        if left.len() == before.len() {
            break;
        }
    }
    faults.extend(
        left.iter()
            .map(|(user, used)| format!("a circle goes through {} and {}", user.join("/"), used.join("/"))),
    );
    faults
}

#[test]
fn the_rooms_of_the_server_follow_their_order_without_circles() {
    let sources = sources();
    let uses = server_uses(&sources);
    assert!(uses.len() > 80, "only {} uses were found", uses.len());
    assert_eq!(server_faults(&sources), Vec::<String>::new());
}

#[test]
fn a_use_against_the_order_or_in_a_circle_is_found() {
    let with = |file: &str, line: &str| {
        let mut sources = sources();
        let changed = sources.iter_mut().find(|(name, _)| name == file).unwrap();
        changed.1 = format!("{line}\n{}", changed.1);
        server_faults(&sources)
    };
    assert_eq!(
        with("server/http/extract.rs", "use crate::server::state::App;"),
        ["server/http/extract uses server/state"]
    );
    let upward = with(
        "server/blocking.rs",
        "use super::{config, routes::{jobs, models::list}};",
    );
    assert_eq!(
        upward[..2],
        [
            "server/blocking uses server/routes/jobs",
            "server/blocking uses server/routes/models"
        ]
    );
    let circle = with("server/http/problem.rs", "use super::keys::Keys;");
    assert!(
        circle.iter().any(|fault| fault.contains("http/problem and http/keys")),
        "{circle:?}"
    );
}
