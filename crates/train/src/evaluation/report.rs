//! The result of an evaluation. `report.json` holds it as it is, `report.md` by [`EvaluationReport::to_markdown`].

use std::time::Duration;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::actions::ActionTable;
use super::bootstrap::{Bootstrap, FEWEST_GROUPS, TrialSums};
use super::config::ScoredSplit;
use super::method::Method;
use super::metrics::{MethodScores, StepCurve, WindowScores, summarize};
use super::pixel_class::VisibilityScores;
use super::plans::PlanOutcome;
use super::progress::EvaluationContext;
use super::ranking::PlanRanking;
use super::skill::{Skill, skill};
use super::surroundings::SurroundingsScores;
use super::uncertainty::{NoveltyScores, UncertaintyScores};
#[doc(hidden)]
pub use crate::frame_marks::FramesOfTraining;
use foreframe_core::nn::precision::{self, Precision};
use foreframe_core::registry::{DatasetStamp, Model, ProgramStamp};
use foreframe_core::types::{ModelName, Seed};
use foreframe_data::dataset::Window;

/// The result of an evaluation, and how to repeat it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EvaluationReport {
    /// What was evaluated, how and where.
    pub stamp: ReportStamp,
    /// The model's sizes.
    pub model: ModelSummary,
    /// What the baseline of the nearest training windows searched and chose; absent where it does not apply.
    #[doc(hidden)]
    pub nearest_windows: Option<NearestSummary>,
    /// The test sets, or the validation split.
    pub sets: Vec<SetReport>,
    /// How well the model's novelty tells other data sets from its own; empty if none were given.
    #[serde(default)]
    pub novelty: Vec<NoveltyScores>,
    /// The pictures in the same directory; filled in when they are written.
    #[doc(hidden)]
    pub figures: Vec<FigureFile>,
}

impl EvaluationReport {
    /// The scores of a set by its split's name, unless it was skipped.
    #[must_use]
    pub fn scores(&self, split: &str) -> Option<&SetScores> {
        self.sets.iter().find(|set| set.split == split)?.outcome.scores()
    }

    /// Whether frames of a set that was scored were in the model's training.
    #[doc(hidden)]
    #[must_use]
    pub fn has_frames_of_training(&self) -> bool {
        let mut scored = self.sets.iter().filter_map(|set| set.outcome.scores());
        scored.any(SetScores::has_frames_of_training)
    }

    /// The scores in a few numbers for each set, for the model's manifest.
    #[must_use]
    pub fn headline(&self) -> Value {
        let mut headline = Map::new();
        for set in &self.sets {
            let Some(scores) = set.outcome.scores() else { continue };
            let Some(model) = scores.methods.first() else { continue };
            let interval = scores.skill.mean_interval.as_ref();
            let plan_rate = match &scores.plans {
                Some(PlanOutcome::Measured(plans)) => Some(plans.rate),
                _ => None,
            };
            let mut summary = json!({
                "skill": scores.skill.skill.mean,
                "strongest_baseline": scores.skill.best_mean_baseline,
                "skill_interval_95": interval.map(|interval| [interval.low, interval.high]),
                "mse": model.mse.mean,
                "psnr_db": model.psnr_db.mean,
                "ssim": model.ssim.mean,
                "mover_mse": model.mover_mse.as_ref().map(|mse| mse.mean),
                "plan_identification": plan_rate,
                "band_90_coverage": scores.uncertainty.as_ref().map(|scores| scores.coverage.mean),
                "skill_interval_is_reliable": scores.intervals_are_reliable,
                "windows": scores.windows,
                "dataset_content_hash": self.stamp.dataset_content_hash,
            });
            match scores.blocks {
                Some(blocks) => summary["blocks"] = json!(blocks),
                None => summary["trials"] = json!(scores.trials),
            }
            if let Some(skill) = &scores.skill_against_unfitted {
                let interval = skill.mean_interval.as_ref();
                summary["skill_against_unfitted"] = json!(skill.skill.mean);
                summary["strongest_unfitted_baseline"] = json!(skill.best_mean_baseline);
                summary["skill_against_unfitted_interval_95"] =
                    json!(interval.map(|interval| [interval.low, interval.high]));
            }
            if let Some(frames) = scores.frames_of_training {
                summary["frames_of_training"] = json!(frames);
            }
            if let Some(benchmark) = &model.benchmark {
                summary["squared_error_per_frame"] = json!(benchmark.squared_error.mean);
                summary["ssim_even_windows"] = json!(benchmark.ssim.mean);
            }
            headline.insert(set.split.clone(), summary);
        }
        Value::Object(headline)
    }
}

/// What was evaluated, how and where.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ReportStamp {
    /// The data set's title.
    pub dataset: String,
    /// SHA-256 of its content.
    pub dataset_content_hash: String,
    /// Seed of the split into training, validation and test.
    pub split_seed: Seed,
    /// The model's name.
    pub model: ModelName,
    /// SHA-256 of its weights' file.
    pub model_sha256: String,
    /// Name and SHA-256 of each twin that was compared.
    #[serde(default)]
    pub twins: Vec<(ModelName, String)>,
    /// Whether the validation split or the test sets were scored.
    #[serde(default)]
    pub split: ScoredSplit,
    /// What the intensities of all frames were multiplied by before anything was scored; absent where it is 1.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[doc(hidden)]
    pub brightness: Option<f64>,
    /// The numbers of 16 or 8 bits that the network's products were computed in; absent in single precision.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[doc(hidden)]
    pub precision: Option<Precision>,
    /// The program's version and the commit it was built from.
    pub program: ProgramStamp,
    /// The command line.
    pub command: String,
    /// Frames from the start of one window to that of the next.
    pub stride: usize,
    /// Resamples for the intervals.
    pub bootstrap_samples: usize,
    /// Seed of the resamples and of the shuffled actions.
    pub seed: Seed,
    /// Duration in seconds.
    pub wall_time_s: f64,
    /// The processor's name.
    pub cpu: String,
    /// Threads of the computation.
    pub threads: usize,
}

impl ReportStamp {
    pub(super) fn new(evaluation: &EvaluationContext, split_seed: Seed, wall_time: Duration) -> Self {
        let (dataset, config) = (evaluation.inference.dataset, evaluation.config);
        let (info, brightness) = (dataset.info(), dataset.brightness());
        let named = |model: &Model| (model.manifest.name.clone(), model.manifest.weights_sha256.clone());
        let (model, model_sha256) = named(evaluation.inference.loaded);
        Self {
            dataset: info.name.clone(),
            dataset_content_hash: info.content_hash.clone(),
            split_seed,
            model,
            model_sha256,
            twins: config.twins.iter().map(|twin| named(twin)).collect(),
            split: config.split,
            brightness: (brightness != 1.0).then_some(brightness),
            precision: Some(precision::current()).filter(|precision| *precision != Precision::F32),
            program: ProgramStamp::current(),
            command: config.command.clone(),
            stride: config.stride,
            bootstrap_samples: config.bootstrap_samples,
            seed: config.seed,
            wall_time_s: wall_time.as_secs_f64(),
            cpu: cpu_name(),
            threads: rayon::current_num_threads(),
        }
    }
}

/// From `/proc/cpuinfo`; the architecture where that does not exist.
fn cpu_name() -> String {
    let listed = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let named = listed.lines().find(|line| line.starts_with("model name"));
    let name = named.and_then(|line| line.split_once(':'));
    name.map_or(std::env::consts::ARCH, |(_, name)| name.trim()).to_owned()
}

/// The model's sizes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelSummary {
    /// Width of a frame in pixels.
    pub frame_width_px: u32,
    /// Height of a frame in pixels.
    pub frame_height_px: u32,
    /// Seconds between frames.
    pub frame_period_s: f64,
    /// Frames seen.
    pub context: usize,
    /// Frames predicted.
    pub horizon: usize,
    /// What it is conditioned on.
    pub conditioning: String,
    /// Whether its inputs have inverted intensities.
    pub inverted: bool,
    /// Number of trained values.
    pub parameters: u64,
    /// Multiply–adds to predict one frame.
    pub multiply_adds_per_frame: u64,
    /// What it was trained on.
    pub trained_on: DatasetStamp,
}

impl ModelSummary {
    pub(super) fn of(loaded: &Model) -> Self {
        let spec = loaded.spec();
        Self {
            frame_width_px: spec.frame_width_px,
            frame_height_px: spec.frame_height_px,
            frame_period_s: spec.frame_period_s,
            context: spec.context,
            horizon: spec.horizon,
            conditioning: spec.conditioning.to_string(),
            inverted: spec.preprocess.invert,
            parameters: spec.parameter_count(),
            multiply_adds_per_frame: spec.multiply_adds_per_frame(),
            trained_on: DatasetStamp {
                frame_marks: Vec::new(),
                ..loaded.manifest.dataset.clone()
            },
        }
    }
}

/// What the baseline of the nearest training windows searched, and how it weighs them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NearestSummary {
    /// Training windows that are searched.
    pub searched: usize,
    /// Training windows that there are.
    pub available: usize,
    /// Validation windows by which the two numbers below were chosen; 0 where there are none.
    pub validation_windows: usize,
    /// A neighbour's weight is 1 / distance to the power of this.
    pub exponent: f64,
    /// Weight of the actions in the distance: at 1, a difference of one standard deviation counts as much in all actions as
    /// in all images. 0 where the data set has no actions.
    pub action_weight: f64,
}

/// One test set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SetReport {
    /// `test`, `unseen-pairs`, `unseen-gains`, `validation` or `whole-set`; `new-materials` or `new-cameras` for rooms that are
    /// only for tests.
    pub split: String,
    /// Its scores, or why there are none.
    #[serde(flatten)]
    pub outcome: SetOutcome,
}

/// A test set's scores, or why there are none.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "status", rename_all = "kebab-case")]
pub enum SetOutcome {
    /// It was tested.
    Scored(Box<SetScores>),
    /// It is empty.
    Skipped {
        /// Why.
        reason: String,
    },
}

impl SetOutcome {
    /// The scores, unless it was skipped.
    #[must_use]
    pub fn scores(&self) -> Option<&SetScores> {
        match self {
            Self::Scored(scores) => Some(scores),
            Self::Skipped { .. } => None,
        }
    }
}

/// The scores of one test set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SetScores {
    /// Windows tested.
    pub windows: usize,
    /// Windows available at that stride.
    pub windows_available: usize,
    /// Trials that they come from; absent for a recording.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trials: Option<usize>,
    /// Blocks of time that they come from, for a recording.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub blocks: Option<usize>,
    /// Whether the intervals can be trusted: they are from at least ten trials or blocks.
    pub intervals_are_reliable: bool,
    /// The headline.
    pub skill: Skill,
    /// The skill against only those baselines that know nothing of this data set, because they learned nothing from its
    /// training part. Absent for a model that was trained on the data set or on frames of the windows.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[doc(hidden)]
    pub skill_against_unfitted: Option<Skill>,
    /// How many frames of the windows were in the model's training. Absent for a model that was trained on the data set, or by an earlier
    /// program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[doc(hidden)]
    pub frames_of_training: Option<FramesOfTraining>,
    /// Model, baselines and codec.
    pub methods: Vec<MethodScores>,
    /// Mean squared error of the model in its own space (smoothed, and inverted if the model inverts); not comparable
    /// between models that preprocess differently.
    pub model_space_mse: StepCurve,
    /// Mean squared error of the reconstruction of the frames seen, the oldest first; empty if the model does not reconstruct.
    pub reconstruction_mse: StepCurve,
    /// Does the action matter? Absent for a model that takes none.
    pub actions: Option<ActionTable>,
    /// How often plans are identified by their predictions. Absent for a model that takes no actions.
    #[serde(default)]
    pub plans: Option<PlanOutcome>,
    /// How often the driven plan is ranked first. Absent where the set is no recording or has too few windows, or the model takes no
    /// actions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[doc(hidden)]
    pub ranking: Option<PlanRanking>,
    /// Where movers are, and how far away things are. Absent for a model that does not tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[doc(hidden)]
    pub surroundings: Option<SurroundingsScores>,
    /// Errors by what a pixel shows. Absent where the simulator cannot tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[doc(hidden)]
    pub visibility: Option<VisibilityScores>,
    /// How well the expected errors fit. Absent for a model without calibration.
    #[serde(default)]
    pub uncertainty: Option<UncertaintyScores>,
    /// The windows that the figures show.
    pub samples: Vec<SampleWindow>,
}

impl SetScores {
    /// Whether frames of the windows were in the model's training, so that they do not test it.
    pub(super) fn has_frames_of_training(&self) -> bool {
        self.frames_of_training.is_some_and(FramesOfTraining::were_trained_on)
    }

    /// The scores of these windows, whose rows are the methods. What else a set may have is filled in later.
    pub(super) fn new(methods: &[Method], windows: &[WindowScores], bootstrap: &Bootstrap, is_recording: bool) -> Self {
        let trial_of: Vec<usize> = windows.iter().map(|window| window.group).collect();
        let by_trial = |of: fn(&WindowScores) -> &[f64]| TrialSums::group(&trial_of, windows.iter().map(of));
        let own_space = by_trial(|window| &window.model_space_mse);
        let groups = own_space.count();
        Self {
            windows: windows.len(),
            windows_available: windows.len(),
            trials: (!is_recording).then_some(groups),
            blocks: is_recording.then_some(groups),
            intervals_are_reliable: groups >= FEWEST_GROUPS,
            skill: skill(methods, windows, bootstrap),
            skill_against_unfitted: None,
            frames_of_training: None,
            methods: summarize(methods, windows),
            model_space_mse: StepCurve::new(own_space.means()),
            reconstruction_mse: StepCurve::new(by_trial(|window| &window.reconstruction_mse).means()),
            actions: None,
            plans: None,
            ranking: None,
            surroundings: None,
            visibility: None,
            uncertainty: None,
            samples: SampleWindow::choose(windows),
        }
    }
}

/// A window that the figures show, chosen by the model's error alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SampleWindow {
    /// `median`, `best` or `worst`.
    pub rank: String,
    /// Position of its trial in the data set.
    pub episode: usize,
    /// Its first frame in the data set.
    pub first_frame: usize,
    /// The model's mean squared error over all steps.
    pub mse: f64,
}

impl SampleWindow {
    /// The window in the data set.
    pub(super) fn window(&self) -> Window {
        Window {
            episode: self.episode,
            first_frame: self.first_frame,
        }
    }

    fn choose(windows: &[WindowScores]) -> Vec<Self> {
        let mut ranked: Vec<&WindowScores> = windows.iter().collect();
        ranked.sort_by(|a, b| a.model_mse().total_cmp(&b.model_mse()));
        let middle = ranked.get(ranked.len() / 2);
        let places = [("median", middle), ("best", ranked.first()), ("worst", ranked.last())];
        let found = places.into_iter().filter_map(|(rank, window)| {
            window.map(|window| Self {
                rank: rank.to_owned(),
                episode: window.episode,
                first_frame: window.first_frame,
                mse: window.model_mse(),
            })
        });
        found.collect()
    }
}

/// A picture in the report's directory, and what it shows.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FigureFile {
    /// Its name in the directory.
    pub file: String,
    /// What it shows, in a phrase.
    pub caption: String,
}
