//! Options describe the camera of a recording.

use std::path::Path;

use foreframe_core::frame::resize::Resize;
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::import::ImportOptions;

use crate::import::{folder, run};
use crate::import_arrays::npz;
use crate::recordings::{has_ffmpeg, numpy_array as npy, video};

/// A camera of 90° whose images lose a quarter of their columns.
fn described() -> ImportOptions {
    ImportOptions {
        frame_width_px: 12,
        frame_height_px: 12,
        rate_hz: Some(10.0),
        fov_deg: Some(90.0),
        tilt_deg: Some(-10.0),
        camera_height_m: Some(0.3),
        ..ImportOptions::default()
    }
}

fn assert_described(source: &Path, out: &Path) {
    run(source, out, described()).unwrap();
    let camera = Dataset::open(out).unwrap().camera(0).unwrap();
    // 2 · atan(24 / 32).
    let fov_deg = camera.horizontal_fov_rad.to_degrees();
    assert!((fov_deg - 73.74).abs() < 0.01, "{}: {fov_deg}", source.display());
    assert!((camera.tilt_down_rad.to_degrees() + 10.0).abs() < 1e-4);
    assert_eq!(camera.height_m, Some(0.3));
}

#[test]
fn options_describe_the_camera_of_images_and_arrays() {
    let dir = tempfile::tempdir().unwrap();
    assert_described(&folder(dir.path()), &dir.path().join("a"));
    let source = dir.path().join("walk.npz");
    let frames = npy("|u1", "6, 24, 32", &[7; 6 * 24 * 32]);
    npz(&source, &[("frames", frames)], zip::CompressionMethod::Deflated);
    assert_described(&source, &dir.path().join("b"));
}

#[test]
fn options_describe_the_camera_of_a_video() {
    if !has_ffmpeg() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("drive.mp4");
    video(&source, 20);
    let out = dir.path().join("out");
    run(&source, &out, described()).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!(
        (dataset.info().frame_count, dataset.camera(0).unwrap().height_m),
        (10, Some(0.3))
    );
}

#[test]
fn a_camera_that_cannot_be_described_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let source = folder(dir.path());
    let error = |options: ImportOptions| run(&source, &dir.path().join("out"), options).unwrap_err().to_string();
    for (change, expected) in [
        (
            ImportOptions {
                fov_deg: Some(180.0),
                ..described()
            },
            "--fov is 180; it must be 5 to 170 degrees",
        ),
        (
            ImportOptions {
                tilt_deg: Some(f64::NAN),
                ..described()
            },
            "--tilt is NaN; it must be -85 to 85 degrees",
        ),
        (
            ImportOptions {
                camera_height_m: Some(0.0),
                ..described()
            },
            "--camera-height is 0; it must be 0.01 to 10 metres",
        ),
        (
            ImportOptions {
                fov_deg: None,
                ..described()
            },
            "--tilt and --camera-height need --fov, since the recording does not say",
        ),
        (
            ImportOptions {
                resize: Resize::Stretch,
                ..described()
            },
            "--fov cannot describe images that are stretched from 32×24 to 12×12 px",
        ),
    ] {
        let error = error(change);
        assert!(error.starts_with(expected), "{error}");
    }
}
