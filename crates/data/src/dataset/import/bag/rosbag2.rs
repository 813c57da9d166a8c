//! The directory that `ros2 bag record` writes: `metadata.yaml` and one or more files of messages.

use std::path::{Path, PathBuf};

use crate::dataset::import::error::ImportError;
use crate::dataset::import::files::{entries, extension, inside, read_text};

const METADATA: &str = "metadata.yaml";
/// Endings of files that were compressed as a whole.
const COMPRESSED: [&str; 2] = [".zstd", ".zst"];

fn is_bag_file(path: &Path) -> bool {
    matches!(extension(path).as_str(), "mcap" | "db3")
}

/// Whether a source is a file of messages or a directory with such.
pub(super) fn is_bag(source: &Path) -> bool {
    if source.is_file() {
        return is_bag_file(source);
    }
    source.join(METADATA).is_file() || entries(source).is_ok_and(|paths| paths.iter().any(|path| is_bag_file(path)))
}

/// The bag's files in the order of recording. Errors: `Io`, `Record`.
pub(super) fn files(source: &Path) -> Result<Vec<PathBuf>, ImportError> {
    if source.is_file() {
        return Ok(vec![source.to_owned()]);
    }
    let metadata = source.join(METADATA);
    if !metadata.is_file() {
        // A recording that was killed has none yet.
        let mut paths = entries(source)?;
        paths.retain(|path| is_bag_file(path));
        return Ok(paths);
    }
    let text = read_text(&metadata)?;
    let place = metadata.display().to_string();
    let names = file_names(&text);
    if names.is_empty() {
        return Err(ImportError::record(place, "it lists no files in relative_file_paths"));
    }
    names.iter().map(|name| existing(source, name, &place)).collect()
}

/// A listed file, without compression.
fn existing(source: &Path, name: &str, place: &str) -> Result<PathBuf, ImportError> {
    let plain = COMPRESSED
        .iter()
        .find_map(|ending| name.strip_suffix(ending))
        .unwrap_or(name);
    let path = inside(source, plain, place)?;
    if path.is_file() {
        return Ok(path);
    }
    let reason = if plain == name {
        format!("it lists {name}, which is missing")
    } else {
        format!("it lists {name}, which is compressed as a whole; decompress it beside it (unzstd {name})")
    };
    Err(ImportError::record(place, reason))
}

/// The entries of `relative_file_paths`, written as a block or in brackets.
fn file_names(metadata: &str) -> Vec<String> {
    let unquoted = |text: &str| text.trim().trim_matches(['"', '\'']).to_owned();
    let mut lines = metadata.lines().map(str::trim);
    let Some(rest) = lines.find_map(|line| line.strip_prefix("relative_file_paths:")) else {
        return Vec::new();
    };
    if let Some(list) = rest.trim().strip_prefix('[') {
        let items = list.trim_end_matches(']').split(',').map(unquoted);
        return items.filter(|item| !item.is_empty()).collect();
    }
    lines.map_while(|line| line.strip_prefix("- ")).map(unquoted).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_forms_of_a_list_are_read() {
        let block =
            "rosbag2_bagfile_information:\n  relative_file_paths:\n    - a_0.db3\n    - 'a_1.db3'\n  duration:\n";
        assert_eq!(file_names(block), ["a_0.db3", "a_1.db3"]);
        assert_eq!(file_names("x:\n  relative_file_paths: [a_0.mcap]\n"), ["a_0.mcap"]);
        assert_eq!(file_names("x: 1\n"), [""; 0]);
    }
}
