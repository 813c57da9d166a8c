//! The kept files.

use std::fs;
use std::path::Path;

/// One file: `STATUS-…` or `ok-…` or `refused-…`.
#[derive(Clone, Debug)]
pub(crate) struct Sample {
    pub(crate) name: String,
    pub(crate) bytes: Vec<u8>,
}

impl Sample {
    /// The name's part before that `-`, counted from 0, without what follows the point.
    pub(crate) fn part(&self, index: usize) -> &str {
        let stem = self.name.split('.').next().unwrap();
        stem.split('-').nth(index).unwrap()
    }

    pub(crate) fn is(&self, extension: &str) -> bool {
        self.name.ends_with(&format!(".{extension}"))
    }
}

/// Every file of a folder of `tests/corpus`, in the order of their names.
pub(crate) fn samples(folder: &str) -> Vec<Sample> {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/corpus").join(folder);
    let mut samples: Vec<Sample> = fs::read_dir(dir)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| Sample {
            name: path.file_name().unwrap().to_str().unwrap().to_owned(),
            bytes: fs::read(&path).unwrap(),
        })
        .collect();
    samples.sort_by(|a, b| a.name.cmp(&b.name));
    assert!(samples.len() > 10, "{folder} holds only {}", samples.len());
    samples
}
