//! Which columns, features and arrays become actions and states.

use std::fs;
use std::path::{Path, PathBuf};

use foreframe_data::dataset::import::{ImportOptions, Imported};

use crate::import::{folder, run, small};
use crate::import_arrays::npz;
use crate::recordings::{lerobot_images, numpy_array, tub};

#[test]
fn columns_that_nobody_asked_for_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let csv = source.join("log.csv");
    let text = fs::read_to_string(&csv)
        .unwrap()
        .replace("action.", "")
        .replace("state.", "");
    fs::write(&csv, text).unwrap();
    let imported = run(&source, &dir.path().join("frames"), small()).unwrap();
    assert_eq!(imported.notes.len(), 1);
    let named = imported.notes[0].contains("not imported: speed") && imported.notes[0].contains("--action COLUMN");
    assert!(named, "{:?}", imported.notes);
    let options = ImportOptions {
        actions: vec!["speed".to_owned()],
        ..small()
    };
    let notes = run(&source, &dir.path().join("speed"), options).unwrap().notes;
    assert!(
        notes.len() == 1 && notes[0].contains("not imported: heading"),
        "{notes:?}"
    );
}

#[test]
fn columns_of_a_single_action_and_state_need_no_suffix() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let text = fs::read_to_string(source.join("log.csv")).unwrap();
    let text = text.replace("action.speed", "action").replace("state.heading", "state");
    fs::write(source.join("log.csv"), text).unwrap();
    // What macOS writes beside a file on a foreign disk.
    fs::write(source.join("._log.csv"), b"\0\x05\x16\x07").unwrap();
    let info = run(&source, &dir.path().join("out"), small()).unwrap().info;
    assert_eq!(info.action_channels[0].to_string(), "action m/s");
    assert_eq!(info.state_channels[0].to_string(), "state");
}

#[test]
fn csv_mistakes_name_column_and_line() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let options = ImportOptions {
        actions: vec!["turn".to_owned()],
        ..small()
    };
    let error = run(&source, &dir.path().join("a"), options).unwrap_err().to_string();
    assert!(
        error.contains("no column \"turn\"") && error.contains("action.speed"),
        "{error}"
    );
    let options = ImportOptions {
        units: vec!["turns=rad/s".to_owned()],
        ..small()
    };
    let error = run(&source, &dir.path().join("u"), options).unwrap_err().to_string();
    assert!(
        error.contains("--unit names the channel \"turns\", which is not imported; there are: "),
        "{error}"
    );
    let csv = source.join("log.csv");
    let text = fs::read_to_string(&csv).unwrap();
    fs::write(&csv, text.replacen(",0.3,", ",NaN,", 1)).unwrap();
    let error = run(&source, &dir.path().join("b"), small()).unwrap_err().to_string();
    assert!(
        error.contains("log.csv line 5") && error.contains("finite number"),
        "{error}"
    );
}

/// The folder with two more columns: `action` is a text in every line, `state` in all but one.
fn described(dir: &Path, first_state: &str) -> PathBuf {
    let source = folder(dir);
    let csv = source.join("log.csv");
    let text = fs::read_to_string(&csv).unwrap();
    let add = |(index, line): (usize, &str)| match index {
        0 => format!("{line},action,state\n"),
        1 => format!("{line},turn left,{first_state}\n"),
        _ => format!("{line},,driving\n"),
    };
    fs::write(&csv, text.lines().enumerate().map(add).collect::<String>()).unwrap();
    source
}

fn channels(imported: &Imported) -> [Vec<&str>; 2] {
    let info = &imported.info;
    [&info.action_channels, &info.state_channels]
        .map(|channels| channels.iter().map(|channel| channel.name.as_str()).collect())
}

#[test]
fn columns_of_texts_that_are_named_as_actions_are_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let source = described(dir.path(), "waiting");
    let imported = run(&source, &dir.path().join("out"), small()).unwrap();
    assert_eq!(channels(&imported), [["action.speed"], ["state.heading"]]);
    assert_eq!(
        imported.notes,
        [
            "the column \"action\" of log.csv holds no numbers (its first value is \"turn left\"), so it was not imported",
            "the column \"state\" of log.csv holds no numbers (its first value is \"waiting\"), so it was not imported"
        ]
    );
    assert_eq!(imported.info.frame_count, 12);
}

#[test]
fn a_column_of_texts_that_was_asked_for_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let source = described(dir.path(), "waiting");
    let options = ImportOptions {
        actions: vec!["action".to_owned()],
        ..small()
    };
    let error = run(&source, &dir.path().join("out"), options).unwrap_err().to_string();
    assert!(
        error.contains("log.csv line 2: the column \"action\" is \"turn left\""),
        "{error}"
    );
}

#[test]
fn a_column_with_a_number_and_texts_is_named_with_a_way_out() {
    let dir = tempfile::tempdir().unwrap();
    let source = described(dir.path(), "1.5");
    let error = run(&source, &dir.path().join("a"), small()).unwrap_err().to_string();
    let expected = "log.csv line 3: the column \"state\" is \"driving\"; it must be a finite number, as in 0.5 (--state chooses \
                    other columns, or none)";
    assert!(error.contains(expected), "{error}");
    for (states, found) in [("none", vec![]), ("state.heading", vec!["state.heading"])] {
        let options = ImportOptions {
            states: vec![states.to_owned()],
            ..small()
        };
        let imported = run(&source, &dir.path().join(states), options).unwrap();
        assert_eq!(channels(&imported), [vec!["action.speed"], found]);
    }
}

#[test]
fn none_leaves_out_the_actions_of_every_source() {
    let dir = tempfile::tempdir().unwrap();
    let (car, robot, array) = (
        dir.path().join("car"),
        dir.path().join("robot"),
        dir.path().join("a.npz"),
    );
    tub(&car, 8);
    lerobot_images(&robot, 8);
    let frames = numpy_array("|u1", "6, 24, 32", &[7; 6 * 24 * 32]);
    let actions = numpy_array("|u1", "6,", &[1; 6]);
    npz(
        &array,
        &[("frames", frames), ("actions", actions)],
        zip::CompressionMethod::Stored,
    );
    for (source, actions) in [(&car, 2), (&robot, 1), (&array, 1)] {
        let mut options = ImportOptions {
            rate_hz: Some(5.0),
            ..small()
        };
        let out = |name: &str| dir.path().join("sets").join(source.file_name().unwrap()).join(name);
        let all = run(source, &out("all"), options.clone()).unwrap();
        options.actions = vec!["none".to_owned()];
        let none = run(source, &out("none"), options).unwrap();
        assert_eq!(
            [channels(&all)[0].len(), channels(&none)[0].len()],
            [actions, 0],
            "{}",
            source.display()
        );
    }
}

#[test]
fn texts_of_other_sources_are_left_out_with_a_note() {
    let dir = tempfile::tempdir().unwrap();
    let (robot, array) = (dir.path().join("robot"), dir.path().join("a.npz"));
    lerobot_images(&robot, 8);
    let info = robot.join("meta/info.json");
    let mut facts: serde_json::Value = serde_json::from_slice(&fs::read(&info).unwrap()).unwrap();
    facts["features"]["action"]["dtype"] = "string".into();
    fs::write(&info, facts.to_string()).unwrap();
    let imported = run(&robot, &dir.path().join("a"), small()).unwrap();
    assert_eq!(channels(&imported)[0].len(), 0);
    let note =
        "the feature \"action\" is no list of numbers (its type is string, its shape [1]), so it was not imported";
    assert_eq!(imported.notes, [note]);
    let frames = numpy_array("|u1", "6, 24, 32", &[7; 6 * 24 * 32]);
    let actions = numpy_array("<U2", "6,", &[0; 6 * 8]);
    npz(
        &array,
        &[("frames", frames), ("actions", actions)],
        zip::CompressionMethod::Stored,
    );
    let options = ImportOptions {
        rate_hz: Some(5.0),
        ..small()
    };
    let imported = run(&array, &dir.path().join("b"), options).unwrap();
    assert_eq!(channels(&imported)[0].len(), 0);
    assert_eq!(
        imported.notes,
        ["the array \"actions\" holds texts, no numbers, so it was not imported"]
    );
}
