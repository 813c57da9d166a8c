//! Finds the two ways that most blocks went, by votes.

use std::collections::HashMap;

use super::block_tracks::{TRACK_VALUES, Tracks};

/// How fast a block's word counts less as it misfits.
pub(super) const MISFIT_DECAY: f32 = 10.0;
/// Distances between ways that are larger, in pixels, count as this.
pub(super) const FARTHEST_PX: f32 = 4.0;
/// Ways that can get votes, at most. Without a limit, the cost would grow with the square of the pixels.
const MOST_CANDIDATES: usize = 256;

/// How far each block went from each of two ways, in pixels, in the mean over the frames: block after block. The first way is the one that
/// most blocks follow, counted by their light; the second way is the one that most of the rest follow. Of ways with equal votes the first
/// one counts. Blocks that were not followed are at [`FARTHEST_PX`] from both.
pub(super) fn two_ways(tracks: &Tracks, light: &[f32]) -> Vec<[f32; 2]> {
    let values = tracks.values.len() / light.len().max(1);
    let all = tracks.values.chunks_exact(values.max(1)).zip(light);
    let followed: Vec<Block> = all
        .zip(&tracks.followed)
        .enumerate()
        .filter(|(_, (_, followed))| **followed)
        .map(|(place, ((track, light), _))| Block::new(place, track, *light))
        .collect();
    let mut apart = vec![[FARTHEST_PX; 2]; light.len()];
    let mut votes: Vec<f32> = followed.iter().map(|block| block.votes).collect();
    let candidates = candidates(&followed);
    for way in 0..2 {
        let mut best: Option<(f32, Vec<f32>)> = None;
        for candidate in &candidates {
            let distances: Vec<f32> = followed.iter().map(|block| block.distance(candidate)).collect();
            let given = distances
                .iter()
                .zip(&votes)
                .map(|(apart, votes)| nearness(*apart) * votes);
            let given = given.sum();
            if best.as_ref().is_none_or(|(most, _)| given > *most) {
                best = Some((given, distances));
            }
        }
        let Some((_, distances)) = best else {
            break;
        };
        for ((block, votes), distance) in followed.iter().zip(&mut votes).zip(distances) {
            apart[block.place][way] = distance;
            *votes *= 1.0 - nearness(distance);
        }
    }
    apart
}

/// A block of each way that blocks went, in their order. If there are more than [`MOST_CANDIDATES`] ways, those whose own blocks have the most
/// votes.
fn candidates<'a, 'b>(followed: &'b [Block<'a>]) -> Vec<&'b Block<'a>> {
    let mut ways: HashMap<Vec<[i32; 2]>, usize> = HashMap::new();
    let mut found: Vec<(&Block, f32)> = Vec::new();
    for block in followed {
        let steps = block.track.chunks_exact(TRACK_VALUES);
        let way = steps.map(|step| [step[0] as i32, step[1] as i32]).collect();
        let at = *ways.entry(way).or_insert(found.len());
        match found.get_mut(at) {
            Some((_, votes)) => *votes += block.votes,
            None => found.push((block, block.votes)),
        }
    }
    if found.len() > MOST_CANDIDATES {
        found.sort_by(|(_, one), (_, other)| other.total_cmp(one));
        found.truncate(MOST_CANDIDATES);
        found.sort_by_key(|(block, _)| block.place);
    }
    found.into_iter().map(|(block, _)| block).collect()
}

/// 1 for a block that goes the same way, less with the distance.
fn nearness(distance: f32) -> f32 {
    (-distance * distance).exp()
}

struct Block<'a> {
    place: usize,
    track: &'a [f32],
    /// How far the block could be followed to each frame, 0 to 1.
    fits: Vec<f32>,
    votes: f32,
}

impl<'a> Block<'a> {
    fn new(place: usize, track: &'a [f32], light: f32) -> Self {
        let fits = track.iter().skip(2).step_by(TRACK_VALUES);
        let fits: Vec<f32> = fits.map(|misfit| (-MISFIT_DECAY * misfit).exp()).collect();
        let votes = light * fits.iter().sum::<f32>() / fits.len() as f32;
        Self {
            place,
            track,
            fits,
            votes,
        }
    }

    fn distance(&self, way: &Self) -> f32 {
        let (mut sum, mut count) = (0.0, 1e-3);
        let both = self
            .track
            .chunks_exact(TRACK_VALUES)
            .zip(way.track.chunks_exact(TRACK_VALUES));
        for ((one, other), fits) in both.zip(&self.fits) {
            let (across, down) = (one[0] - other[0], one[1] - other[1]);
            sum += fits * (across * across + down * down).sqrt().min(FARTHEST_PX);
            count += fits;
        }
        sum / count
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_two_ways_with_most_light_are_found() {
        let track = |right: f32, misfit: f32| [right, 0.0, misfit, 2.0 * right, 0.0, misfit];
        let tracks = [
            track(1.0, 0.0),
            track(-2.0, 0.0),
            track(1.0, 0.1),
            track(3.0, 0.8),
            [0.0; 6],
            track(-2.0, 0.0),
        ];
        let tracks = Tracks {
            values: tracks.concat(),
            followed: vec![true, true, true, true, false, true],
        };
        let apart = two_ways(&tracks, &[2.0, 3.0, 2.5, 9.0, 0.0, 3.0]);
        // The brightest one misfits, so it has no say. Blocks 1 and 5 have most of the rest, so their way is the first.
        for (block, expected) in [(0, [4.0, 0.0]), (1, [0.0, 4.0]), (2, [4.0, 0.0]), (5, [0.0, 4.0])] {
            for way in 0..2 {
                assert!(
                    (apart[block][way] - expected[way]).abs() < 0.6,
                    "{block}: {:?}",
                    apart[block]
                );
            }
        }
        assert_eq!(apart[4], [FARTHEST_PX; 2]);
    }

    #[test]
    fn what_stands_still_has_a_way_of_its_own() {
        let tracks = Tracks {
            values: vec![0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            followed: vec![true, true, false],
        };
        let apart = two_ways(&tracks, &[5.0, 4.0, 0.0]);
        assert!(apart[0][0] < 0.01 && apart[1][1] < 0.01, "{apart:?}");
        assert!(apart[0][1] > 2.9 && apart[1][0] > 2.9, "{apart:?}");
    }

    #[test]
    fn of_many_ways_those_with_most_votes_are_put_to_the_vote() {
        // Each block goes another way but the last two, which follow each other.
        let count = MOST_CANDIDATES + 50;
        let way = |block: usize| match block.min(count - 2) {
            last if last == count - 2 => [-100.0, -100.0, 0.0],
            block => [(5 * (block % 64)) as f32, (5 * (block / 64)) as f32, 0.0],
        };
        let tracks = Tracks {
            values: (0..count).flat_map(way).collect(),
            followed: vec![true; count],
        };
        let apart = two_ways(&tracks, &vec![1.0; count]);
        assert!(apart[count - 2][0] < 0.01 && apart[count - 1][0] < 0.01);
        assert!(apart[0][0] > 3.9 && apart[0][1] < 0.01, "the first of the others");
        let followed: Vec<Block> = (0..count)
            .map(|place| Block::new(place, &tracks.values[3 * place..][..3], 1.0))
            .collect();
        let places: Vec<usize> = candidates(&followed).iter().map(|block| block.place).collect();
        assert_eq!(places.len(), MOST_CANDIDATES);
        assert!(places.is_sorted() && places.last() == Some(&(count - 2)), "{places:?}");
    }

    #[test]
    fn where_nothing_is_there_are_no_ways() {
        let tracks = Tracks {
            values: vec![0.0; 6],
            followed: vec![false; 2],
        };
        assert_eq!(two_ways(&tracks, &[0.0; 2]), [[FARTHEST_PX; 2]; 2]);
    }
}
