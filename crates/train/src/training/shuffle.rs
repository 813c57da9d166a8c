//! Shuffles the training data. What a step draws depends only on the seed and the number of the step, so that a resumed training
//! draws the same positions as an uninterrupted one.

use std::sync::{Arc, Mutex, PoisonError};

use rand::seq::SliceRandom;

use foreframe_core::types::Seed;

/// Draws positions `0..count`, each once per epoch.
pub(super) struct Shuffle {
    order: Order,
    seed: Seed,
    /// The order of the epoch that was drawn from last: to shuffle millions of positions for each batch would take long.
    last: Mutex<(usize, Arc<Vec<usize>>)>,
}

/// What an epoch consists of.
enum Order {
    /// All positions.
    Whole { count: usize },
    /// From each part, as many positions as its share says.
    Mixed { parts: Vec<MixedPart> },
}

/// One of several parts whose positions follow one another.
struct MixedPart {
    /// Its first position.
    first: usize,
    /// How many of its positions an epoch draws.
    drawn: usize,
    shuffle: Shuffle,
}

impl Shuffle {
    /// Shuffles `count` positions. `count` is at least 1: a training without windows is refused earlier.
    pub(super) fn new(count: usize, seed: Seed) -> Self {
        Self::of(Order::Whole { count }, seed)
    }

    /// Shuffles the positions of parts that follow one another, each with its number of positions, at least 1, and its share of
    /// what is drawn. Of each part, every position is drawn once before any of them is drawn again. One part is shuffled as by
    /// [`Shuffle::new`].
    pub(super) fn mixed(parts: &[(usize, f64)], seed: Seed) -> Self {
        let total: usize = parts.iter().map(|&(count, _)| count).sum();
        if parts.len() == 1 {
            return Self::new(total, seed);
        }
        let (mut first, mut share_before) = (0, 0.0);
        let place = |share: f64| (share * total as f64).round() as usize;
        let mixed = parts.iter().enumerate().map(|(index, &(count, share))| {
            let part = MixedPart {
                first,
                drawn: place(share_before + share) - place(share_before),
                shuffle: Self::new(count, seed.derive("part", index as u64)),
            };
            (first, share_before) = (first + count, share_before + share);
            part
        });
        let parts = mixed.collect();
        Self::of(Order::Mixed { parts }, seed)
    }

    fn of(order: Order, seed: Seed) -> Self {
        Self {
            order,
            seed,
            last: Mutex::new((usize::MAX, Arc::default())),
        }
    }

    /// Positions that an epoch draws.
    fn epoch_len(&self) -> usize {
        match &self.order {
            Order::Whole { count } => *count,
            Order::Mixed { parts } => parts.iter().map(|part| part.drawn).sum(),
        }
    }

    /// The positions of batch number `step`. A batch larger than the number of positions continues in the next epoch.
    pub(super) fn batch(&self, step: usize, batch_size: usize) -> Vec<usize> {
        self.drawn(step * batch_size, batch_size)
    }

    /// `count` positions from draw number `first` on.
    fn drawn(&self, first: usize, count: usize) -> Vec<usize> {
        let length = self.epoch_len();
        let (mut epoch, mut order) = (usize::MAX, Arc::default());
        (first..first + count)
            .map(|draw| {
                if draw / length != epoch {
                    epoch = draw / length;
                    order = self.order(epoch);
                }
                order[draw % length]
            })
            .collect()
    }

    /// The positions in the order of an epoch.
    fn order(&self, epoch: usize) -> Arc<Vec<usize>> {
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if last.0 != epoch {
            let mut order: Vec<usize> = match &self.order {
                Order::Whole { count } => (0..*count).collect(),
                Order::Mixed { parts } => parts.iter().flat_map(|part| part.drawn_in(epoch)).collect(),
            };
            order.shuffle(&mut self.seed.derive("epoch", epoch as u64).rng());
            *last = (epoch, Arc::new(order));
        }
        Arc::clone(&last.1)
    }
}

impl MixedPart {
    /// The positions that an epoch draws of this part.
    fn drawn_in(&self, epoch: usize) -> Vec<usize> {
        let drawn = self.shuffle.drawn(epoch * self.drawn, self.drawn);
        drawn.into_iter().map(|position| self.first + position).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_epoch_draws_every_position_once() {
        let shuffle = Shuffle::new(10, Seed(3));
        let mut first: Vec<usize> = (0..2).flat_map(|step| shuffle.batch(step, 5)).collect();
        first.sort_unstable();
        assert_eq!(first, (0..10).collect::<Vec<_>>());
    }

    #[test]
    fn a_batch_larger_than_the_data_repeats_positions() {
        let mut batch = Shuffle::new(3, Seed(1)).batch(0, 6);
        batch.sort_unstable();
        assert_eq!(batch, [0, 0, 1, 1, 2, 2]);
    }

    #[test]
    fn a_batch_does_not_depend_on_earlier_batches() {
        let (early, late) = (Shuffle::new(7, Seed(1)), Shuffle::new(7, Seed(1)));
        (0..9).for_each(|step| drop(early.batch(step, 4)));
        assert_eq!(early.batch(9, 4), late.batch(9, 4));
    }

    #[test]
    fn parts_are_drawn_by_their_shares() {
        let shuffle = Shuffle::mixed(&[(900, 0.25), (100, 0.75)], Seed(5));
        let drawn: Vec<usize> = (0..100).flat_map(|step| shuffle.batch(step, 10)).collect();
        let of_first = drawn.iter().filter(|&&position| position < 900).count();
        assert_eq!(of_first, 250);
        // Every position of the second part is drawn 7 or 8 times.
        for position in 900..1000 {
            let times = drawn.iter().filter(|&&other| other == position).count();
            assert!((7..=8).contains(&times), "{position} is drawn {times} times");
        }
    }

    #[test]
    fn one_part_is_shuffled_as_a_whole() {
        let (mixed, whole) = (Shuffle::mixed(&[(20, 1.0)], Seed(2)), Shuffle::new(20, Seed(2)));
        assert_eq!(mixed.batch(3, 8), whole.batch(3, 8));
    }
}
