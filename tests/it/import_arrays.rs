//! NumPy arrays become data sets.

use std::fs;
use std::path::Path;

use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::import::ImportOptions;

use crate::import::{run, small};
use crate::recordings::numpy_array as npy;

#[test]
fn a_numpy_array_of_sequences_becomes_episodes() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("moving.npy");
    let text = "{'descr': '|u1', 'fortran_order': False, 'shape': (3, 5, 12, 16), }\n";
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes.extend((0..3 * 5).flat_map(|frame| vec![frame as u8; 16 * 12]));
    fs::write(&source, &bytes).unwrap();
    let missing = run(&source, &dir.path().join("a"), small()).unwrap_err().to_string();
    assert!(missing.contains("--rate"), "{missing}");
    let options = ImportOptions {
        rate_hz: Some(10.0),
        ..small()
    };
    let out = dir.path().join("out");
    run(&source, &out, options.clone()).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!((dataset.episodes().len(), dataset.info().frame_count), (5, 15));
    // Sequence 1 holds the array's frames 1, 6 and 11.
    assert_eq!([3, 4, 5].map(|frame| dataset.pixels(frame).unwrap()[0]), [1, 6, 11]);
    fs::write(&source, &bytes[..bytes.len() - 1]).unwrap();
    let cut = run(&source, &dir.path().join("b"), options).unwrap_err().to_string();
    assert!(cut.contains("the file ends here"), "{cut}");
}

pub(crate) fn npz(path: &Path, arrays: &[(&str, Vec<u8>)], method: zip::CompressionMethod) {
    let mut archive = zip::ZipWriter::new(fs::File::create(path).unwrap());
    for (name, array) in arrays {
        let options = zip::write::SimpleFileOptions::default().compression_method(method);
        archive.start_file(format!("{name}.npy"), options).unwrap();
        std::io::Write::write_all(&mut archive, array).unwrap();
    }
    archive.finish().unwrap();
}

/// Arrays by name.
type NamedArrays = Vec<(&'static str, Vec<u8>)>;

/// Six color frames, one action component, three state components, times 0.1 s apart.
fn arrays() -> NamedArrays {
    let floats = |count: u8| -> Vec<u8> { (0..count).flat_map(|value| f32::from(value).to_le_bytes()).collect() };
    let frames = (0..6)
        .flat_map(|frame| vec![frame * 10; 16 * 12 * 3])
        .collect::<Vec<u8>>();
    let times: Vec<u8> = (0..6i64)
        .flat_map(|frame| (5_000 + frame * 100).to_le_bytes())
        .collect();
    vec![
        ("frames", npy("|u1", "6, 12, 16, 3", &frames)),
        ("actions", npy("<f4", "6,", &floats(6))),
        ("states", npy("<f4", "6, 3", &floats(18))),
        ("timestamps_ms", npy("<i8", "6,", &times)),
    ]
}

#[test]
fn arrays_of_one_file_become_frames_actions_and_states() {
    let dir = tempfile::tempdir().unwrap();
    let mut hashes = Vec::new();
    for method in [zip::CompressionMethod::Stored, zip::CompressionMethod::Deflated] {
        let source = dir.path().join(format!("{method}.npz"));
        npz(&source, &arrays(), method);
        let options = ImportOptions {
            units: vec!["states.1=m".to_owned()],
            ..small()
        };
        let out = dir.path().join(format!("out-{method}"));
        hashes.push(run(&source, &out, options).unwrap().info.content_hash);
        let dataset = Dataset::open(&out).unwrap();
        assert_eq!((dataset.info().frame_count, dataset.info().frame_period_s), (6, 0.1));
        assert_eq!(
            (dataset.action(2), dataset.state(2)),
            (&[2.0f32][..], &[6.0f32, 7.0, 8.0][..])
        );
        assert_eq!(dataset.pixels(4).unwrap()[0], 40);
        let names: Vec<String> = dataset.info().state_channels.iter().map(ToString::to_string).collect();
        assert_eq!(names, ["states.0", "states.1 m", "states.2"]);
        assert!(!out.join("decoded.gray.tmp").exists());
    }
    assert_eq!(hashes[0], hashes[1]);
}

#[test]
fn arrays_of_any_numbers_are_read_and_colors_of_floats() {
    let dir = tempfile::tempdir().unwrap();
    let floats = |values: Vec<f32>| values.into_iter().flat_map(f32::to_le_bytes).collect::<Vec<u8>>();
    let colors = (0..6).flat_map(|_| [1.0, 0.0, 0.0].repeat(16 * 12)).collect();
    let times: Vec<u8> = (0..6u64).flat_map(|frame| (frame * 100).to_le_bytes()).collect();
    let arrays: NamedArrays = vec![
        ("frames", npy("<f4", "6, 12, 16, 3", &floats(colors))),
        ("actions", npy("<f2", "6,", &[0x00, 0xbe].repeat(6))),
        ("states", npy("|b1", "6,", &[1; 6])),
        ("timestamps_ms", npy("<u8", "6,", &times)),
    ];
    let (source, out) = (dir.path().join("a.npz"), dir.path().join("out"));
    npz(&source, &arrays, zip::CompressionMethod::Stored);
    run(&source, &out, small()).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    assert_eq!((dataset.info().frame_count, dataset.info().frame_period_s), (6, 0.1));
    assert_eq!((dataset.action(2), dataset.state(2)), (&[-1.5f32][..], &[1.0f32][..]));
    assert_eq!(dataset.pixels(4).unwrap()[0], 76);
}

#[test]
fn wrong_arrays_of_a_file_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let source = dir.path().join("a.npz");
    let error = |change: &dyn Fn(&mut NamedArrays), options: ImportOptions| {
        let mut arrays = arrays();
        change(&mut arrays);
        npz(&source, &arrays, zip::CompressionMethod::Deflated);
        run(&source, &dir.path().join("out"), options).unwrap_err().to_string()
    };
    let text = error(&|arrays| arrays[1].1 = npy("|O", "6,", b"\x80\x04."), small());
    assert!(
        text.contains("a.npz array actions: it holds Python objects (pickle)"),
        "{text}"
    );
    let text = error(&|arrays| arrays[1].1 = npy("<f4", "5,", &[0; 20]), small());
    assert!(
        text.contains("array actions: its shape is [5]; it must begin with [6]"),
        "{text}"
    );
    let text = error(&|arrays| arrays[1].1 = npy("<f4", "6,", &[255; 24]), small());
    assert!(text.contains("value 0 is NaN"), "{text}");
    let text = error(&|arrays| arrays[0].1.truncate(900), small());
    assert!(text.contains("array frames: it has 900 bytes"), "{text}");
    let text = error(&|arrays| arrays[3].1 = npy("<i8", "6,", &[0; 48]), small());
    assert!(text.contains("times must grow"), "{text}");
    let text = error(&|arrays| drop(arrays.pop()), small());
    assert!(
        text.contains("no array of timestamps") && text.contains("--rate"),
        "{text}"
    );
    let named = ImportOptions {
        image: Some("camera".to_owned()),
        ..small()
    };
    let text = error(&|_| {}, named);
    assert!(
        text.contains("no array \"camera\"") && text.contains("frames, actions, states"),
        "{text}"
    );
    fs::write(&source, b"PK\x03\x04 cut off").unwrap();
    let text = run(&source, &dir.path().join("out"), small()).unwrap_err().to_string();
    assert!(text.contains("not a .npz file"), "{text}");
}
