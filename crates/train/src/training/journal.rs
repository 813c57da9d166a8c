//! Where a training reports: to its observer, to an event file for `TensorBoard`, and with a sample prediction.

use std::time::Instant;

use super::TrainError;
use super::checkpoint::{CheckpointPosition, RunFiles, io_failed};
use super::event_file::EventFile;
use super::observer::{Observer, TrainingEvent, TrainingStage};
use foreframe_core::files::write_atomically;
use foreframe_core::frame::{Frame, codec};

/// How many points of a stage's training loss are kept, besides those of its validations.
pub const CURVE_POINTS: usize = 500;
/// Name of the picture in a run's directory: a validation window's true frames above the frames predicted at the latest validation of
/// the second stage.
pub const SAMPLE_FILE: &str = "sample.png";

/// A completed update.
#[derive(Clone, Copy, Debug)]
pub(super) struct CompletedUpdate {
    pub(super) stage: TrainingStage,
    /// Number of completed updates, including this one.
    pub(super) step: usize,
    /// Number of updates of the stage.
    pub(super) steps: usize,
    /// The loss of its batch.
    pub(super) loss: f64,
    pub(super) learning_rate: f64,
    /// Whether a validation follows.
    pub(super) is_validated: bool,
}

/// A completed validation.
pub(super) struct CompletedValidation {
    pub(super) stage: TrainingStage,
    pub(super) step: usize,
    pub(super) loss: f64,
    pub(super) is_best: bool,
    pub(super) sample: Option<Frame>,
}

/// Receives what a training reports.
pub(super) struct Journal<'a> {
    files: &'a RunFiles,
    observer: &'a mut dyn Observer,
    events: EventFile,
    /// Until when the speed was measured.
    measured: Option<MeasuredUntil>,
}

struct MeasuredUntil {
    time: Instant,
    stage: TrainingStage,
    step: usize,
}

impl<'a> Journal<'a> {
    /// `reached`: after which step the training goes on. Errors: `Io`.
    pub(super) fn open(
        files: &'a RunFiles,
        reached: CheckpointPosition,
        observer: &'a mut dyn Observer,
    ) -> Result<Self, TrainError> {
        Ok(Self {
            files,
            observer,
            events: EventFile::open(files.run_dir(), reached)?,
            measured: None,
        })
    }

    pub(super) fn event(&mut self, event: TrainingEvent) {
        self.observer.on_event(event);
    }

    /// Errors: `Io`.
    pub(super) fn updated(&mut self, update: CompletedUpdate) -> Result<(), TrainError> {
        let CompletedUpdate {
            stage,
            step,
            steps,
            loss,
            learning_rate,
            is_validated,
        } = update;
        if is_validated || step.is_multiple_of(steps.div_ceil(CURVE_POINTS)) {
            let mut values = vec![("loss", loss), ("learning rate", learning_rate)];
            values.extend(self.steps_per_s(stage, step).map(|speed| ("steps per second", speed)));
            self.events.scalars(stage, step, &values)?;
        }
        self.event(TrainingEvent::Step {
            stage,
            step,
            steps,
            loss,
        });
        Ok(())
    }

    /// Errors: `Io`, `Frame`.
    pub(super) fn validated(&mut self, validation: CompletedValidation) -> Result<(), TrainError> {
        let CompletedValidation {
            stage,
            step,
            loss,
            is_best,
            sample,
        } = validation;
        self.events.scalars(stage, step, &[("validation loss", loss)])?;
        if let Some(sample) = sample {
            self.events.picture(stage, step, "prediction", &sample)?;
            let path = self.files.path(SAMPLE_FILE);
            write_atomically(&path, &codec::encode_png(&sample)?).map_err(io_failed("write", &path))?;
        }
        self.event(TrainingEvent::Validated {
            stage,
            step,
            loss,
            is_best,
        });
        Ok(())
    }

    /// Updates per second since the last call; `None` at the first one of a stage.
    fn steps_per_s(&mut self, stage: TrainingStage, step: usize) -> Option<f64> {
        let time = Instant::now();
        let before = self.measured.replace(MeasuredUntil { time, stage, step });
        let before = before.filter(|before| before.stage == stage && before.step < step)?;
        let elapsed_s = time.duration_since(before.time).as_secs_f64();
        (elapsed_s > 0.0).then(|| (step - before.step) as f64 / elapsed_s)
    }
}
