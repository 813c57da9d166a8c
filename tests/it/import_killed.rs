//! Imports that are killed with SIGKILL at random points: the same command continues, to the bytes of an unbroken import.
#![cfg(unix)]

use std::fs;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::Instant;

use foreframe_core::types::Seed;
use rand::Rng as _;

use crate::process::{foreframe, text};
use crate::recordings::{self, contents, has_ffmpeg};

/// Enough for two shards and the beginning of a third, in which kills can land.
const FRAMES: u32 = 4200;
/// How often each import is killed before it may end.
const KILLS: usize = 4;

/// Starts the import of `source` into the directory `out`, beside it.
fn start(dir: &Path, source: &str, out: &str, options: &[&str]) -> Child {
    let mut command = foreframe(dir);
    command
        .args(["import", source, "--out", out, "--size", "32x32"])
        .args(options);
    command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

fn finish(child: Child) {
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output.stderr));
}

/// Imports a source without a break, then with kills. `options` are those of `foreframe import`.
fn killed_and_unbroken_are_equal(source: &str, options: &[&str], write: impl Fn(&Path)) {
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join(source));
    let began = Instant::now();
    finish(start(dir.path(), source, "whole/set", options));
    let took = began.elapsed();
    let (mut rng, mut share, mut landed) = (Seed(source.len() as u64).rng(), 1.0, 0);
    while landed < KILLS {
        let mut child = start(dir.path(), source, "killed/set", options);
        std::thread::sleep(took.mul_f64(share * rng.random_range(0.05..1.0)));
        if child.try_wait().unwrap().is_none() {
            // On Unix this is SIGKILL.
            child.kill().unwrap();
            child.wait().unwrap();
            landed += 1;
        } else {
            // It has ended: begin again, and kill earlier.
            finish(child);
            (share, landed) = (share * 0.7, 0);
            assert!(
                share > 0.01,
                "{source}: no kill landed before the end of an import, which takes {took:?}"
            );
            fs::remove_dir_all(dir.path().join("killed")).unwrap();
        }
    }
    finish(start(dir.path(), source, "killed/set", options));
    let (whole, killed) = (
        contents(&dir.path().join("whole")),
        contents(&dir.path().join("killed")),
    );
    assert!(
        whole.len() > 5 && whole.keys().eq(killed.keys()),
        "{source}: {:?}",
        killed.keys()
    );
    for (path, bytes) in &whole {
        assert!(killed[path] == *bytes, "{source}: {} differs", path.display());
    }
    // An import that is complete is left as it is.
    finish(start(dir.path(), source, "killed/set", options));
    assert!(
        contents(&dir.path().join("killed")) == killed,
        "{source}: a complete import was changed"
    );
}

#[test]
fn a_killed_import_of_images_ends_with_the_same_bytes() {
    killed_and_unbroken_are_equal("images", &[], |path| recordings::images_with_csv(path, FRAMES));
}

#[test]
fn a_killed_import_of_a_tub_ends_with_the_same_bytes() {
    killed_and_unbroken_are_equal("tub", &["--skip-bad"], |path| {
        recordings::tub(path, FRAMES);
        // Left out while the catalog is read, and while images are.
        let catalog = path.join("catalog_0.catalog");
        let lines = fs::read_to_string(&catalog).unwrap();
        fs::write(&catalog, lines.replacen("\"user/angle\"", "\"other\"", 1)).unwrap();
        for index in [70, 2500, 4100] {
            fs::write(path.join(format!("images/{index}_cam_image_array_.jpg")), b"no image").unwrap();
        }
    });
}

#[test]
fn a_killed_import_of_arrays_ends_with_the_same_bytes() {
    killed_and_unbroken_are_equal("frames.npy", &["--rate", "10"], |path| recordings::npy(path, FRAMES));
    killed_and_unbroken_are_equal("drive.npz", &[], |path| recordings::npz(path, FRAMES));
}

#[test]
fn a_killed_import_of_a_bag_ends_with_the_same_bytes() {
    killed_and_unbroken_are_equal("drive.mcap", &[], |path| recordings::mcap_bag(path, FRAMES));
    killed_and_unbroken_are_equal("drive.db3", &[], |path| recordings::db3_bag(path, FRAMES));
}

#[test]
fn a_killed_import_of_a_lerobot_set_ends_with_the_same_bytes() {
    killed_and_unbroken_are_equal("lerobot", &[], |path| recordings::lerobot_images(path, FRAMES));
}

#[test]
fn a_killed_import_of_videos_ends_with_the_same_bytes() {
    if has_ffmpeg() {
        killed_and_unbroken_are_equal("drive.mp4", &["--every", "2"], |path| recordings::video(path, FRAMES));
        killed_and_unbroken_are_equal("videos", &[], |path| recordings::lerobot_videos(path, FRAMES));
    }
}

#[test]
fn a_directory_with_half_a_first_file_is_unused() {
    let dir = tempfile::tempdir().unwrap();
    recordings::images_with_csv(&dir.path().join("images"), 20);
    // What a kill during the very first write leaves.
    fs::create_dir_all(dir.path().join("out/set/meta")).unwrap();
    fs::write(
        dir.path().join("out/set/meta/import.json.0123456789abcdef.partial"),
        "{",
    )
    .unwrap();
    finish(start(dir.path(), "images", "out/set", &[]));
    finish(start(dir.path(), "images", "whole/set", &[]));
    assert_eq!(contents(&dir.path().join("out")), contents(&dir.path().join("whole")));
}
