//! What a command suggests to do next: commands that work as they are printed.

use std::path::Path;

use super::error::CliError;
use foreframe_data::dataset::{Dataset, DatasetInfo, Split, Splits};
use foreframe_train::training::TrainConfig;
use foreframe_train::training::config::WindowBudget;

/// Larger data sets have windows enough for every preset, and take long to read.
const MAX_COUNTED_BYTES: u64 = 400 << 20;

/// The first of the configurations with which a data set has windows enough to train on; `None` if none has.
pub(super) fn first_trainable(
    dataset: &Path,
    info: &DatasetInfo,
    configs: impl IntoIterator<Item = TrainConfig>,
) -> Result<Option<TrainConfig>, CliError> {
    let is_large = info.decoded_bytes() > MAX_COUNTED_BYTES;
    let dataset = (!is_large).then(|| Dataset::open(dataset)).transpose()?;
    let has_windows = |config: &TrainConfig| dataset.as_ref().is_none_or(|dataset| has_windows(config, dataset));
    Ok(configs.into_iter().find(has_windows))
}

/// Whether a training with this configuration finds windows enough in the data set.
fn has_windows(config: &TrainConfig, dataset: &Dataset) -> bool {
    let splits = Splits::new(dataset, config.data.split_seed);
    let count = |split| {
        let windows = splits.windows(dataset, split, config.window_shape(), 1);
        windows.map_or(0, |windows| windows.len())
    };
    let needed = match config.data.windows {
        WindowBudget::Count(count) => count,
        WindowBudget::All => 1,
    };
    count(Split::Train) >= needed && count(Split::Validation) > 0
}

/// A text as a word of a shell: quoted if it has more than letters, digits and the signs of names and paths.
pub(super) fn shell_word(text: &str) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "/._-=@:,+".contains(c);
    if !text.is_empty() && text.chars().all(is_plain) {
        return text.to_owned();
    }
    format!("'{}'", text.replace('\'', r"'\''"))
}

/// The same of a path.
pub(super) fn shell_path(path: &Path) -> String {
    shell_word(&path.display().to_string())
}

/// A name for a data set or a model, made of any text: lower-case letters, digits and `-`; `other` if nothing is left.
pub(super) fn name_from(text: &str, other: &str) -> String {
    let allowed = |c: char| if c.is_ascii_alphanumeric() { c } else { '-' };
    let name: String = text.to_lowercase().chars().map(allowed).take(64).collect();
    let name = name.trim_matches('-');
    if name.is_empty() { other } else { name }.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_of_a_shell_are_quoted_where_they_must_be() {
        assert_eq!(shell_word("data/datasets/a_b.mcap"), "data/datasets/a_b.mcap");
        assert_eq!(shell_word("my drive's"), r"'my drive'\''s'");
        assert_eq!(shell_word("$HOME"), "'$HOME'");
    }

    #[test]
    fn every_text_gives_a_name() {
        for (text, name) in [
            ("bag_sql", "bag-sql"),
            ("Ünder Score", "nder-score"),
            ("…", "recording"),
        ] {
            assert_eq!(name_from(text, "recording"), name);
        }
    }
}
