//! The simple predictors that a model must beat.

mod affine_flow;
mod commanded_motion;
mod cut_out;
mod ego_motion;
mod geometry;
mod input;
mod nearest;

use self::affine_flow::AffineFlow;
use self::cut_out::CutOut;
use self::ego_motion::CameraTurn;
use self::geometry::{Geometry, WallDistance};
pub(super) use self::input::BaselineInput;
use self::input::mean;
use self::nearest::{NearestWindows, WindowSets};
use super::EvaluationError;
use super::method::Method;
use super::report::NearestSummary;
use foreframe_data::dataset::sampler::{Split, Splits, WindowShape};
use foreframe_data::dataset::{Dataset, DatasetError};
use foreframe_data::motion::{Shift, phase_correlation, shifted};

/// How the camera's motion follows from the actions.
enum EgoMotion {
    Turn(CameraTurn),
    Flow(AffineFlow),
}

/// The baselines with what they learn from the training split.
pub(super) struct Baselines {
    methods: Vec<Method>,
    width: usize,
    training_mean: Vec<f32>,
    ego_motion: Option<EgoMotion>,
    geometry: Option<Geometry>,
    cut_out: CutOut,
    nearest: Option<NearestWindows>,
}

impl Baselines {
    /// Fits the baselines to the training split. Where the data set has no actions there is no ego-motion, where no training
    /// window of that shape exists, or none may be `searched`, there are no nearest ones, and where the camera's height or the
    /// commanded speeds are not known there is no geometry. Ego-motion, geometry and cut-out look only at a limited number of
    /// windows or frames, the nearest windows are among at most `searched`, all evenly spread. The validation split serves to
    /// weigh the nearest windows, unless it is `known` how. Errors: those of [`Splits::windows`] and [`Dataset::pixels`].
    pub(super) fn fit(
        dataset: &Dataset,
        splits: &Splits,
        shape: WindowShape,
        searched: usize,
        known: Option<NearestSummary>,
    ) -> Result<Self, EvaluationError> {
        // None where no window of that shape fits.
        let windows_of = |split, shape| match splits.windows(dataset, split, shape, 1) {
            Err(DatasetError::WindowTooLong { .. }) => Ok(Vec::new()),
            windows => windows,
        };
        let ego_motion = match CameraTurn::of(dataset) {
            Some(turn) => Some(EgoMotion::Turn(turn)),
            None => AffineFlow::fit(dataset, &windows_of(Split::Train, affine_flow::SHAPE)?)?.map(EgoMotion::Flow),
        };
        let training = windows_of(Split::Train, shape)?;
        let geometry = Geometry::fit(dataset, &training, shape)?;
        let sets = WindowSets {
            training: &training,
            validation: &windows_of(Split::Validation, shape)?,
            shape,
            searched,
            known,
        };
        let nearest = NearestWindows::fit(dataset, &sets)?;
        // Every frame that has a successor in the split.
        let pair = WindowShape { context: 1, horizon: 1 };
        let pairs = splits.windows(dataset, Split::Train, pair, 1)?;
        let frames: Vec<usize> = pairs.iter().map(|pair| pair.first_frame).collect();
        let methods = Method::ALL.into_iter().filter(|method| match method {
            Method::EgoMotion => ego_motion.is_some(),
            Method::GroundAndWall => geometry.is_some(),
            Method::PlaneSweep => geometry.as_ref().is_some_and(Geometry::can_sweep),
            Method::NearestWindows => nearest.is_some(),
            Method::Black => false,
            _ => true,
        });
        Ok(Self {
            methods: methods.collect(),
            width: dataset.info().frame_width_px as usize,
            training_mean: mean_frame(dataset, &frames)?,
            cut_out: CutOut::fit(dataset, &frames)?,
            ego_motion,
            geometry,
            nearest,
        })
    }

    /// The same without one of the rows.
    pub(super) fn without(mut self, method: Method) -> Self {
        self.methods.retain(|&other| other != method);
        self
    }

    /// The same with what a benchmark of mostly black frames adds: the black frame, and the scores that its papers print.
    pub(super) fn for_benchmark(mut self) -> Self {
        let codec = self.methods.iter().position(|&method| method == Method::CodecOnly);
        self.methods.insert(codec.unwrap_or(self.methods.len()), Method::Black);
        self
    }

    /// Whether the scores of published benchmarks are computed too.
    pub(super) fn are_of_benchmark(&self) -> bool {
        self.methods.contains(&Method::Black)
    }

    /// The rows of the tables: the model, the baselines that apply to this data set, the codec.
    pub(super) fn methods(&self) -> &[Method] {
        &self.methods
    }

    /// Whether a baseline learned what the place or the car of this data set is like, from its training split. One number, the
    /// distance of the wall for the two baselines with a floor and a wall, does not count.
    pub(super) fn knows_dataset(&self, method: Method) -> bool {
        match method {
            Method::MeanTrainingFrame | Method::MovingCutOut | Method::NearestWindows => true,
            Method::EgoMotion => matches!(self.ego_motion, Some(EgoMotion::Flow(_))),
            _ => false,
        }
    }

    /// What the nearest windows are searched among, if that baseline applies.
    pub(super) fn nearest_summary(&self) -> Option<NearestSummary> {
        self.nearest.as_ref().map(NearestWindows::summary)
    }

    /// The frames 1…`horizon` steps ahead as a baseline predicts them; none for a method that is no baseline or that does
    /// not apply to the data set. Errors: those of [`Dataset::pixels`].
    pub(super) fn predict(
        &self,
        dataset: &Dataset,
        method: Method,
        input: &BaselineInput,
        horizon: usize,
    ) -> Result<Vec<Vec<f32>>, EvaluationError> {
        let Some(last) = input.inputs.last() else {
            return Ok(Vec::new());
        };
        Ok(match method {
            Method::CopyLast => vec![last.clone(); horizon],
            Method::MeanOfInputs => vec![mean(input.inputs); horizon],
            Method::MeanTrainingFrame => vec![self.training_mean.clone(); horizon],
            Method::LinearExtrapolation => extrapolate(input.inputs, horizon),
            Method::ConstantShift => move_on(input.inputs, self.width, horizon),
            Method::EgoMotion => match &self.ego_motion {
                Some(EgoMotion::Turn(turn)) => turn.predict(input, last),
                Some(EgoMotion::Flow(flow)) => flow.predict(input, last),
                None => Vec::new(),
            },
            Method::GroundAndWall => self.warped(input, last, WallDistance::Fitted),
            Method::PlaneSweep => self.warped(input, last, WallDistance::Swept),
            Method::MovingCutOut => self.cut_out.predict(input.inputs, horizon),
            Method::NearestWindows => match &self.nearest {
                Some(windows) => windows.predict(dataset, input, horizon)?,
                None => Vec::new(),
            },
            Method::Black => vec![vec![0.0; last.len()]; horizon],
            Method::Model | Method::CodecOnly => Vec::new(),
        })
    }

    fn warped(&self, input: &BaselineInput, last: &[f32], wall: WallDistance) -> Vec<Vec<f32>> {
        let geometry = self.geometry.as_ref();
        geometry.map_or_else(Vec::new, |geometry| geometry.predict(input, last, wall))
    }
}

/// With times centred on their mean, a pixel's slope is Σ time · value / Σ time².
fn extrapolate(frames: &[Vec<f32>], horizon: usize) -> Vec<Vec<f32>> {
    let mean = mean(frames);
    let centre = (frames.len() - 1) as f32 / 2.0;
    let spread: f32 = (0..frames.len()).map(|i| (i as f32 - centre).powi(2)).sum();
    let mut slope = vec![0.0; mean.len()];
    if spread > 0.0 {
        for (i, frame) in frames.iter().enumerate() {
            let weight = (i as f32 - centre) / spread;
            for (slope, value) in slope.iter_mut().zip(frame) {
                *slope += weight * value;
            }
        }
    }
    let at = |step: usize| {
        let ahead = centre + step as f32;
        let pixels = mean.iter().zip(&slope);
        pixels
            .map(|(mean, slope)| (mean + slope * ahead).clamp(0.0, 1.0))
            .collect()
    };
    (1..=horizon).map(at).collect()
}

fn move_on(inputs: &[Vec<f32>], width: usize, horizon: usize) -> Vec<Vec<f32>> {
    let [.., before, last] = inputs else {
        return vec![inputs.last().cloned().unwrap_or_default(); horizon];
    };
    let Shift { x_px, y_px } = phase_correlation(before, last, width);
    let after = |step: usize| Shift {
        x_px: x_px * step as f32,
        y_px: y_px * step as f32,
    };
    (1..=horizon).map(|step| shifted(last, width, after(step))).collect()
}

/// The mean of these frames, 0…1. Errors: those of [`Dataset::pixels`].
fn mean_frame(dataset: &Dataset, frames: &[usize]) -> Result<Vec<f32>, EvaluationError> {
    let mut sums = vec![0_u64; dataset.info().frame_pixels()];
    for &frame in frames {
        for (sum, &value) in sums.iter_mut().zip(&*dataset.pixels(frame)?) {
            *sum += u64::from(value);
        }
    }
    let scale = 1.0 / (255.0 * frames.len().max(1) as f64);
    Ok(sums.into_iter().map(|sum| (sum as f64 * scale) as f32).collect())
}

#[cfg(test)]
mod tests {
    use rand::Rng;

    use super::*;
    use crate::evaluation::windows::true_frame;
    use foreframe_core::frame::quality::mse;
    use foreframe_core::types::{Channel, Seed};
    use foreframe_data::dataset::{DatasetInfo, EpisodeData, Window};

    const SIDE: usize = 16;

    /// A data set of one-channel recordings in which every frame is given by time.
    fn recordings(
        side: usize,
        frame: impl Fn(usize, usize) -> Vec<f32>,
        action: impl Fn(usize, usize) -> f32,
    ) -> Dataset {
        let (episodes, frames) = (20, 12);
        let data = (0..episodes).map(|episode| EpisodeData {
            timestamps_s: (0..frames).map(|time| time as f64 * 0.2).collect(),
            pixels: (0..frames)
                .flat_map(|time| frame(episode, time))
                .map(|value| (value * 255.0).round() as u8)
                .collect(),
            actions: (0..frames).map(|time| action(episode, time)).collect(),
            ..EpisodeData::default()
        });
        let info = DatasetInfo {
            name: "made-up".to_owned(),
            frame_width_px: side as u32,
            frame_height_px: side as u32,
            frame_period_s: 0.2,
            action_channels: vec![Channel::new("pan", "px")],
            ..DatasetInfo::default()
        };
        Dataset::from_episodes(info, data.collect()).unwrap()
    }

    const SHAPE: WindowShape = WindowShape { context: 5, horizon: 3 };

    fn fitted(dataset: &Dataset, searched: usize) -> (Baselines, Splits) {
        let splits = Splits::new(dataset, Seed(1));
        (Baselines::fit(dataset, &splits, SHAPE, searched, None).unwrap(), splits)
    }

    fn error_of(method: Method, dataset: &Dataset) -> f64 {
        error_among(usize::MAX, method, dataset)
    }

    /// Mean error of a method over the test windows, where the nearest windows are among `searched`.
    fn error_among(searched: usize, method: Method, dataset: &Dataset) -> f64 {
        let (baselines, splits) = fitted(dataset, searched);
        let windows = splits.windows(dataset, Split::Test, SHAPE, 1).unwrap();
        let errors = windows.iter().flat_map(|&window| {
            let frame = |step: usize| true_frame(dataset, window.first_frame + step).unwrap();
            let inputs: Vec<Vec<f32>> = (0..SHAPE.context).map(frame).collect();
            let input = BaselineInput::of_window(dataset, window, SHAPE, &inputs);
            let predicted = baselines.predict(dataset, method, &input, SHAPE.horizon).unwrap();
            assert_eq!(predicted.len(), SHAPE.horizon, "{method:?}");
            let errors: Vec<f64> = predicted
                .iter()
                .enumerate()
                .map(|(step, predicted)| mse(predicted, &frame(SHAPE.context + step)))
                .collect();
            errors
        });
        let errors: Vec<f64> = errors.collect();
        errors.iter().sum::<f64>() / errors.len() as f64
    }

    fn still_scene() -> Vec<f32> {
        (0..SIDE * SIDE).map(|i| (i * 37 % 101) as f32 / 101.0).collect()
    }

    #[test]
    fn a_line_is_continued_exactly() {
        let inputs: Vec<Vec<f32>> = (0..5)
            .map(|t| vec![0.1 + 0.05 * t as f32, 0.9 - 0.1 * t as f32, 0.4])
            .collect();
        for (step, frame) in extrapolate(&inputs, 5).iter().enumerate() {
            let time = (5 + step) as f32;
            assert!((frame[0] - (0.1 + 0.05 * time)).abs() < 1e-6);
            assert!((frame[1] - (0.9 - 0.1 * time).max(0.0)).abs() < 1e-6);
            assert!((frame[2] - 0.4).abs() < 1e-6);
        }
    }

    #[test]
    fn every_baseline_is_right_on_a_still_scene() {
        let dataset = recordings(SIDE, |_, _| still_scene(), |_, _| 0.0);
        for method in fitted(&dataset, usize::MAX)
            .0
            .methods()
            .iter()
            .filter(|method| method.is_baseline())
        {
            let error = error_of(*method, &dataset);
            assert!(error < 1e-6, "{method:?} {error}");
        }
    }

    #[test]
    fn a_panning_scene_is_moved_on() {
        let mut rng = Seed(2).rng();
        let texture: Vec<f32> = (0..96 * 64).map(|_| rng.random()).collect();
        let at = |time: usize| -> Vec<f32> {
            (0..64 * 64)
                .map(|i| texture[i / 64 * 96 + 32 - 2 * time + i % 64])
                .collect()
        };
        let inputs: Vec<Vec<f32>> = (0..5).map(at).collect();
        let moved = move_on(&inputs, 64, 2);
        for (step, moved) in moved.iter().enumerate() {
            let truth = at(5 + step);
            assert!(mse(moved, &truth) < 0.3 * mse(&inputs[4], &truth));
        }
    }

    #[test]
    fn one_input_is_enough() {
        let dataset = recordings(SIDE, |_, _| still_scene(), |_, _| 0.0);
        let shape = WindowShape { context: 1, horizon: 1 };
        let splits = Splits::new(&dataset, Seed(1));
        let baselines = Baselines::fit(&dataset, &splits, shape, usize::MAX, None).unwrap();
        let inputs = [true_frame(&dataset, 0).unwrap()];
        let window = Window {
            episode: 0,
            first_frame: 0,
        };
        let input = BaselineInput::of_window(&dataset, window, shape, &inputs);
        for method in baselines.methods().iter().filter(|method| method.is_baseline()) {
            let predicted = baselines.predict(&dataset, *method, &input, 1).unwrap();
            assert!(mse(&predicted[0], &inputs[0]) < 1e-6, "{method:?}");
        }
    }

    /// A smooth texture that moves by as many pixels a frame as the action says.
    #[test]
    fn without_a_camera_model_the_flow_is_learned_from_the_actions() {
        let pan = |episode: usize, time: usize| [-1.5, 2.0, 0.5, -0.5][(episode + time / 3) % 4];
        let offset = |episode: usize, time: usize| -> f32 { (0..time).map(|t| pan(episode, t)).sum() };
        let frame = |episode: usize, time: usize| -> Vec<f32> {
            let at = |i: usize| {
                let x = (i % 32) as f32 + offset(episode, time) + 11.0 * episode as f32;
                let y = (i / 32) as f32;
                0.5 + 0.25 * (x * 0.55).sin() + 0.2 * (y * 0.4 + x * 0.21).cos()
            };
            (0..32 * 32).map(at).collect()
        };
        let dataset = recordings(32, frame, pan);
        let (warped, copied) = (
            error_of(Method::EgoMotion, &dataset),
            error_of(Method::CopyLast, &dataset),
        );
        assert!(warped < 0.3 * copied, "{warped} {copied}");
    }

    #[test]
    fn a_moving_square_is_cut_out_and_moved_on() {
        let frame = |episode: usize, time: usize| -> Vec<f32> {
            let top = episode % 4 * 3;
            let inside = |i: usize| (time..time + 4).contains(&(i % SIDE)) && (top..top + 4).contains(&(i / SIDE));
            (0..SIDE * SIDE)
                .map(|i| if inside(i) { 0.1 } else { 0.6 + 0.01 * (i % 7) as f32 })
                .collect()
        };
        let dataset = recordings(SIDE, frame, |_, _| 0.0);
        let (moved, copied) = (
            error_of(Method::MovingCutOut, &dataset),
            error_of(Method::CopyLast, &dataset),
        );
        assert!(moved < 0.1 * copied, "{moved} {copied}");
    }

    #[test]
    fn a_window_seen_in_training_is_found_again() {
        let frame = |episode: usize, time: usize| -> Vec<f32> {
            let mut rng = Seed((episode % 2 * 100 + time) as u64).rng();
            (0..SIDE * SIDE).map(|_| rng.random()).collect()
        };
        let dataset = recordings(SIDE, frame, |_, _| 0.0);
        assert!(error_of(Method::NearestWindows, &dataset) < 1e-6);
        let summary = fitted(&dataset, usize::MAX).0.nearest_summary().unwrap();
        assert_eq!(summary.searched, summary.available);
        assert!(error_among(1, Method::NearestWindows, &dataset) > 0.1);
        let summary = fitted(&dataset, 1).0.nearest_summary().unwrap();
        assert!(summary.searched == 1 && summary.available > 1);
        assert!(error_of(Method::CopyLast, &dataset) > 0.1);
    }
}
