//! Recordings in archives: imported as their folder would be, and hostile ones refused without a trace outside.

use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use flate2::Compression;
use flate2::write::GzEncoder;
use foreframe_core::files::files_below;
use foreframe_data::dataset::import::{
    DEFAULT_DISK_MIB, DEFAULT_MAX_FILES, ImportConfig, ImportError, ImportOptions, Imported, import,
};
use proptest::prelude::*;
use zip::write::SimpleFileOptions;

use crate::import::{folder, run, small};

/// An entry of a tar archive: its kind, name and content.
struct TarEntry<'a> {
    kind: u8,
    name: &'a str,
    content: &'a [u8],
}

fn file<'a>(name: &'a str, content: &'a [u8]) -> TarEntry<'a> {
    TarEntry {
        kind: b'0',
        name,
        content,
    }
}

/// A tar archive in the format ustar. The names are cut off at 100 bytes.
fn tar(entries: &[TarEntry]) -> Vec<u8> {
    let mut archive = Vec::new();
    for TarEntry { kind, name, content } in entries {
        let mut header = [0; 512];
        let name = &name.as_bytes()[..name.len().min(100)];
        header[..name.len()].copy_from_slice(name);
        header[100..108].copy_from_slice(b"0000644\0");
        header[124..136].copy_from_slice(format!("{:011o}\0", content.len()).as_bytes());
        header[156] = *kind;
        header[257..265].copy_from_slice(b"ustar\x0000");
        header[148..156].fill(b' ');
        let sum: u32 = header.iter().map(|&byte| u32::from(byte)).sum();
        header[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
        archive.extend(header);
        archive.extend(*content);
        archive.resize(archive.len().next_multiple_of(512), 0);
    }
    archive.resize(archive.len() + 1024, 0);
    archive
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

pub(crate) fn zip(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for (name, content) in entries {
        archive.start_file(*name, SimpleFileOptions::default()).unwrap();
        archive.write_all(content).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

/// The files of a folder by their names below it.
pub(crate) fn contents(root: &Path, prefix: &str) -> Vec<(String, Vec<u8>)> {
    let paths = files_below(root).unwrap();
    let named = |path: PathBuf| {
        let name = path.strip_prefix(root).unwrap().to_str().unwrap();
        (format!("{prefix}{name}"), fs::read(&path).unwrap())
    };
    paths.into_iter().map(named).collect()
}

fn import_within(source: &Path, out: &Path, disk_mib: u64, max_files: u64) -> Result<Imported, ImportError> {
    let config = ImportConfig {
        source: source.to_owned(),
        out: out.to_owned(),
        options: small(),
        disk_mib,
        max_files,
    };
    import(&config, &|_| {}, &AtomicBool::new(false))
}

/// Imports an archive in an empty directory, and checks that nothing but the archive and the data set's directory is there after.
fn imported(name: &str, bytes: &[u8], disk_mib: u64, max_files: u64) -> Result<Imported, ImportError> {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join(name), dir.path().join("set"));
    fs::write(&source, bytes).unwrap();
    let result = import_within(&source, &out, disk_mib, max_files);
    for path in files_below(dir.path()).unwrap() {
        let is_unpacked = path.components().any(|part| part.as_os_str() == ".unpacked");
        let is_expected = path == source || path.starts_with(&out);
        assert!(is_expected && !is_unpacked, "{name}: {} is left", path.display());
    }
    result
}

fn refused(name: &str, bytes: &[u8]) -> String {
    let error = imported(name, bytes, 1, 20).unwrap_err();
    assert!(matches!(error, ImportError::Archive { .. }), "{error:?}");
    error.to_string()
}

#[test]
fn an_archive_is_imported_as_its_folder() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let expected = run(&source, &dir.path().join("set"), small()).unwrap().info;
    for prefix in ["", "walk/", "./deep/walk/"] {
        let files = contents(&source, prefix);
        let entries: Vec<TarEntry> = files.iter().map(|(name, bytes)| file(name, bytes)).collect();
        let packed: Vec<(&str, &[u8])> = files.iter().map(|(name, bytes)| (name.as_str(), &bytes[..])).collect();
        let archive = tar(&entries);
        for (name, bytes) in [
            ("walk.tar.gz", gzip(&archive)),
            ("walk.TGZ", gzip(&archive)),
            ("walk.tar", archive),
            ("walk.zip", zip(&packed)),
        ] {
            let found = imported(name, &bytes, 1, 20).unwrap_or_else(|error| panic!("{prefix}{name}: {error}"));
            assert_eq!(found.info, expected, "{prefix}{name}");
        }
    }
}

#[test]
fn a_single_file_in_an_archive_is_the_recording() {
    let array = crate::recordings::numpy_array("|u1", "12, 24, 32", &[7; 12 * 24 * 32]);
    let with_foreign = zip(&[
        ("walk.npy", &array),
        ("__MACOSX/._walk.npy", b"of the system"),
        (".DS_Store", b"of the system"),
    ]);
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("walk.zip");
    fs::write(&source, with_foreign).unwrap();
    let options = ImportOptions {
        rate_hz: Some(10.0),
        ..small()
    };
    assert_eq!(
        run(&source, &dir.path().join("set"), options).unwrap().info.frame_count,
        12
    );
}

#[test]
fn long_names_of_gnu_and_of_pax_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let long = format!("{}/", "long-".repeat(30));
    let files = contents(&source, &long);
    for is_pax in [false, true] {
        let named = |name: &str| {
            let line = |length: usize| format!("{length} path={name}\n");
            let length = (0..999).find(|&length| line(length).len() == length).unwrap();
            if is_pax { line(length) } else { format!("{name}\0") }
        };
        let names: Vec<String> = files.iter().map(|(name, _)| named(name)).collect();
        let kind = if is_pax { b'x' } else { b'L' };
        let entries = files.iter().zip(&names).flat_map(|((name, bytes), long)| {
            let header = TarEntry {
                kind,
                name: "long",
                content: long.as_bytes(),
            };
            [header, file(name, bytes)]
        });
        let archive = tar(&entries.collect::<Vec<_>>());
        let found = imported("walk.tar", &archive, 1, 40).unwrap();
        assert_eq!(found.info.frame_count, 12, "{is_pax}");
    }
}

#[test]
fn paths_that_lead_out_are_refused() {
    for name in ["../out.png", "/out.png", "a/../../out.png", "a\\..\\out.png"] {
        for (archive, bytes) in [
            ("bad.tar", tar(&[file(name, b"x")])),
            ("bad.tgz", gzip(&tar(&[file(name, b"x")]))),
            ("bad.zip", zip(&[(name, b"x")])),
        ] {
            let error = refused(archive, &bytes);
            assert!(
                error.contains("is not a path inside the archive's folder"),
                "{archive} {name}: {error}"
            );
        }
    }
}

#[test]
fn links_and_devices_are_refused() {
    for (kind, expected) in [
        (b'1', "is a link"),
        (b'2', "is a link"),
        (b'3', "is no plain file or folder"),
        (b'6', "is no plain file or folder"),
        (b'S', "is no plain file or folder"),
    ] {
        let entry = TarEntry {
            kind,
            name: "1.png",
            content: b"",
        };
        let error = refused("bad.tar", &tar(&[entry]));
        assert!(error.contains(expected), "{error}");
    }
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    archive
        .add_symlink("1.png", "/etc/passwd", SimpleFileOptions::default())
        .unwrap();
    let error = refused("bad.zip", &archive.finish().unwrap().into_inner());
    assert!(error.contains("\"1.png\" is a link"), "{error}");
}

#[test]
fn the_unpacked_size_and_the_number_of_files_are_bounded() {
    let large = vec![0; 3 << 20];
    for (name, bytes) in [
        ("bomb.tar.gz", gzip(&tar(&[file("1.png", &large)]))),
        ("bomb.zip", zip(&[("1.png", &large)])),
        ("foreign.zip", zip(&[("__MACOSX/1", &large)])),
    ] {
        assert!(bytes.len() < 1 << 16);
        let error = refused(name, &bytes);
        assert!(
            error.contains("holds more than 1 MiB, the limit of the setting import_disk_mib"),
            "{error}"
        );
    }
    let names: Vec<String> = (0..21).map(|index| format!("{index}.png")).collect();
    let many: Vec<(&str, &[u8])> = names.iter().map(|name| (name.as_str(), &b"x"[..])).collect();
    let error = refused("many.zip", &zip(&many));
    assert!(
        error.contains("holds more than 20 files, the limit of the setting max_import_files"),
        "{error}"
    );
    let headers: Vec<TarEntry> = (0..21)
        .map(|_| TarEntry {
            kind: b'g',
            name: "",
            content: b"",
        })
        .collect();
    assert!(refused("many.tar", &tar(&headers)).contains("more than 20 files"));
    let deep = "a/".repeat(49) + "x";
    assert!(refused("deep.tar", &tar(&[file(&deep, b"x")])).contains("32 parts"));
}

#[test]
fn an_error_names_the_path_in_the_archive() {
    let csv = b"timestamp,file\n0,0.png\n0.2,1.png\n";
    for (name, bytes) in [
        ("drive.zip", zip(&[("walk/log.csv", csv), ("walk/0.png", b"no image")])),
        (
            "drive.tar",
            tar(&[file("walk/log.csv", csv), file("walk/0.png", b"no image")]),
        ),
    ] {
        let error = imported(name, &bytes, 1, 20).unwrap_err().to_string();
        assert!(error.contains(&format!("{name}/walk/")), "{error}");
        assert!(!error.contains(".unpacked"), "{error}");
    }
}

/// One item that the list of images shows, and one that only decoding shows.
#[test]
fn what_is_left_out_is_named_as_in_the_archive() {
    let dir = tempfile::tempdir().unwrap();
    let walk = folder(dir.path());
    fs::write(walk.join("2.png"), b"no image").unwrap();
    fs::remove_file(walk.join("9.png")).unwrap();
    let files = contents(&walk, "walk/");
    let packed: Vec<(&str, &[u8])> = files.iter().map(|(name, bytes)| (name.as_str(), &bytes[..])).collect();
    let (archive, set) = (dir.path().join("drive.zip"), dir.path().join("set"));
    fs::write(&archive, zip(&packed)).unwrap();
    let options = ImportOptions {
        skip_bad: true,
        ..small()
    };
    let skipped = run(&archive, &set, options).unwrap().skipped;
    let inside = archive.join("walk");
    let csv = inside.join("log.csv").display().to_string();
    let of_line = |line: &str| skipped.iter().find(|item| item.place == format!("{csv} {line}"));
    assert!(of_line("line 11").unwrap().reason.contains("is missing"), "{skipped:?}");
    let damaged = &of_line("line 4").unwrap().reason;
    assert!(
        damaged.starts_with(&*inside.join("2.png").to_string_lossy()),
        "{damaged}"
    );
    let listed = fs::read_to_string(set.join("meta/skipped.json")).unwrap();
    assert_eq!((skipped.len(), listed.contains(".unpacked")), (2, false), "{listed}");
}

#[test]
fn damaged_archives_are_refused() {
    let whole = tar(&[file("1.png", &[7; 3000])]);
    let mut wrong_sum = whole.clone();
    wrong_sum[0] = b'9';
    let mut gzipped = gzip(&whole);
    let half = gzipped.len() / 2;
    for (name, bytes, expected) in [
        ("a.tar", &whole[..2000], "is cut off"),
        ("a.tar", &whole[..512 + 3072], "is cut off"),
        ("a.tar", &wrong_sum[..], "checksum is wrong"),
        ("a.tar", b"no archive", "is cut off"),
        ("a.zip", b"no archive", "is no zip archive"),
        ("a.tgz", b"no archive", "cannot be decompressed"),
    ] {
        let error = refused(name, bytes);
        assert!(error.contains(expected), "{name}: {error}");
    }
    gzipped.truncate(half);
    refused("a.tgz", &gzipped);
    let twice = [file("1.png", b"x"), file("1.png", b"y")];
    assert!(refused("a.tar", &tar(&twice)).contains("more than once"));
    let both = [file("1.png", b"x"), file("1.png/2.png", b"y")];
    assert!(refused("a.tar", &tar(&both)).contains("both a file and a folder"));
    // Not even an archive in an archive: it would multiply the limits.
    let inner = zip(&[("1.png", b"x")]);
    let error = imported("a.zip", &zip(&[("b.zip", &inner)]), 1, 20).unwrap_err();
    assert!(matches!(error, ImportError::UnknownSource(_)), "{error}");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn changed_archives_write_nothing_outside(at in 0usize..4000, byte: u8, is_zip: bool, cut in 0usize..4000) {
        let files: [(&str, &[u8]); 3] = [("a/1.png", &[7; 900]), ("a/2.png", b""), ("a/b/3.png", b"x")];
        let mut bytes = if is_zip {
            zip(&files)
        } else {
            tar(&files.map(|(name, content)| file(name, content)))
        };
        let length = bytes.len();
        bytes[at % length] = byte;
        bytes.truncate(length - cut.saturating_sub(3000) % length);
        // No image is one, so no import can succeed.
        imported(if is_zip { "a.zip" } else { "a.tar" }, &bytes, DEFAULT_DISK_MIB, DEFAULT_MAX_FILES).unwrap_err();
    }
}
