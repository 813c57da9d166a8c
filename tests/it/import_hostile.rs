//! Recordings that would take memory, time or the program: sizes that are only stated, times in another unit, files that never end.

use std::fs;
use std::path::Path;

use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::import::{ImportOptions, Imported};

use crate::bag_files::{BagMessage, image};
use crate::import::{folder, run, small};
use crate::import_arrays::npz;
use crate::recordings::{database, numpy_array};

fn refused(source: &Path, options: ImportOptions) -> String {
    let out = tempfile::tempdir().unwrap();
    run(source, &out.path().join("set"), options).unwrap_err().to_string()
}

fn skipping(source: &Path) -> Imported {
    let out = tempfile::tempdir().unwrap();
    let options = ImportOptions {
        skip_bad: true,
        ..small()
    };
    run(source, &out.path().join("set"), options).unwrap()
}

/// Changes the lines of the folder's CSV file; line 1 is the header.
fn change_line(source: &Path, number: usize, change: impl Fn(&str) -> String) {
    let csv = source.join("log.csv");
    let text = fs::read_to_string(&csv).unwrap();
    let lines = text.lines().enumerate();
    let changed = lines.map(|(index, line)| if index + 1 == number { change(line) } else { line.to_owned() } + "\n");
    fs::write(&csv, changed.collect::<String>()).unwrap();
}

fn with_time(line: &str, time: &str) -> String {
    format!("{time},{}", line.split_once(',').unwrap().1)
}

#[test]
fn times_in_another_unit_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    for line in 2..14 {
        change_line(&source, line, |text| {
            with_time(text, &format!("{}", line * 100_000_000))
        });
    }
    let rates = [None, Some(10.0)];
    for rate_hz in rates {
        let error = refused(&source, ImportOptions { rate_hz, ..small() });
        assert!(
            error.contains("100000000 s apart (median); 0.001 to 100 s are possible") && error.contains("_ns"),
            "{error}"
        );
    }
    for line in 2..14 {
        change_line(&source, line, |text| with_time(text, &format!("{line}e-9")));
    }
    assert!(refused(&source, small()).contains("s apart (median)"));
}

#[test]
fn a_gap_of_years_takes_no_memory() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    change_line(&source, 13, |text| with_time(text, "3e300"));
    assert!(refused(&source, small()).contains("line 13"));
    // Still one segment: the median step is what a jump is compared with.
    change_line(&source, 13, |text| with_time(text, "1e9"));
    let out = dir.path().join("set");
    let options = ImportOptions {
        rate_hz: Some(7.0),
        ..small()
    };
    assert!(run(&source, &out, options).unwrap().info.frame_count > 4);
    Dataset::open(&out).unwrap();
}

#[test]
fn one_time_that_is_too_late_is_left_out_alone() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    change_line(&source, 5, |text| with_time(text, "1e9"));
    let imported = skipping(&source);
    assert_eq!((imported.skipped.len(), imported.info.frame_count), (1, 11));
    assert!(imported.skipped[0].place.ends_with("line 5"), "{:?}", imported.skipped);
}

#[test]
fn images_that_cannot_be_read_are_named_by_their_line() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let long = format!("{}.png", "a".repeat(5000));
    fs::create_dir(source.join("pictures.png")).unwrap();
    let names = ["nul\0.png", &long, "pictures.png"];
    for (line, name) in (3..).zip(names) {
        change_line(&source, line, |text| {
            let fields: Vec<_> = text.split(',').collect();
            format!("{},{name},{},{}", fields[0], fields[2], fields[3])
        });
    }
    assert!(refused(&source, small()).contains("log.csv line 3: the image "));
    let imported = skipping(&source);
    assert_eq!((imported.skipped.len(), imported.info.frame_count), (3, 8));
}

#[test]
fn lines_are_counted_with_empty_ones() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    change_line(&source, 4, |text| format!("\n\n{}", text.replace(",0.2,", ",1e300,")));
    let error = refused(&source, small());
    assert!(
        error.contains("line 6") && error.contains("must be a finite number"),
        "{error}"
    );
}

#[test]
fn columns_may_be_separated_by_semicolons_and_tabs() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let text = fs::read_to_string(source.join("log.csv")).unwrap();
    let hash = |separator: &str| {
        fs::write(source.join("log.csv"), text.replace(',', separator)).unwrap();
        let out = tempfile::tempdir().unwrap();
        run(&source, &out.path().join("set"), small())
            .unwrap()
            .info
            .content_hash
    };
    let with_commas = hash(",");
    assert_eq!([hash(";"), hash("\t")], [with_commas.clone(), with_commas]);
    // As spreadsheets write it where decimals have commas.
    fs::write(source.join("log.csv"), "time;file;action.x\n0,1;0.png;0\n0,2;1.png;0\n").unwrap();
    let error = refused(&source, small());
    assert!(
        error.contains("line 2") && error.contains("\"0,1\"; it must be a finite number, as in 0.5"),
        "{error}"
    );
}

#[test]
fn components_with_the_same_name_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    change_line(&source, 1, |text| text.replace("state.heading", "action.speed [km/h]"));
    let error = refused(&source, small());
    assert!(
        error.contains("two components of the action are named \"action.speed\""),
        "{error}"
    );
}

#[test]
fn headers_tell_separator_and_unit_of_time() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let period_s = |header: &str| {
        change_line(&source, 1, |_| header.to_owned());
        let out = tempfile::tempdir().unwrap();
        let imported = run(&source, &out.path().join("set"), small()).unwrap();
        (imported.info.frame_period_s * 1e6).round() / 1e6
    };
    let quoted = "timestamp,file,\"action.speed [a;b;c;d]\",state.heading";
    assert_eq!(period_s(quoted), 0.1);
    assert_eq!(period_s("\u{feff}timestamp [s],file,action.speed,state.heading"), 0.1);
    for line in 2..14 {
        change_line(&source, line, |text| {
            let (time, rest) = text.split_once(',').unwrap();
            format!("{},{rest}", time.parse::<f64>().unwrap() * 1000.0)
        });
    }
    assert_eq!(period_s("timestamp [ms],file,action.speed,state.heading"), 0.1);
    change_line(&source, 1, |_| {
        "timestamp [h],file,action.speed,state.heading".to_owned()
    });
    assert!(refused(&source, small()).contains("its unit must be s, ms, us or ns"));
    fs::write(source.join("log.csv"), "").unwrap();
    assert!(refused(&source, small()).contains("is empty; its first line must name the columns"));
}

#[test]
fn enormous_files_are_not_read_as_images() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let sparse = fs::File::create(source.join("3.png")).unwrap();
    sparse.set_len(60 << 30).unwrap();
    let error = refused(&source, small());
    assert!(
        error.contains("log.csv line 5") && error.contains("it has more than 256 MiB"),
        "{error}"
    );
    assert_eq!(skipping(&source).skipped.len(), 1);
}

#[test]
fn stated_sizes_of_arrays_take_no_memory() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    let options = || ImportOptions {
        rate_hz: Some(10.0),
        ..small()
    };
    for (shape, reason) in [
        ("1099511627776, 8, 8", "bytes at most; its shape"),
        ("4294967296, 4294967296, 8, 8", "is too large"),
    ] {
        let frames = numpy_array("|u1", shape, &[1; 64]);
        let arrays = [("frames", frames), ("actions", numpy_array("<f4", "1,", &[0; 4]))];
        npz(&path, &arrays, zip::CompressionMethod::Deflated);
        let error = refused(&path, options());
        assert!(error.contains(reason), "{error}");
    }
}

#[cfg(unix)]
#[test]
fn named_pipes_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let pipe = |path: &Path| {
        let made = std::process::Command::new("mkfifo").arg(path).status().unwrap();
        assert!(made.success());
    };
    let source = dir.path().join("walk");
    fs::create_dir(&source).unwrap();
    pipe(&source.join("1.png"));
    pipe(&dir.path().join("a.npy"));
    let options = || ImportOptions {
        rate_hz: Some(10.0),
        ..small()
    };
    assert!(refused(&dir.path().join("a.npy"), options()).contains("could not read"));
    let walk = folder(&dir.path().join("other"));
    fs::remove_file(walk.join("3.png")).unwrap();
    pipe(&walk.join("3.png"));
    let error = refused(&walk, small());
    assert!(error.contains("it is not a regular file"), "{error}");
}

#[test]
fn features_of_a_billion_components_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let meta = dir.path().join("set/meta");
    fs::create_dir_all(&meta).unwrap();
    for size in ["2000000000", "1000000000000000000"] {
        let info = format!(
            r#"{{"codebase_version": "v2.1", "data_path": "data/{{episode_index:099999d}}.parquet", "features": {{
                "image": {{"dtype": "image", "shape": [8, 8, 3]}}, "action": {{"dtype": "float32", "shape": [{size}]}}}}}}"#
        );
        fs::write(meta.join("info.json"), info).unwrap();
        let error = refused(&dir.path().join("set"), small());
        assert!(
            error.contains("\"action\" has ") && error.contains("at most 10000"),
            "{error}"
        );
    }
}

#[test]
fn databases_are_read_as_tables_and_never_written() {
    let dir = tempfile::tempdir().unwrap();
    let (source, computed) = (dir.path().join("drive.db3"), dir.path().join("computed.db3"));
    let message = |index: i64| BagMessage {
        topic: "/image",
        type_name: "sensor_msgs/msg/Image",
        log_ns: index * 100_000_000,
        content: image(false, index * 100_000_000, "mono8", (8, 8), &[7; 64]),
    };
    database(&source, &(0..5).map(message).collect::<Vec<_>>());
    fs::copy(&source, &computed).unwrap();
    let connection = rusqlite::Connection::open(&source).unwrap();
    connection
        .query_row("PRAGMA journal_mode = WAL", [], |_| Ok(()))
        .unwrap();
    drop(connection);
    let names = || fs::read_dir(dir.path()).unwrap().count();
    let before = names();
    let out = tempfile::tempdir().unwrap();
    let imported = run(&source, &out.path().join("set"), small()).unwrap();
    assert_eq!((imported.info.frame_count, names()), (5, before));

    let connection = rusqlite::Connection::open(&computed).unwrap();
    let endless = "ALTER TABLE messages RENAME TO kept;
        CREATE VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)
            SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n;";
    connection.execute_batch(endless).unwrap();
    drop(connection);
    let error = refused(&computed, small());
    assert!(error.contains("are computed"), "{error}");
}
