//! The order of the source: crates are layers, which the compiler keeps apart; within a crate no files or folders use each
//! other in a circle; and some dependencies are used only in certain folders.

use crate::source_graph::{SourceFile, circles, goes_on_a_path, source_files, tokens, uses, without_tests};

/// The folders in which a dependency may be used. Without `::`, every crate whose name begins so.
const USED_IN: &[(&str, &[&str])] = &[
    (
        "candle_core",
        &[
            "crates/core/src/nn",
            "crates/core/src/registry",
            "crates/core/src/serving",
            "crates/train/src",
        ],
    ),
    (
        "pulp",
        &[
            "crates/core/src/vectorized",
            "crates/core/src/nn/ops/packed",
            "crates/core/src/nn/ops/winograd",
        ],
    ),
    ("axum", &["src/server"]),
    ("hyper", &["src/server"]),
    ("figment", &["crates/train/src/settings"]),
    ("metrics_exporter_prometheus", &["src/telemetry"]),
    ("image::", &["crates/core/src/frame"]),
    ("tokio", &["src", "crates/jobs/src", "crates/core/src/serving"]),
    ("sqlx", &["crates/jobs/src/store"]),
    ("rusqlite", &["crates/data/src/dataset"]),
    ("flate2::", &["crates/data/src/dataset"]),
    ("zip::", &["crates/data/src/dataset"]),
    ("object_store", &["crates/jobs/src/store"]),
    ("rapier3d", &["crates/sim/src"]),
    ("parquet", &["crates/data/src/dataset"]),
    ("rustix", &["crates/data/src/dataset", "crates/jobs/src/jobs"]),
];

/// The lines of code without what only unit tests use, and without comments.
fn code(text: &str) -> impl Iterator<Item = &str> {
    without_tests(text)
        .into_iter()
        .filter(|line| !line.trim_start().starts_with("//"))
}

/// Whether the code uses a crate of this name: alone in a `use`, or where a path begins, in an attribute or anywhere else.
fn names_crate(code: &[&str], name: &str) -> bool {
    let is_name = |token: &str| match name.strip_suffix("::") {
        Some(name) => token == name,
        None => token.starts_with(name),
    };
    let goes_on = |at: usize| code.get(at + 1..at + 3) == Some(&[":", ":"]);
    let is_whole = |at: usize| at > 0 && code[at - 1] == "use" && matches!(code.get(at + 1), Some(&(";" | "as")));
    (0..code.len()).any(|at| is_name(code[at]) && !goes_on_a_path(code, at) && (goes_on(at) || is_whole(at)))
}

/// The files of the library and the program; the load tests are tests.
fn files() -> Vec<SourceFile> {
    let is_shipped = |file: &SourceFile| !file.path.starts_with("crates/load");
    source_files().into_values().filter(is_shipped).collect()
}

#[test]
fn no_files_or_folders_use_each_other_in_a_circle() {
    let uses = uses(&source_files());
    assert!(uses.len() > 800, "only {} uses were found", uses.len());
    assert_eq!(circles(&uses), Vec::<String>::new());
}

/// The circles that a line at the end of a file brings.
fn circles_with(path: &str, line: &str) -> Vec<String> {
    let mut files = source_files();
    let changed = files.values_mut().find(|file| file.path == path).unwrap();
    changed.text = format!("{}\n{line}\n", changed.text);
    circles(&uses(&files))
}

#[test]
fn a_circle_is_found() {
    // Between files of a folder, between folders, after the unit tests, and through a re-export.
    let found = circles_with("src/server/http/problem.rs", "use super::keys::Keys;");
    assert!(
        found.contains(&"foreframe/server/http/problem uses foreframe/server/http/keys".to_owned()),
        "{found:?}"
    );
    let found = circles_with(
        "src/server/http/extract.rs",
        "use crate::server::{config, state::{self, App}};",
    );
    assert!(
        found.contains(&"foreframe/server/http/extract uses foreframe/server/state".to_owned()),
        "{found:?}"
    );
    let found = circles_with(
        "crates/core/src/types.rs",
        "#[cfg(test)] mod more { use crate::nn::Network; }",
    );
    assert!(
        found.contains(&"foreframe_core/types uses foreframe_core/nn/network".to_owned()),
        "{found:?}"
    );
}

#[test]
fn dependencies_are_used_only_in_their_folders() {
    for file in files() {
        let lines: Vec<&str> = code(&file.text).collect();
        let text = lines.join("\n");
        let code = tokens(&text);
        for (name, folders) in USED_IN {
            let is_inside = |folder: &&str| {
                file.path
                    .strip_prefix(*folder)
                    .is_some_and(|rest| rest.starts_with(['/', '.']))
            };
            assert!(
                folders.iter().any(is_inside) || !names_crate(&code, name),
                "{} uses {name}, which is for {folders:?} only",
                file.path
            );
        }
    }
}

#[test]
fn a_crate_is_found_wherever_a_path_names_it() {
    let names = |text: &str| names_crate(&tokens(text), "zip::");
    assert!(names("use zip::ZipArchive;") && names("fn open() -> zip::Result<()> {}") && names("#[zip::main]"));
    assert!(names("fn open(archive: zip::Archive) {}") && names("let x = ::zip::open();") && names("use ::zip::A;"));
    assert!(names("use zip as archives;") && names("use zip;"));
    assert!(!names("use crate::zip::Archive;") && !names("values.zip(others)") && !names("zips::x()"));
    assert!(names_crate(&tokens("tokio_util::io::copy()"), "tokio"));
}

#[test]
fn only_what_tests_use_is_left_out() {
    let text = "fn a() {}\n#[cfg(test)]\nmod x;\nimpl B {\n    #[cfg(test)]\n    fn c(\n        self,\n    ) {\n        d();\n    }\n    \
                fn e() {}\n}\n#[cfg(test)]\nmod tests {\n    fn f() {}\n}\nfn g() {}";
    let left: Vec<&str> = code(text).map(str::trim).collect();
    assert_eq!(left, ["fn a() {}", "impl B {", "fn e() {}", "}", "fn g() {}"]);
}

#[test]
fn no_file_is_longer_than_460_lines() {
    for SourceFile { path, text } in files() {
        assert!(text.lines().count() <= 460, "{path} has {} lines", text.lines().count());
    }
}

#[test]
fn no_two_types_have_the_same_name() {
    let mut known = std::collections::BTreeMap::new();
    for SourceFile { path, text } in files() {
        for line in code(&text) {
            let words: Vec<&str> = line
                .split(|c: char| !c.is_alphanumeric() && c != '_')
                .filter(|word| !word.is_empty() && !["pub", "crate", "super"].contains(word))
                .collect();
            let &[kind, name, ..] = words.as_slice() else { continue };
            // A macro's `$name` begins with a small letter.
            if ["struct", "enum", "trait"].contains(&kind) && name.starts_with(char::is_uppercase) {
                let first = known.insert(name.to_owned(), path.clone());
                assert!(first.is_none(), "{name} is in {path} and in {}", first.unwrap());
            }
        }
    }
}

#[test]
fn every_expect_says_that_its_failure_is_a_bug() {
    for SourceFile { path, text } in files() {
        let code: String = code(&text).collect();
        for call in code.split(".expect(").skip(1) {
            let message = call.split('"').nth(1).unwrap_or_default();
            assert!(message.ends_with("is a bug"), "{path} expects {message:?}");
        }
    }
}
