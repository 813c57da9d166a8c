//! The commands that a command prints for the next step work as they are printed.

use std::path::Path;

use crate::readme::{checkout, run};
use crate::recordings;

/// Makes trainings and evaluations short.
const SHORTER: [(&str, &str); 2] = [
    (
        "foreframe train ",
        " --set sequence.steps=2 --set data.validation_windows=4",
    ),
    ("foreframe evaluate ", " --windows 5 --resamples 100"),
];

/// The commands in what a command printed.
fn next_commands(printed: &str) -> Vec<String> {
    let lines = printed.lines().filter_map(|line| line.split_once("foreframe "));
    let starts = ["next: ", "to import it again: ", "      "];
    lines
        .filter(|(start, _)| starts.contains(start))
        .map(|(_, command)| format!("foreframe {command}"))
        .collect()
}

/// Runs a command, then those that it suggests, and so on; returns all of them.
fn run_with_next(dir: &Path, command: &str) -> Vec<String> {
    let (mut waiting, mut done) = (vec![command.to_owned()], Vec::new());
    while let Some(command) = waiting.pop() {
        let shorter = SHORTER.iter().find(|(start, _)| command.starts_with(start));
        let printed = run(dir, &format!("{command}{}", shorter.map_or("", |(_, more)| more)));
        waiting.extend(next_commands(&printed));
        done.push(command);
    }
    done
}

#[test]
fn what_follows_an_import_works_as_printed() {
    let dir = checkout();
    recordings::images_with_csv(&dir.path().join("my drive/Bag_sql"), 500);
    let import = "foreframe import 'my drive/Bag_sql' --data-dir 'robot data'";
    let done = run_with_next(dir.path(), import);
    let verbs: Vec<&str> = done.iter().filter_map(|command| command.split(' ').nth(1)).collect();
    assert_eq!(verbs, ["import", "train", "publish", "evaluate", "inspect"], "{done:?}");
    assert!(done[1].contains(" --set name=bag-sql "), "{}", done[1]);
    assert!(
        dir.path().join("robot data/models/bag-sql/1").is_dir(),
        "publish uses the same data directory"
    );
}

#[test]
fn an_exported_bag_is_imported_as_printed() {
    let dir = checkout();
    recordings::tub(&dir.path().join("tub"), 100);
    let import = run(dir.path(), "foreframe import tub --name mycar");
    // The file has the name of the data set that is there.
    let export = run(
        dir.path(),
        "foreframe export --dataset mycar --to mcap --out mycar.mcap",
    );
    let again = next_commands(&export);
    assert_eq!(again.len(), 1, "{export}");
    let counts = |printed: &str| {
        printed
            .split(": ")
            .nth(1)
            .unwrap()
            .split(" of")
            .next()
            .unwrap()
            .to_owned()
    };
    let imported = run(dir.path(), &again[0]);
    assert!(imported.starts_with("data/datasets/mycar-2: "), "{imported}");
    assert_eq!(counts(&imported), counts(&import));
}

#[test]
fn too_short_a_recording_is_said_to_be_too_short() {
    let dir = checkout();
    recordings::tub(&dir.path().join("tub"), 50);
    let printed = run(dir.path(), "foreframe import tub");
    assert!(
        printed.contains("      record more before you train: 50 frames in one episode are"),
        "{printed}"
    );
}

#[test]
fn what_follows_a_collection_in_varied_rooms_works_as_printed() {
    let dir = checkout();
    let printed = run(
        dir.path(),
        "foreframe collect --scenario moving-observer --rooms new-materials --trials 3 --name rooms-for-tests",
    );
    let next = next_commands(&printed);
    assert_eq!(next.len(), 1, "{printed}");
    run(
        dir.path(),
        &format!(
            "{} ",
            next[0].replace("--dataset", "--windows 5 --resamples 100 --dataset")
        ),
    );
}
