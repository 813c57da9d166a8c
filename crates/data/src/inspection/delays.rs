//! The delay between each component of the action and the image's motion, by cross-correlation.
//!
//! Motion t is what the image does from frame t to frame t + 1: how far it moves to the right and down (phase correlation),
//! and how much it changes. For each lag d, the correlation of action t with motion t + d is computed over all episodes. The
//! delay is the lag of the greatest correlation, to a fraction of a frame.

use rayon::prelude::*;
use serde::Serialize;

use super::places::{FramePlace, places};
use crate::dataset::{Dataset, DatasetError};
use crate::motion::phase_correlation;
use foreframe_core::types::Channel;

/// The longest delay that is looked for, in seconds and in frames.
const MAX_DELAY_S: f64 = 2.0;
const FRAMES_LOOKED_AT: std::ops::RangeInclusive<i64> = 4..=20;
/// A weaker correlation says nothing.
const LEAST_CORRELATION: f64 = 0.25;
/// Signals without anything in common still correlate by chance: about this divided by the square root of the number of frames.
const CHANCE_CORRELATION: f64 = 6.0;
/// Delays from here on are worth a warning, in frames…
const LONG_DELAY_FRAMES: f64 = 1.0;
/// … if the correlation is greater by this than without delay.
const CLEAR_DIFFERENCE: f64 = 0.05;
/// A direction says more than the amount of change, so it may correlate a little less and is still taken.
const DIRECTION_SHARE: f64 = 0.75;
/// Motion beyond this many times the 90th percentile is a failure of phase correlation.
const OUTLIER_FACTOR: f64 = 3.0;

/// What the image does from one frame to the next.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum MotionSignal {
    /// The image moves sideways; to the right is positive.
    Sideways,
    /// The image moves up or down; down is positive.
    Vertical,
    /// The mean absolute difference of the gray levels.
    Change,
}

impl std::fmt::Display for MotionSignal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Sideways => "sideways motion",
            Self::Vertical => "vertical motion",
            Self::Change => "amount of change",
        })
    }
}

/// How the image's motion follows one component of the action.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ActionDelay {
    /// The component's name.
    pub action: String,
    /// The motion that follows it most.
    pub motion: MotionSignal,
    /// The lag of the greatest correlation in frames; positive: the image follows the action. None where the motion
    /// follows it too little to say.
    pub delay_frames: Option<f64>,
    /// The correlation at that lag, -1 to 1.
    pub correlation: f64,
    /// The correlation without a lag.
    pub correlation_without_lag: f64,
    /// Every lag.
    pub lags: Vec<LagCorrelation>,
}

/// The correlation at one lag.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LagCorrelation {
    /// Frames by which the motion follows the action.
    pub lag_frames: i64,
    /// -1 to 1.
    pub correlation: f64,
}

pub(super) fn of(dataset: &Dataset) -> Result<Vec<ActionDelay>, DatasetError> {
    let info = dataset.info();
    if info.action_channels.is_empty() {
        return Ok(Vec::new());
    }
    let signals = motion(dataset)?;
    let least = LEAST_CORRELATION.max(CHANCE_CORRELATION / (info.frame_count as f64).sqrt());
    let most = (MAX_DELAY_S / info.frame_period_s).round() as i64;
    let most = most.clamp(*FRAMES_LOOKED_AT.start(), *FRAMES_LOOKED_AT.end());
    let strongest = |(component, channel): (usize, &Channel)| {
        let candidates = signals.iter().map(|(signal, values)| {
            let lags = (-most..=most).map(|lag_frames| LagCorrelation {
                lag_frames,
                correlation: correlation(dataset, component, values, lag_frames),
            });
            delay(&channel.name, *signal, lags.collect())
        });
        let mut strongest = candidates.max_by(|a, b| a.weight().total_cmp(&b.weight()))?;
        strongest.delay_frames = strongest.delay_frames.filter(|_| strongest.correlation.abs() >= least);
        Some(strongest)
    };
    Ok(info.action_channels.iter().enumerate().filter_map(strongest).collect())
}

/// The motion from every frame to the next; the last frame of an episode has none.
fn motion(dataset: &Dataset) -> Result<[(MotionSignal, Vec<f64>); 3], DatasetError> {
    let width = dataset.info().frame_width_px as usize;
    let places: Vec<FramePlace> = places(dataset).collect();
    let is_last = |frame: usize| places.get(frame + 1).is_none_or(|next| next.frame == 0);
    let between = (0..places.len())
        .into_par_iter()
        .map(|frame| {
            if is_last(frame) {
                return Ok([0.0; 3]);
            }
            let floats = |frame| -> Result<Vec<f32>, DatasetError> {
                Ok(dataset.pixels(frame)?.iter().map(|&pixel| f32::from(pixel)).collect())
            };
            let (before, after) = (floats(frame)?, floats(frame + 1)?);
            let shift = phase_correlation(&before, &after, width);
            let change: f32 = before.iter().zip(&after).map(|(a, b)| (a - b).abs()).sum();
            let change = f64::from(change) / before.len() as f64;
            Ok([f64::from(shift.x_px), f64::from(shift.y_px), change])
        })
        .collect::<Result<Vec<[f64; 3]>, DatasetError>>()?;
    let part = |part: usize| between.iter().map(|motion| motion[part]).collect();
    Ok([
        (MotionSignal::Sideways, without_outliers(part(0))),
        (MotionSignal::Vertical, without_outliers(part(1))),
        (MotionSignal::Change, part(2)),
    ])
}

/// The values, limited to a few times the size that nine of ten do not exceed.
fn without_outliers(values: Vec<f64>) -> Vec<f64> {
    let mut sizes: Vec<f64> = values.iter().map(|value| value.abs()).collect();
    if sizes.is_empty() {
        return values;
    }
    let place = sizes.len() * 9 / 10;
    let limit = OUTLIER_FACTOR * *sizes.select_nth_unstable_by(place, f64::total_cmp).1;
    values.into_iter().map(|value| value.clamp(-limit, limit)).collect()
}

/// Pearson's correlation of action t with motion t + `lag`, over all episodes; 0 if one of them does not vary.
fn correlation(dataset: &Dataset, component: usize, motion: &[f64], lag: i64) -> f64 {
    let (mut count, mut sums) = (0.0, [0.0; 5]);
    for episode in dataset.episodes() {
        // The last frame has an action, but no motion follows it.
        let frames = episode.first_frame as i64..(episode.first_frame + episode.frame_count) as i64 - 1;
        for frame in frames.clone().filter(|frame| frames.contains(&(frame + lag))) {
            let a = f64::from(dataset.action(frame as usize)[component]);
            let m = motion[(frame + lag) as usize];
            count += 1.0;
            for (sum, term) in sums.iter_mut().zip([a, m, a * a, m * m, a * m]) {
                *sum += term;
            }
        }
    }
    let [a, m, aa, mm, am] = sums;
    let scale = (count * aa - a * a).max(0.0).sqrt() * (count * mm - m * m).max(0.0).sqrt();
    if scale < 1e-9 {
        0.0
    } else {
        (count * am - a * m) / scale
    }
}

fn delay(action: &str, motion: MotionSignal, lags: Vec<LagCorrelation>) -> ActionDelay {
    let size = |place: usize| lags[place].correlation.abs();
    let peak = (0..lags.len()).max_by(|&a, &b| size(a).total_cmp(&size(b)));
    let delay_frames = peak.map(|peak| {
        let mut fraction = 0.0;
        if peak > 0 && peak + 1 < lags.len() {
            let (before, after) = (size(peak - 1), size(peak + 1));
            let curvature = before - 2.0 * size(peak) + after;
            if curvature < -1e-12 {
                fraction = (0.5 * (before - after) / curvature).clamp(-0.5, 0.5);
            }
        }
        lags[peak].lag_frames as f64 + fraction
    });
    let at_zero = lags.iter().find(|lag| lag.lag_frames == 0);
    ActionDelay {
        action: action.to_owned(),
        motion,
        delay_frames,
        correlation: peak.map_or(0.0, |peak| lags[peak].correlation),
        correlation_without_lag: at_zero.map_or(0.0, |lag| lag.correlation),
        lags,
    }
}

pub(super) fn warnings(delays: &[ActionDelay], frame_period_s: f64) -> Vec<String> {
    let varies = |delay: &ActionDelay| delay.correlation != 0.0;
    let mut warnings: Vec<String> = delays
        .iter()
        .filter_map(|delay| delay.warning(frame_period_s))
        .collect();
    if delays.iter().any(varies) && delays.iter().all(|delay| delay.delay_frames.is_none()) {
        warnings.push(
            "The image's motion follows none of the actions. Check that the right columns are imported as actions and that \
             images and actions have the same clock; else train without actions (model.conditioning=none)."
                .to_owned(),
        );
    }
    warnings
}

impl ActionDelay {
    /// By which the motion is chosen that belongs to the action.
    fn weight(&self) -> f64 {
        let size = self.correlation.abs();
        match self.motion {
            MotionSignal::Change => size * DIRECTION_SHARE,
            MotionSignal::Sideways | MotionSignal::Vertical => size,
        }
    }

    /// Whether the image follows the action clearly later, or earlier, than at once.
    #[must_use]
    pub fn is_long(&self) -> bool {
        let gain = self.correlation.abs() - self.correlation_without_lag.abs();
        self.delay_frames
            .is_some_and(|frames| frames.abs() >= LONG_DELAY_FRAMES && gain >= CLEAR_DIFFERENCE)
    }

    fn warning(&self, frame_period_s: f64) -> Option<String> {
        let frames = self.delay_frames.filter(|_| self.is_long())?;
        let found = format!(
            "the correlation of its {} is {:.2} there, and {:.2} without a delay",
            self.motion, self.correlation, self.correlation_without_lag
        );
        let (size, seconds) = (frames.abs(), frames.abs() * frame_period_s);
        Some(if frames > 0.0 {
            format!(
                "The image follows the action \"{}\" {size:.1} frames ({seconds:.2} s) later ({found}). Then the model does not see \
                 the action that causes what it has to predict. Give the actions later times by that much before the import, and \
                 do the same when you predict.",
                self.action
            )
        } else {
            format!(
                "The image moves {size:.1} frames ({seconds:.2} s) before the action \"{}\" ({found}). An effect cannot precede \
                 its cause: the actions are recorded too late or the images too early. Correct the times before the import.",
                self.action
            )
        })
    }
}
