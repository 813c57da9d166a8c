//! The files of the corpus.

use std::fs;
use std::path::Path;

/// One file, named `STATUS-…`, `ok-…` or `refused-…`.
#[derive(Clone, Debug)]
pub(crate) struct CorpusFile {
    pub(crate) name: String,
    pub(crate) bytes: Vec<u8>,
}

impl CorpusFile {
    /// Part `index` of the name without its extension, separated by `-` and counted from 0.
    pub(crate) fn part(&self, index: usize) -> &str {
        let stem = self.name.split('.').next().unwrap();
        stem.split('-').nth(index).unwrap()
    }

    pub(crate) fn is(&self, extension: &str) -> bool {
        self.name.ends_with(&format!(".{extension}"))
    }
}

/// All files of a folder of `tests/corpus`, sorted by name.
pub(crate) fn files(folder: &str) -> Vec<CorpusFile> {
    // The load tests, in a crate of their own, read it too.
    let above = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors();
    let dir = above
        .map(|dir| dir.join("tests/corpus").join(folder))
        .find(|dir| dir.is_dir())
        .unwrap();
    let mut files: Vec<CorpusFile> = fs::read_dir(dir)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .map(|path| CorpusFile {
            name: path.file_name().unwrap().to_str().unwrap().to_owned(),
            bytes: fs::read(&path).unwrap(),
        })
        .collect();
    files.sort_by(|a, b| a.name.cmp(&b.name));
    assert!(files.len() > 10, "{folder} has only {} files", files.len());
    files
}
