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

impl FramePlace {
    /// The frame before it in the episode; the first one itself.
    pub(super) fn before(self) -> Self {
        let frame = self.frame.saturating_sub(1);
        Self { frame, ..self }
    }
}

/// The places of all frames in their order.
pub(super) fn places(dataset: &Dataset) -> impl Iterator<Item = FramePlace> {
    dataset.episodes().iter().flat_map(|episode| {
        (0..episode.frame_count).map(|frame| FramePlace {
            episode: episode.index,
            frame,
        })
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
