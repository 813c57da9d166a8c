//! A training's events in the job's report.

use super::super::report::JobReporter;
use crate::store::LossRow;
use foreframe_train::training::{CURVE_POINTS, TrainingEvent, TrainingStage};

/// Turns a training's events into the job's report.
pub(super) struct TrainingReporter<'a> {
    pub(super) report: &'a JobReporter,
    /// The steps of each stage.
    pub(super) steps: [usize; 2],
    pub(super) train_loss: Option<f64>,
}

impl TrainingReporter<'_> {
    pub(super) fn on_event(&mut self, event: TrainingEvent) {
        match event {
            TrainingEvent::Started { stage, step, windows } => {
                self.progress(stage, step);
                self.report.checkpoint(self.done(stage, step));
                self.report
                    .line(format!("{stage} from step {step}, on {windows} windows"));
            }
            // A point that the last attempt did not write before it was killed must also be in the curves.
            TrainingEvent::Restored {
                stage,
                step,
                train_loss,
                validation_loss,
            } => {
                self.train_loss = Some(train_loss);
                self.point(stage, step, Some(validation_loss));
            }
            TrainingEvent::Step {
                stage,
                step,
                steps,
                loss,
            } => {
                if step == 1 {
                    self.report.stage();
                }
                self.progress(stage, step);
                self.train_loss = Some(loss);
                self.report.losses(Some(loss), None);
                if step.is_multiple_of(steps.div_ceil(CURVE_POINTS)) {
                    self.point(stage, step, None);
                }
            }
            TrainingEvent::Validated {
                stage,
                step,
                loss,
                is_best,
            } => {
                self.report.losses(None, Some(loss));
                self.point(stage, step, Some(loss));
                let best = if is_best { ", the best so far" } else { "" };
                self.report
                    .line(format!("{stage} step {step}: validation MSE {loss:.6}{best}"));
            }
            TrainingEvent::CheckpointDamaged { is_previous: true } => {
                let line = "the previous checkpoint is damaged too; starting from the beginning";
                self.report.line(line.to_owned());
            }
            TrainingEvent::CheckpointDamaged { is_previous: false } => {
                let line = "the latest checkpoint is damaged; resuming from the previous one";
                self.report.line(line.to_owned());
            }
            TrainingEvent::Checkpointed { stage, step } => self.report.checkpoint(self.done(stage, step)),
        }
    }

    fn progress(&self, stage: TrainingStage, step: usize) {
        let total = self.steps.iter().sum::<usize>() as u64;
        self.report.progress(self.done(stage, step), total, &stage.to_string());
    }

    /// The steps of both stages that are done.
    fn done(&self, stage: TrainingStage, step: usize) -> u64 {
        let [pretrain, _] = self.steps;
        match stage {
            TrainingStage::Pretrain => step as u64,
            TrainingStage::Sequence => (pretrain + step) as u64,
        }
    }

    fn point(&self, stage: TrainingStage, step: usize, validation: Option<f64>) {
        self.report.point(LossRow {
            stage: stage.to_string(),
            step: step as i64,
            train: self.train_loss,
            validation,
        });
    }
}
