//! Expected errors that follow the errors made so far. A session compares each frame that arrives with what it had predicted of it,
//! and scales what it expects of the next predictions as the past ones were off. So its bands also hold where the calibration,
//! which knows only data like those of the training, expects too little.

use std::collections::VecDeque;
use std::sync::Arc;

use crate::frame::Frame;
use crate::frame::difference::squared_difference_of_bytes;
use crate::registry::calibration::ExpectedError;
use crate::vectorized::vectorized;

/// Every so many pixels of a frame are compared, in both directions.
const STRIDE: usize = 4;
/// What an error counts for when the next one comes.
const FADING: f32 = 0.9;
/// For how many errors the calibration counts at the first step, and each step's errors at the next one.
const PRIOR: f32 = 1.0;
/// Of the logarithm of an error over what was expected of it, at most.
const MOST: f32 = 7.0;
/// At least: where a camera hangs, nothing is to be expected of its next frames.
const LEAST: f32 = -2.0;
/// Steps that are compared; later ones go by the last of them.
const STEPS: usize = 8;
const LEAST_MSE: f32 = 1e-7;

/// How large the errors of a predicted step were, over the middles of their bands. Both numbers fade with each new error.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct PastError {
    /// The sum of the natural logarithms of the errors over what was expected.
    log_sum: f32,
    /// How many errors that is: 0 for none, 10 for very many.
    weight: f32,
}

impl PastError {
    fn add(&mut self, log: f32) {
        self.log_sum = FADING * self.log_sum + log.clamp(LEAST, MOST);
        self.weight = FADING * self.weight + 1.0;
    }

    /// The mean of the logarithms, and of `before` as often as [`PRIOR`] says.
    fn mean(self, before: f32) -> f32 {
        (self.log_sum + PRIOR * before) / (self.weight + PRIOR)
    }

    /// Whether past errors can have led to these numbers.
    fn is_possible(self) -> bool {
        (0.0..=1.0 / (1.0 - FADING) + 1e-3).contains(&self.weight) && self.log_sum.abs() <= MOST * self.weight + 1e-3
    }
}

/// The errors of a session, and the predictions whose errors are still to come.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct PastErrors {
    /// Of each predicted step.
    of_steps: Vec<PastError>,
    /// The predictions from the last frames, the latest first; empty for a frame without one. Each task has all, so they are shared.
    pending: VecDeque<Arc<[PendingFrame]>>,
}

/// A predicted frame that did not arrive yet.
#[derive(Clone, Debug, PartialEq)]
struct PendingFrame {
    pixels: Vec<u8>,
    /// The middle of the band that the calibration gave.
    expected: f32,
}

impl PastErrors {
    /// Those of a session that goes on elsewhere. Errors: the index of numbers that no errors of so many steps give.
    pub(super) fn restored(numbers: &[[f32; 2]], horizon: usize) -> Result<Self, usize> {
        let numbers = numbers.iter().map(|&[log_sum, weight]| PastError { log_sum, weight });
        let of_steps: Vec<PastError> = numbers.collect();
        let mut indexed = of_steps.iter().enumerate();
        if let Some((index, _)) = indexed.find(|(index, past)| *index >= horizon || !past.is_possible()) {
            return Err(index);
        }
        Ok(Self {
            of_steps,
            pending: VecDeque::new(),
        })
    }

    /// What [`Self::restored`] takes.
    pub(super) fn numbers(&self) -> Vec<[f32; 2]> {
        self.of_steps.iter().map(|past| [past.log_sum, past.weight]).collect()
    }

    /// Compares a frame with what was predicted of it before.
    pub(super) fn observe(&mut self, frame: &Frame) {
        let arrived = sampled(frame);
        if arrived.is_empty() {
            return;
        }
        for (step, predicted) in self.pending.iter().enumerate() {
            let Some(predicted) = predicted.get(step) else { continue };
            let error = mean_squared_difference(&predicted.pixels, &arrived).max(LEAST_MSE);
            if self.of_steps.len() <= step {
                self.of_steps.resize(step + 1, PastError::default());
            }
            self.of_steps[step].add((error / predicted.expected).ln());
        }
    }

    /// Keeps the frames that were predicted from the last one, with the errors that the calibration expects; none if nothing was
    /// predicted.
    pub(super) fn keep(&mut self, frames: &[Frame], errors: &[ExpectedError]) {
        let predicted = frames.iter().zip(errors).take(STEPS);
        let predicted = predicted.map(|(frame, error)| PendingFrame {
            pixels: sampled(frame),
            expected: middle(error),
        });
        self.pending.push_front(predicted.collect());
        // Those of which every frame has arrived.
        while self
            .pending
            .back()
            .is_some_and(|oldest| oldest.len() < self.pending.len())
        {
            self.pending.pop_back();
        }
    }

    /// There is a gap before the next frame: what was predicted of it is another frame.
    pub(super) fn skip(&mut self) {
        self.pending.clear();
    }

    /// Without the predictions whose errors are still to come.
    pub(super) fn so_far(&self) -> Self {
        Self {
            of_steps: self.of_steps.clone(),
            pending: VecDeque::new(),
        }
    }

    /// Expected errors as the past ones make them.
    pub(super) fn scaled(&self, errors: Vec<ExpectedError>) -> Vec<ExpectedError> {
        let scaled = errors.into_iter().zip(self.scales());
        scaled.map(|(error, scale)| error.times(scale)).collect()
    }

    /// By what the expected errors of each step are multiplied. A step of which little is known goes by the step before it, the first
    /// one by the calibration.
    fn scales(&self) -> impl Iterator<Item = f32> {
        let known = self.of_steps.iter().copied();
        known
            .chain(std::iter::repeat(PastError::default()))
            .scan(0.0, |mean, past| {
                *mean = past.mean(*mean);
                Some(mean.exp())
            })
    }
}

/// The middle of a band, as factors count.
fn middle(error: &ExpectedError) -> f32 {
    (error.low.max(LEAST_MSE) * error.high.max(LEAST_MSE)).sqrt()
}

fn sampled(frame: &Frame) -> Vec<u8> {
    let (width, height) = (frame.width() as usize, frame.height() as usize);
    let mut sampled = Vec::with_capacity((width / STRIDE + 1) * (height / STRIDE + 1));
    for row in frame.pixels().chunks_exact(width).skip(STRIDE / 2).step_by(STRIDE) {
        let (groups, rest) = row.as_chunks::<STRIDE>();
        sampled.extend(groups.iter().map(|group| group[STRIDE / 2]));
        sampled.extend(rest.get(STRIDE / 2));
    }
    sampled
}

fn mean_squared_difference(a: &[u8], b: &[u8]) -> f32 {
    let sum = vectorized(
        #[inline(always)]
        || squared_difference_of_bytes(a, b),
    );
    sum as f32 / (255.0 * 255.0 * a.len().max(1) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(pixel: u8) -> Frame {
        Frame::new(8, 8, vec![pixel; 64]).unwrap()
    }

    const CALIBRATED: ExpectedError = ExpectedError {
        mse: 0.012,
        low: 0.005,
        high: 0.02,
    };

    /// Of two steps.
    fn expected(past: &PastErrors) -> Vec<ExpectedError> {
        past.scaled(vec![CALIBRATED; 2])
    }

    /// After so many frames, of which each was predicted 51 gray levels (an MSE of 0.04) too dark.
    fn after(frames: usize) -> PastErrors {
        after_frames_of(frames, 102)
    }

    /// After so many frames of one gray, where 51 was predicted.
    fn after_frames_of(frames: usize, pixel: u8) -> PastErrors {
        let mut past = PastErrors::default();
        for _ in 0..frames {
            past.observe(&frame(pixel));
            past.keep(&[frame(51), frame(51)], &[CALIBRATED; 2]);
        }
        past
    }

    #[test]
    fn expected_errors_become_those_that_were_made() {
        assert_eq!(expected(&after(1))[0].mse, 0.012);
        for error in expected(&after(60)) {
            // The middle of the band comes near 0.04, from 0.01.
            assert!((0.033..0.041).contains(&middle(&error)), "{error:?}");
            assert!((error.mse / error.low - 0.012 / 0.005).abs() < 1e-3);
        }
        // The second step goes by the first one as long as nothing is known of it.
        let [first, second] = expected(&after(2))[..] else {
            panic!("two steps")
        };
        assert_eq!(first, second);
        assert!(first.mse > 0.02);
    }

    #[test]
    fn what_was_predicted_before_a_gap_is_no_error() {
        let mut past = after(5);
        let before = past.so_far();
        past.skip();
        past.observe(&frame(255));
        assert_eq!(past.so_far(), before);
        // A frame without a prediction keeps the places of the others.
        let mut past = after(5);
        past.observe(&frame(102));
        past.keep(&[], &[]);
        past.observe(&frame(51));
        assert_eq!(past.of_steps[0].weight, after(5).of_steps[0].weight * FADING + 1.0);
        assert!(past.of_steps[1].log_sum < after(6).of_steps[1].log_sum);
    }

    #[test]
    fn a_frame_without_a_prediction_does_not_hide_the_ones_before_it() {
        let mut past = PastErrors::default();
        for _ in 0..10 {
            past.observe(&frame(102));
            past.keep(&[frame(51), frame(51)], &[CALIBRATED; 2]);
            past.observe(&frame(102));
            past.keep(&[], &[]);
        }
        assert_eq!(past.numbers().len(), 2);
        assert_eq!(past.pending.len(), 2);
    }

    #[test]
    fn a_camera_that_hangs_does_not_close_the_bands() {
        assert!(
            expected(&after_frames_of(200, 51))
                .iter()
                .all(|error| error.mse > 0.012 * 0.13)
        );
    }

    #[test]
    fn impossible_numbers_are_not_restored() {
        let past = after(200);
        assert_eq!(PastErrors::restored(&past.numbers(), 2), Ok(past.so_far()));
        assert_eq!(PastErrors::restored(&past.numbers(), 1), Err(1));
        for numbers in [[0.0, -1.0], [0.0, 11.0], [8.0, 1.0], [f32::NAN, 1.0], [0.0, f32::NAN]] {
            assert_eq!(PastErrors::restored(&[[0.0; 2], numbers], 2), Err(1), "{numbers:?}");
        }
    }
}
