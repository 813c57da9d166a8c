//! Everything that reads bytes of others. One program, so that it is compiled and linked once; the variable `FUZZ_READER` names
//! the reader. With `FUZZ_SEEDS=DIR` it writes the seeds that are not in tests/corpus and ends.
#![no_main]

use std::path::{Path, PathBuf};
use std::process::exit;
use std::sync::atomic::AtomicBool;
use std::sync::{LazyLock, OnceLock};

use axum::extract::ws::Message;
use foreframe_data::dataset::import::{DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportOptions, import};
use foreframe_data::dataset::{CollectConfig, Dataset, collect, silence_caught_panics};
use foreframe_core::files::sha256_hex;
use foreframe_core::frame::codec;
use foreframe_core::registry::Manifest;
use foreframe::server::protocol::{ClientMessage, Codec};
use foreframe_core::serving::{SessionSnapshot, SessionState};
use foreframe_sim::{Scenario, WorldConfig};
use foreframe_train::training::{self, CHECKPOINT_FILE, CheckpointPosition, TrainConfig, Training};
use foreframe_core::types::Seed;
use libfuzzer_sys::fuzz_target;

#[allow(dead_code)]
#[path = "../../tests/it/bag_files.rs"]
mod bag_files;

type Reader = fn(&[u8]);

const READERS: [(&str, Reader); 11] = [
    ("messages-json", messages_json),
    ("messages-msgpack", messages_msgpack),
    ("images", images),
    ("states", states),
    ("checkpoints", checkpoints),
    ("shards", shards),
    ("bags", |bytes| imported("bag.mcap", bytes)),
    ("databases", |bytes| imported("bag.db3", bytes)),
    ("zips", |bytes| imported("walk.zip", bytes)),
    ("tars", |bytes| imported("walk.tar", bytes)),
    ("videos", |bytes| imported("walk.mp4", bytes)),
];

static READER: LazyLock<Reader> = LazyLock::new(|| {
    if let Some(dir) = std::env::var_os("FUZZ_SEEDS") {
        write_seeds(Path::new(&dir));
        exit(0);
    }
    let name = std::env::var("FUZZ_READER").unwrap_or_default();
    let found = READERS.iter().find(|(known, _)| *known == name);
    let Some((_, reader)) = found else {
        eprintln!(
            "FUZZ_READER is {name:?}; it must be one of {:?}",
            READERS.map(|(name, _)| name)
        );
        exit(2)
    };
    // The fuzzer's hook would abort before they are caught.
    silence_caught_panics();
    *reader
});

fuzz_target!(init: LazyLock::force(&READER), |bytes: &[u8]| READER(bytes));

/// What a message means must not depend on the way it was written.
fn decoded(codec: Codec, message: &Message) {
    if let Ok(decoded) = codec.decode::<ClientMessage>(message) {
        let text = serde_json::to_string(&decoded).unwrap();
        let again = Codec::Json.decode::<ClientMessage>(&Message::Text(text.clone().into()));
        // Not-a-number is not equal to itself, so the texts are compared. JSON has no infinity: it became null, which is no number.
        if let Ok(again) = again {
            assert_eq!(serde_json::to_string(&again).unwrap(), text);
        }
    }
}

fn messages_json(bytes: &[u8]) {
    if let Ok(text) = std::str::from_utf8(bytes) {
        decoded(Codec::Json, &Message::Text(text.into()));
    }
}

fn messages_msgpack(bytes: &[u8]) {
    let _ = Codec::Msgpack.decode::<ClientMessage>(&Message::Binary(bytes.to_vec().into()));
}

/// An image that decodes has the size that was read from its head before.
fn images(bytes: &[u8]) {
    let Ok(size) = codec::dimensions(bytes) else {
        return;
    };
    // Callers refuse others before they decode.
    if size.width <= 512
        && size.height <= 512
        && let Ok(frame) = codec::decode(bytes)
    {
        assert_eq!(frame.size(), size);
    }
}

fn states(bytes: &[u8]) {
    static MANIFEST: OnceLock<Manifest> = OnceLock::new();
    let manifest = MANIFEST.get_or_init(|| {
        let model = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/moving");
        foreframe_core::registry::manifest::read(Path::new(model)).unwrap()
    });
    let Ok(snapshot) = serde_json::from_slice::<SessionSnapshot>(bytes) else {
        return;
    };
    if let Ok(state) = SessionState::restore(snapshot, manifest) {
        let again = SessionState::restore(state.snapshot(), manifest).unwrap();
        assert!(state.next_seq() == again.next_seq() && state.frame_count() == again.frame_count());
    }
}

fn checkpoints(bytes: &[u8]) {
    let _ = CheckpointPosition::of(bytes);
    let _ = CheckpointPosition::of(&sealed(bytes.to_vec()));
}

/// With the right hash in its place: those with a wrong one are refused before they are read.
fn sealed(mut bytes: Vec<u8>) -> Vec<u8> {
    let key = b"\"foreframe.training\":\"";
    let Some(start) = bytes.windows(key.len()).position(|part| part == key) else {
        return bytes;
    };
    let range = start + key.len()..start + key.len() + 64;
    if let Some(digits) = bytes.get_mut(range.clone()) {
        digits.fill(b'0');
        let hash = sha256_hex(&bytes);
        bytes[range].copy_from_slice(hash.as_bytes());
    }
    bytes
}

/// A small data set whose only shard is replaced.
struct ShardSet {
    dir: tempfile::TempDir,
    shard: PathBuf,
    metadata: PathBuf,
    text: String,
    hash: String,
}

fn simulate(trials: u64, out: &Path) {
    let config = CollectConfig {
        world: WorldConfig {
            frame_width_px: 16,
            frame_height_px: 12,
            ..WorldConfig::default()
        },
        ..CollectConfig::new(Scenario::StaticObserver, trials, Seed(1), out)
    };
    collect(&config, &|_| {}, &AtomicBool::new(false)).unwrap();
}

fn shard_set() -> ShardSet {
    let dir = in_memory();
    let out = dir.path().join("set");
    simulate(1, &out);
    let (metadata, shard) = (out.join(foreframe_data::dataset::METADATA), find_shard(&out.join("data")));
    let text = std::fs::read_to_string(&metadata).unwrap();
    let hash = sha256_hex(&std::fs::read(&shard).unwrap());
    ShardSet {
        dir,
        shard,
        metadata,
        text,
        hash,
    }
}

fn find_shard(dir: &Path) -> PathBuf {
    let path = std::fs::read_dir(dir).unwrap().next().unwrap().unwrap().path();
    if path.is_dir() { find_shard(&path) } else { path }
}

fn shards(bytes: &[u8]) {
    static SET: OnceLock<ShardSet> = OnceLock::new();
    let set = SET.get_or_init(shard_set);
    std::fs::write(&set.shard, bytes).unwrap();
    // With the hashes of the replaced shard: those of a damaged one are refused before it is read.
    let hash = sha256_hex(bytes);
    let text = set.text.replace(&set.hash, &hash);
    let of_all = |hash: &str| sha256_hex(hash.as_bytes());
    std::fs::write(&set.metadata, text.replace(&of_all(&set.hash), &of_all(&hash))).unwrap();
    let _ = Dataset::open(&set.dir.path().join("set"));
}

/// Imports a recording, once with and once without what is damaged.
fn imported(name: &str, bytes: &[u8]) {
    static DIR: OnceLock<tempfile::TempDir> = OnceLock::new();
    let dir = DIR.get_or_init(in_memory).path();
    let source = dir.join(name);
    std::fs::write(&source, bytes).unwrap();
    for skip_bad in [false, true] {
        let config = ImportConfig {
            source: source.clone(),
            out: dir.join("out"),
            options: ImportOptions {
                frame_width_px: 8,
                frame_height_px: 8,
                skip_bad,
                ..ImportOptions::default()
            },
            disk_mib: DEFAULT_DISK_MIB,
            max_files: DEFAULT_MAX_FILES,
        };
        let _ = import(&config, &|_| {}, &AtomicBool::new(false));
        let _ = std::fs::remove_dir_all(&config.out);
    }
}

/// A directory in memory where there is one.
fn in_memory() -> tempfile::TempDir {
    tempfile::tempdir_in("/dev/shm")
        .or_else(|_| tempfile::tempdir())
        .unwrap()
}

fn write_seeds(dir: &Path) {
    let set = shard_set();
    let shard = std::fs::read(&set.shard).unwrap();
    let (image, twist) = (
        bag_files::image(false, 1_000_000_000, "mono8", (4, 3), &[9; 12]),
        bag_files::twist(false, 0.5, 0.1),
    );
    let of = |topic, type_name, log_ns, content: &[u8]| bag_files::BagMessage {
        topic,
        type_name,
        log_ns,
        content: content.to_vec(),
    };
    let messages: Vec<_> = (0..6)
        .flat_map(|index| {
            let time_ns = 1_000_000_000 + index * 200_000_000;
            [
                of("/camera/image_raw", "sensor_msgs/msg/Image", time_ns, &image),
                of("/cmd_vel", "geometry_msgs/msg/Twist", time_ns, &twist),
            ]
        })
        .collect();
    let bag = bag_files::mcap(&messages, bag_files::Chunks::None, 4);
    let seeds = [
        ("shards", "shard", shard),
        ("bags", "mcap", bag),
        ("checkpoints", "checkpoint", checkpoint()),
    ];
    for (reader, name, bytes) in seeds {
        let dir = dir.join(reader);
        std::fs::create_dir_all(&dir).unwrap();
        std::fs::write(dir.join(name), bytes).unwrap();
    }
}

/// The checkpoint of a small training.
fn checkpoint() -> Vec<u8> {
    let dir = in_memory();
    let (set, run_dir) = (dir.path().join("set"), dir.path().join("run"));
    simulate(20, &set);
    let settings = [
        "model.features=4",
        "model.hidden=4",
        "data.windows=20",
        "data.validation_windows=4",
        "pretrain.steps=1",
        "sequence.steps=1",
        "sequence.batch_size=2",
    ];
    let config = TrainConfig::layered("paper", None, &settings.map(str::to_owned)).unwrap();
    let training = Training {
        config: &config,
        dataset: &Dataset::open(&set).unwrap(),
        run_dir: &run_dir,
        command: "fuzz/run",
        start: None,
    };
    training::run(&training, &mut |_| {}, &AtomicBool::new(false)).unwrap();
    std::fs::read(run_dir.join(CHECKPOINT_FILE)).unwrap()
}
