//! Places of frames in a data set, and how sentences list them.

use serde::Serialize;

use crate::dataset::Dataset;

/// Where a frame is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct FramePlace {
    /// Position of the episode.
    pub episode: usize,
    /// Frame within the episode, counted from 0.
    pub frame: usize,
}

/// The place of a frame that is counted over the whole data set.
pub(super) fn place_of(dataset: &Dataset, frame: usize) -> Option<FramePlace> {
    let mut episodes = dataset.episodes().iter();
    let episode = episodes.find(|episode| episode.frames().contains(&frame))?;
    Some(FramePlace {
        episode: episode.index,
        frame: frame - episode.first_frame,
    })
}

/// The first places, as in `episode 0 frame 12, episode 3 frame 7 and 4 more`.
pub(super) fn listed(places: &[FramePlace]) -> String {
    const NAMED: usize = 3;
    let name = |place: &FramePlace| format!("episode {} frame {}", place.episode, place.frame);
    let names = places.iter().take(NAMED).map(name).collect::<Vec<_>>().join(", ");
    match places.len().saturating_sub(NAMED) {
        0 => names,
        more => format!("{names} and {more} more"),
    }
}

/// A count with its noun, as in `1 frame` or `3 frames`.
pub(super) fn counted(count: usize, noun: &str) -> String {
    let ending = if count == 1 { "" } else { "s" };
    format!("{count} {noun}{ending}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_listed_with_the_number_of_the_others() {
        let places: Vec<_> = (0..5).map(|frame| FramePlace { episode: 1, frame }).collect();
        assert_eq!(
            listed(&places),
            "episode 1 frame 0, episode 1 frame 1, episode 1 frame 2 and 2 more"
        );
        assert_eq!(listed(&places[..1]), "episode 1 frame 0");
    }
}
