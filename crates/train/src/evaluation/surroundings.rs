//! How well a model tells what stands around the robot: where movers are and will be, and how far away things are.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::EvaluationError;
use super::inference::Inference;
use super::metrics::StepCurve;
use super::progress::{EvaluationContext, EvaluationStage, Pass};
use super::replay::{has_size_of, replayed};
use super::windows::evenly;
use foreframe_data::dataset::Window;

/// Contexts at most whose depth is compared, evenly spread over the windows.
const MAX_DEPTH_CONTEXTS: usize = 60;
/// Contexts whose depth is compared together.
const DEPTH_BATCH: usize = 8;
/// A mover with at least this many pixels in the last frame is visible there.
const VISIBLE_PIXELS: usize = 8;

/// What a model tells of the surroundings, against the truth of the simulator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SurroundingsScores {
    /// Where movers are and will be; absent for a model that does not find movers, and without masks.
    pub movers: Option<MoverScores>,
    /// How far away things are; absent where the simulator cannot tell.
    pub depth: Option<DepthScores>,
}

/// The masks of movers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MoverScores {
    /// In the last frame.
    pub now: MaskScore,
    /// Recall of the pixels of movers at each step.
    pub recall: StepCurve,
    /// The same, only of movers that the last frame shows.
    pub recall_of_visible: StepCurve,
    /// Pixels that are predicted and true over those that are one of both, at each step.
    pub iou: StepCurve,
}

/// The score of the masks of one step.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MaskScore {
    /// Share of the true pixels that are found.
    pub recall: f64,
    /// Pixels that are found and true over those that are one of both.
    pub iou: f64,
}

/// The depth of what the last frame shows, but for movers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthScores {
    /// Frames that were compared.
    pub frames: usize,
    /// Median over all pixels of |depth − truth| / truth.
    pub median_relative_error: f64,
    /// The same before anything is learned: a wall around the camera, and the floor.
    pub before_learning: f64,
}

/// Pixels of one step's masks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
struct MaskCounts {
    found: usize,
    truth: usize,
    both: usize,
    visible: usize,
    visible_found: usize,
}

impl MaskCounts {
    /// `seen`: for each robot's id, whether it is visible in the last frame.
    fn add(&mut self, logits: &[f32], mask: &[u8], seen: &[bool; 256]) {
        for (&logit, &robot) in logits.iter().zip(mask) {
            let (is_found, is_true) = (logit > 0.0, robot != 0);
            self.found += usize::from(is_found);
            self.truth += usize::from(is_true);
            self.both += usize::from(is_found && is_true);
            let is_visible = is_true && seen[usize::from(robot)];
            self.visible += usize::from(is_visible);
            self.visible_found += usize::from(is_visible && is_found);
        }
    }

    fn join(&mut self, other: Self) {
        self.found += other.found;
        self.truth += other.truth;
        self.both += other.both;
        self.visible += other.visible;
        self.visible_found += other.visible_found;
    }

    fn score(self) -> MaskScore {
        MaskScore {
            recall: ratio(self.both, self.truth),
            iou: ratio(self.both, self.found + self.truth - self.both),
        }
    }
}

/// 1 where there is nothing to find.
fn ratio(part: usize, whole: usize) -> f64 {
    if whole == 0 { 1.0 } else { part as f64 / whole as f64 }
}

/// What [`measure`] finds, window by window.
#[derive(Clone, Debug)]
pub(super) struct SurroundingsMeasurements {
    /// For each batch of windows the pixels of each step; `None` without masks.
    movers: Vec<Option<Vec<MaskCounts>>>,
    /// For each context the relative errors of all pixels, as estimated and before anything is learned; `None` where the
    /// simulator cannot tell.
    depths: Vec<Option<[Vec<f64>; 2]>>,
}

/// Measures a model on these windows; `None` if it tells nothing of the surroundings. Errors: those of the network and the
/// simulator, `Cancelled`.
pub(super) fn measure(
    evaluation: &EvaluationContext,
    windows: &[Window],
) -> Result<Option<SurroundingsMeasurements>, EvaluationError> {
    let flow = evaluation.inference.spec().flow();
    if !flow.is_some_and(|flow| flow.layers.depth) {
        return Ok(None);
    }
    Ok(Some(SurroundingsMeasurements {
        movers: movers(evaluation, windows)?,
        depths: depths(evaluation, windows)?,
    }))
}

impl SurroundingsMeasurements {
    /// The scores of all windows.
    pub(super) fn scores(self) -> SurroundingsScores {
        SurroundingsScores {
            movers: mover_scores(self.movers),
            depth: depth_scores(self.depths),
        }
    }
}

/// Nothing for a model that does not find movers.
fn movers(evaluation: &EvaluationContext, windows: &[Window]) -> Result<Vec<Option<Vec<MaskCounts>>>, EvaluationError> {
    let (inference, spec) = (evaluation.inference, evaluation.inference.spec());
    let info = inference.dataset.info();
    let finds_movers = spec.flow().is_some_and(|flow| flow.layers.movers);
    if !finds_movers || !info.has_masks || !has_size_of(info, spec) {
        return Ok(Vec::new());
    }
    let pass = evaluation.pass(EvaluationStage::Surroundings);
    evaluation.in_divided_batches(pass, windows, |batch| Ok(vec![count_masks(inference, batch)?]))
}

/// The pixels of each step's masks, over all windows of a batch.
fn count_masks(inference: Inference, batch: &[Window]) -> Result<Option<Vec<MaskCounts>>, EvaluationError> {
    let (spec, pixels) = (inference.spec(), inference.spec().pixels());
    let mut counts = vec![MaskCounts::default(); 1 + spec.horizon];
    let Some(logits) = inference.movers(batch)? else {
        return Ok(None);
    };
    for (window, logits) in batch.iter().zip(logits.chunks_exact(counts.len() * pixels)) {
        let last = window.first_frame + spec.context - 1;
        let mut seen = [false; 256];
        for (step, (counts, logits)) in counts.iter_mut().zip(logits.chunks_exact(pixels)).enumerate() {
            let Some(mask) = inference.dataset.mask(last + step)? else {
                return Ok(None);
            };
            if step == 0 {
                seen = visible(&mask);
            }
            counts.add(logits, &mask, &seen);
        }
    }
    Ok(Some(counts))
}

fn mover_scores(batches: Vec<Option<Vec<MaskCounts>>>) -> Option<MoverScores> {
    let batches = batches.into_iter().collect::<Option<Vec<_>>>()?;
    let mut counts = vec![MaskCounts::default(); batches.first()?.len()];
    for batch in batches {
        for (sum, counts) in counts.iter_mut().zip(batch) {
            sum.join(counts);
        }
    }
    let curve = |of: fn(MaskCounts) -> f64| StepCurve::new(counts.iter().skip(1).map(|&counts| of(counts)).collect());
    Some(MoverScores {
        now: counts[0].score(),
        recall: curve(|counts| counts.score().recall),
        recall_of_visible: curve(|counts| ratio(counts.visible_found, counts.visible)),
        iou: curve(|counts| counts.score().iou),
    })
}

/// For each robot's id, whether a mask shows it.
fn visible(mask: &[u8]) -> [bool; 256] {
    let mut pixels = [0; 256];
    for &robot in mask {
        pixels[usize::from(robot)] += 1;
    }
    pixels.map(|count| count >= VISIBLE_PIXELS)
}

/// Nothing where the simulator cannot tell.
fn depths(evaluation: &EvaluationContext, windows: &[Window]) -> Result<Vec<Option<[Vec<f64>; 2]>>, EvaluationError> {
    let inference = evaluation.inference;
    let (dataset, spec) = (inference.dataset, inference.spec());
    let is_same_size = has_size_of(dataset.info(), spec);
    let Some(world) = dataset.info().world.as_ref().filter(|_| is_same_size) else {
        return Ok(Vec::new());
    };
    let errors = |&window: &Window| -> Result<_, EvaluationError> {
        let Some(replay) = replayed(inference, world, window)? else {
            return Ok(None);
        };
        let Some([estimated, before]) = inference.depths(window)? else {
            return Ok(None);
        };
        let (truth, mask) = (replay.depths(), replay.observe().mask);
        let relative = |estimated: &[f32]| -> Vec<f64> {
            let pixels = estimated
                .iter()
                .zip(&truth)
                .zip(&mask)
                .filter(|(_, robot)| **robot == 0);
            pixels
                .map(|((estimated, truth), _)| f64::from((estimated - truth).abs() / truth))
                .collect()
        };
        Ok(Some([relative(&estimated), relative(&before)]))
    };
    let pass = Pass {
        batch: DEPTH_BATCH,
        ..evaluation.pass(EvaluationStage::Depth)
    };
    evaluation.in_divided_batches(pass, &evenly(windows, MAX_DEPTH_CONTEXTS), |batch| {
        batch.par_iter().map(errors).collect()
    })
}

fn depth_scores(errors: Vec<Option<[Vec<f64>; 2]>>) -> Option<DepthScores> {
    let errors = errors.into_iter().collect::<Option<Vec<_>>>()?;
    let median = |which: usize| {
        let mut all: Vec<f64> = errors.iter().flat_map(|errors| &errors[which]).copied().collect();
        all.sort_by(f64::total_cmp);
        all.get(all.len() / 2).copied().unwrap_or(f64::NAN)
    };
    (!errors.is_empty()).then(|| DepthScores {
        frames: errors.len(),
        median_relative_error: median(0),
        before_learning: median(1),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_counted_by_pixels() {
        let mut mask = vec![0, 0, 0, 0, 2, 2];
        mask.extend([1; 8]);
        let seen = visible(&mask);
        assert!(seen[1] && !seen[2]);
        let mut logits = vec![1.0, -1.0, -1.0, -1.0, 1.0, -1.0];
        logits.extend([1.0; 6]);
        logits.extend([-1.0; 2]);
        let mut counts = MaskCounts::default();
        counts.add(&logits, &mask, &seen);
        assert_eq!((counts.found, counts.truth, counts.both), (8, 10, 7));
        assert_eq!((counts.visible, counts.visible_found), (8, 6));
        let MaskScore { recall, iou } = counts.score();
        assert!((recall - 0.7).abs() < 1e-12 && (iou - 7.0 / 11.0).abs() < 1e-12);
        assert_eq!(MaskCounts::default().score(), MaskScore { recall: 1.0, iou: 1.0 });
    }
}
