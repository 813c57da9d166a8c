//! Lists of names that only code keeps: which tables SQLite reads, which files ffmpeg opens, which paths a data set of `LeRobot` may name.
//! Each property says what holds for every case, spelling and Unicode variant of such a name.

use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::sync::mpsc;
use std::time::Duration;

use foreframe_core::files::hex;
use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, Imported, import,
};
use proptest::prelude::*;
use proptest::sample::select;
use serde_json::Value;
use tempfile::TempDir;

use crate::bag_files::{BagMessage, Chunks, image, mcap};
use crate::import::small;
use crate::recordings::{database, has_ffmpeg, lerobot_images, lerobot_videos, video};

/// Frames of the recorded sets, all in one episode.
const EPISODE_FRAMES: u32 = 50;
/// An import that would not end stops here.
const MAX_TIME: Duration = Duration::from_secs(30);

/// Imports in a thread, so that an import without end fails only its own test.
fn run(source: PathBuf, options: ImportOptions) -> Result<Imported, ImportError> {
    let (sender, receiver) = mpsc::channel();
    std::thread::spawn(move || {
        let dir = tempfile::tempdir().unwrap();
        let config = ImportConfig {
            source,
            out: dir.path().join("set"),
            options,
            disk_mib: DEFAULT_DISK_MIB,
            max_files: DEFAULT_MAX_FILES,
        };
        sender.send(import(&config, &|_| {}, &AtomicBool::new(false)))
    });
    let result = receiver.recv_timeout(MAX_TIME);
    result.expect("the import ends in 30 s")
}

/// The name with some letters in upper case.
fn in_case(name: &str, upper: u32) -> String {
    let letter = |(index, letter): (usize, char)| {
        if upper >> (index % 32) & 1 == 1 {
            letter.to_ascii_uppercase()
        } else {
            letter.to_ascii_lowercase()
        }
    };
    name.chars().enumerate().map(letter).collect()
}

/// As SQL writes a name.
fn quoted(name: &str, quotes: &str) -> String {
    match quotes {
        "" => name.to_owned(),
        "[" => format!("[{name}]"),
        _ => format!("{quotes}{name}{quotes}"),
    }
}

fn quotes() -> impl Strategy<Value = &'static str> {
    select(&["", "\"", "[", "`"][..])
}

/// What may stand between two words of SQL.
fn space() -> impl Strategy<Value = &'static str> {
    select(&[" ", "\t", "\n", "/**/", " -- AS (\n", "/* as ( */"][..])
}

fn frame(index: i64) -> BagMessage {
    BagMessage {
        topic: "/image",
        type_name: "sensor_msgs/msg/Image",
        log_ns: index * 100_000_000,
        content: image(false, index * 100_000_000, "mono8", (8, 8), &[7; 64]),
    }
}

/// A bag of five frames, which is changed by SQL.
fn changed_bag(sql: &str) -> (TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("drive.db3");
    database(&path, &(0..5).map(frame).collect::<Vec<_>>());
    let connection = rusqlite::Connection::open(&path).unwrap();
    if let Err(error) = connection.execute_batch(sql) {
        panic!("{sql}: {error}");
    }
    (dir, path)
}

/// SQL that makes something else than a plain table of the messages or of the topics, with the same rows.
fn computed_tables() -> impl Strategy<Value = String> {
    let table = select(
        &[
            ("messages", "id, topic_id, timestamp, data"),
            ("topics", "id, name, type, serialization_format"),
        ][..],
    );
    let making = (0..5usize, any::<bool>(), any::<bool>(), any::<bool>());
    let spelling = (any::<u32>(), quotes(), space(), space(), any::<u32>());
    (table, making, spelling).prop_map(
        |((table, columns), (kind, a, b, c), (upper, quotes, left, right, other))| {
            let name = quoted(&in_case(table, upper), quotes);
            let moved = format!("ALTER TABLE {table} RENAME TO kept;");
            let last = columns.rsplit(' ').next().unwrap();
            let others = columns.rsplit_once(',').unwrap().0;
            let typed = others.replacen("id", "id INTEGER PRIMARY KEY", 1);
            let word = |word: &str| in_case(word, other);
            match kind {
                0 | 1 => {
                    let view = format!("{moved} CREATE{left}VIEW{right}{name} AS SELECT {columns} FROM kept;");
                    let edits = [
                        (a, "type = 'table'"),
                        (b, "rootpage = 2"),
                        (c, "name = 'other', tbl_name = 'other'"),
                    ];
                    let edits: Vec<&str> = edits
                        .iter()
                        .filter(|(is_made, _)| *is_made)
                        .map(|(_, edit)| *edit)
                        .collect();
                    if kind == 0 || edits.is_empty() {
                        return view;
                    }
                    let edits = edits.join(", ");
                    format!("{view} PRAGMA writable_schema = ON; UPDATE sqlite_master SET {edits} WHERE type = 'view';")
                }
                2 => format!(
                    "{moved} CREATE{left}{}{right}TABLE {name} USING fts5({columns});
                 INSERT INTO {name}(rowid, {columns}) SELECT id, {columns} FROM kept;",
                    word("virtual")
                ),
                3 => {
                    let always = if a { word("generated always") } else { String::new() };
                    let stored = if b { word("stored") } else { String::new() };
                    // Of the five frames, the first one again and again.
                    let value = format!("CAST(x'{}' AS BLOB)", hex(&frame(0).content));
                    let value = if table == "topics" { "'cdr'".to_owned() } else { value };
                    format!(
                        "{moved} CREATE TABLE {name}({typed}, {last}{left}{always}{right}{}({value}){stored});
                     INSERT INTO {name}({others}) SELECT {others} FROM kept;",
                        word("as")
                    )
                }
                _ => {
                    let value = if table == "topics" {
                        "'cdr'".to_owned()
                    } else {
                        format!("x'{}'", hex(&frame(0).content))
                    };
                    format!(
                        "{moved} CREATE TABLE {name}({typed});
                     INSERT INTO {name}({others}) SELECT {others} FROM kept;
                     ALTER TABLE {name} ADD COLUMN{left}{}{right}{}{left}{value};",
                        in_case(last, other),
                        word("default")
                    )
                }
            }
        },
    )
}

proptest! {
    #[test]
    fn computed_tables_are_read_in_no_spelling(sql in computed_tables(), skip_bad: bool) {
        let (_dir, path) = changed_bag(&sql);
        let read = run(path, ImportOptions { skip_bad, ..small() });
        prop_assert!(read.is_err(), "{sql}");
    }

    #[test]
    fn plain_tables_are_read_in_every_case(upper: (u32, u32), quotes in (quotes(), quotes())) {
        let topics = quoted(&in_case("topics", upper.0), quotes.0);
        let messages = quoted(&in_case("messages", upper.1), quotes.1);
        // SQLite does not rename a table to its own name in another case.
        let sql = format!(
            "ALTER TABLE topics RENAME TO a; ALTER TABLE a RENAME TO {topics};
             ALTER TABLE messages RENAME TO b; ALTER TABLE b RENAME TO {messages};"
        );
        let (_dir, path) = changed_bag(&sql);
        prop_assert_eq!(run(path, small()).unwrap().info.frame_count, 5, "{}", sql);
    }

    #[test]
    fn names_that_only_look_alike_are_other_tables(
        name in select(&["meſſages", "MESSAGEŞ", "ｍessages", "mеssages", "messages ", "messages\u{301}", "messages\u{200b}", "\u{feff}messages"][..]),
        upper: u32,
        is_alone: bool,
    ) {
        let name = in_case(name, upper);
        let moved = if is_alone { "ALTER TABLE messages RENAME TO kept;" } else { "ALTER TABLE messages ADD COLUMN more;" };
        let from = if is_alone { "kept" } else { "messages" };
        let columns = "id, topic_id, timestamp, data";
        let sql = format!("{moved} CREATE VIEW \"{name}\" AS SELECT {columns} FROM {from} UNION ALL SELECT {columns} FROM {from};");
        let (_dir, path) = changed_bag(&sql);
        match run(path, small()) {
            Ok(read) => prop_assert!(!is_alone && read.info.frame_count == 5, "{sql}"),
            Err(error) => prop_assert!(is_alone, "{sql}: {error}"),
        }
    }
}

#[test]
fn a_transaction_that_was_not_finished_is_not_read() {
    let (dir, path) = changed_bag("PRAGMA journal_mode = DELETE");
    let mut large = frame(0);
    large.content = image(false, 0, "mono8", (64, 64), &[7; 4096]);
    let more = (5..200).map(|index| BagMessage {
        log_ns: index * 100_000_000,
        content: large.content.clone(),
        ..frame(index)
    });
    fs::remove_file(&path).unwrap();
    database(&path, &more.collect::<Vec<_>>());
    let connection = rusqlite::Connection::open(&path).unwrap();
    // With so small a cache, the changes are written before the commit.
    let change = "PRAGMA cache_size = 2; BEGIN; UPDATE messages SET timestamp = timestamp * 2";
    connection.execute_batch(change).unwrap();
    let copied = dir.path().join("copied.db3");
    fs::copy(&path, &copied).unwrap();
    fs::copy(
        dir.path().join("drive.db3-journal"),
        dir.path().join("copied.db3-journal"),
    )
    .unwrap();
    let error = run(copied, small()).unwrap_err().to_string();
    assert!(error.contains("it is damaged"), "{error}");
}

#[test]
fn a_cancelled_import_of_a_bag_is_stopped_while_it_is_read() {
    let (dir, database) = changed_bag("SELECT 1");
    let bag = dir.path().join("drive.mcap");
    let messages: Vec<_> = (0..5).map(frame).collect();
    fs::write(&bag, mcap(&messages, Chunks::None, 5)).unwrap();
    for source in [database, bag] {
        let config = ImportConfig {
            source,
            out: dir.path().join("set"),
            options: small(),
            disk_mib: DEFAULT_DISK_MIB,
            max_files: DEFAULT_MAX_FILES,
        };
        let stopped = import(&config, &|_| {}, &AtomicBool::new(true));
        assert!(matches!(stopped, Err(ImportError::Stopped)), "{stopped:?}");
    }
}

/// A file that ffmpeg could take for a list of others, or for a description of a stream.
fn playlist(kind: usize, target: &str) -> String {
    match kind {
        0 => format!("#EXTM3U\n#EXT-X-VERSION:3\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\n{target}\n#EXT-X-ENDLIST\n"),
        1 => format!("ffconcat version 1.0\nfile '{target}'\n"),
        2 => format!(
            "<?xml version=\"1.0\"?><MPD xmlns=\"urn:mpeg:dash:schema:mpd:2011\" type=\"static\" mediaPresentationDuration=\"PT2S\"
             profiles=\"urn:mpeg:dash:profile:isoff-on-demand:2011\"><Period><AdaptationSet mimeType=\"video/mp4\">
             <Representation id=\"1\" bandwidth=\"9\"><BaseURL>{target}</BaseURL></Representation></AdaptationSet></Period></MPD>"
        ),
        3 => format!("v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video {target} RTP/AVP 26\n"),
        4 => format!("[playlist]\nFile1={target}\nNumberOfEntries=1\nVersion=2\n"),
        _ => format!("<asx version=\"3.0\"><entry><ref href=\"{target}\"/></entry></asx>"),
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: ProptestConfig::default().cases.div_ceil(16), ..ProptestConfig::default() })]

    #[test]
    fn no_playlist_under_a_videos_name_opens_another_file(
        ending in select(&["mp4", "mkv", "avi", "mov", "webm"][..]),
        upper: u32,
        kind in 0..6usize,
        scheme in select(&["", "file:", "FILE:", "http://", "tcp://", "concat:", "subfile,,start,0,end,0,,:", "data:", "crypto:"][..]),
        scheme_upper: u32,
    ) {
        if !has_ffmpeg() {
            return Ok(());
        }
        let dir = tempfile::tempdir().unwrap();
        // Who connects stays in its queue.
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.set_nonblocking(true).unwrap();
        let port = listener.local_addr().unwrap().port();
        video(&dir.path().join("other.mp4"), 3);
        let address = ["http://", "tcp://"].contains(&scheme);
        let other = if address { format!("127.0.0.1:{port}/other.mp4") } else { dir.path().join("other.mp4").display().to_string() };
        let source = dir.path().join(format!("walk.{}", in_case(ending, upper)));
        let list = playlist(kind, &format!("{}{other}", in_case(scheme, scheme_upper)));
        fs::write(&source, &list).unwrap();
        let read = run(source, small());
        prop_assert!(read.is_err(), "{list}");
        prop_assert!(listener.accept().is_err(), "{list}");
    }
}

/// Ways to write a path that leads from the data set to the folder beside it.
fn paths_out() -> impl Strategy<Value = String> {
    let up = select(&["..", "./..", "data/../..", "../set/..", ".//..", "data/./../.."][..]);
    let plain = (up, select(&["/", "//", "/./"][..])).prop_map(|(up, slash)| format!("{up}{slash}outside"));
    prop_oneof![
        4 => plain,
        2 => Just("ABSOLUTE".to_owned()),
        1 => select(&["..\\outside", "%2e%2e/outside", "‥/outside", "．．/outside", "..∕outside", "~/outside", "file:../outside", ".. /outside"][..])
            .prop_map(str::to_owned),
    ]
}

/// A data set of version 2, whose tables (or videos) are moved to a folder: one beside it, or in it.
fn moved_set(is_video: bool, folder: &str) -> (TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let set = dir.path().join("set");
    let outside = set.join(folder);
    let moved = if is_video {
        lerobot_videos(&set, EPISODE_FRAMES);
        "videos"
    } else {
        lerobot_images(&set, EPISODE_FRAMES);
        fs::remove_file(set.join("meta/foreframe.json")).unwrap();
        "data"
    };
    fs::rename(set.join(moved), &outside).unwrap();
    fs::create_dir(set.join(moved)).unwrap();
    let episode = format!("{{\"episode_index\": 0, \"length\": {EPISODE_FRAMES}}}\n");
    fs::write(set.join("meta/episodes.jsonl"), episode).unwrap();
    change_info(&set, |info| {
        info["codebase_version"] = "v2.1".into();
        info["data_path"] = "data/chunk-{episode_chunk:03d}/file-{episode_index:03d}.parquet".into();
        info["video_path"] = "videos/{video_key}/chunk-{episode_chunk:03d}/file-{episode_index:03d}.mp4".into();
    });
    (dir, set, outside)
}

fn change_info(set: &Path, change: impl Fn(&mut Value)) {
    let path = set.join("meta/info.json");
    let mut info: Value = serde_json::from_slice(&fs::read(&path).unwrap()).unwrap();
    change(&mut info);
    fs::write(path, info.to_string()).unwrap();
}

/// Puts another folder in the place of the path's first one.
fn change_path(set: &Path, is_video: bool, folder: &str) {
    let key = if is_video { "video_path" } else { "data_path" };
    change_info(set, |info| {
        let rest = info[key].as_str().unwrap().split_once('/').unwrap().1.to_owned();
        info[key] = format!("{folder}/{rest}").into();
    });
}

/// Gives the camera another name, which is the first part of the videos' path.
fn change_camera(set: &Path, name: &str) {
    change_info(set, |info| {
        let features = info["features"].as_object_mut().unwrap();
        let feature = features.remove("observation.image").unwrap();
        features.insert(name.to_owned(), feature);
        info["video_path"] = info["video_path"].as_str().unwrap().replace("videos/", "").into();
    });
}

fn assert_not_found(set: PathBuf, name: &str) {
    let error = run(set, small()).unwrap_err().to_string();
    let is_found = !error.contains("it must be a file below") && !error.contains("is missing");
    assert!(!is_found, "{name}: {error}");
}

#[test]
fn paths_within_a_lerobot_set_are_read() {
    for is_video in [false, true] {
        if is_video && !has_ffmpeg() {
            return;
        }
        for folder in ["outside", "./outside", "outside/.", "outside//"] {
            let (_dir, set, _) = moved_set(is_video, "outside");
            change_path(&set, is_video, folder);
            let read = run(set, small()).unwrap();
            assert_eq!(read.info.frame_count, EPISODE_FRAMES as usize, "{folder}");
        }
    }
    let (_dir, set, _) = moved_set(true, "outside");
    change_camera(&set, "outside/observation.image");
    assert_eq!(run(set, small()).unwrap().info.frame_count, EPISODE_FRAMES as usize);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: ProptestConfig::default().cases.div_ceil(16), ..ProptestConfig::default() })]

    #[test]
    fn a_path_of_a_lerobot_set_never_leaves_it(path in paths_out(), is_video: bool, is_in_name: bool, braces in 0..3usize) {
        if is_video && !has_ffmpeg() {
            return Ok(());
        }
        let (_dir, set, outside) = moved_set(is_video, "../outside");
        let path = path.replace("ABSOLUTE", outside.to_str().unwrap());
        // Fields are filled in before the path is used.
        let path = match braces {
            1 => path.replacen("..", ".{nothing}.", 1),
            2 => path.replacen('/', "/{nothing}/", 1),
            _ => path,
        };
        if is_video && is_in_name {
            change_camera(&set, &format!("{path}/observation.image"));
        } else {
            change_path(&set, is_video, &path);
        }
        assert_not_found(set, &path);
    }
}
