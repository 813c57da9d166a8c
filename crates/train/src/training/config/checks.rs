//! The ranges of all settings of a training, and which settings others must allow.

use super::{CodecStart, Mirror, TrainConfig, TrainingFeedback, WindowBudget};
use crate::training::TrainError;
use crate::training::optimizer::UpdateRule;
use foreframe_core::nn::{ArchitectureKind, Conditioning};

/// Largest number of steps of one stage.
const MAX_STEPS: usize = 10_000_000;
/// Longest part of a recording to train on, in seconds.
const MAX_SECONDS: f64 = 1e9;
/// Largest number of windows or frames in one batch.
const MAX_BATCH_SIZE: usize = 4096;

impl TrainConfig {
    /// Checks all settings. Errors: `Config` with the first field that is out of range, and its range.
    pub fn validate(&self) -> Result<(), TrainError> {
        let (run, sequence, pretrain) = (&self.run, &self.sequence, &self.pretrain);
        let counts = [
            ("pretrain.steps", pretrain.steps, 0, MAX_STEPS),
            ("pretrain.batch_size", pretrain.batch_size, 1, MAX_BATCH_SIZE),
            ("sequence.steps", sequence.steps, 1, MAX_STEPS),
            ("sequence.batch_size", sequence.batch_size, 1, MAX_BATCH_SIZE),
            ("data.validation_windows", self.data.validation_windows, 1, MAX_STEPS),
            ("run.batch_parts", run.batch_parts, 1, 64),
            ("run.validate_every_steps", run.validate_every_steps, 1, MAX_STEPS),
            ("run.checkpoint_every_steps", run.checkpoint_every_steps, 1, MAX_STEPS),
            ("run.warmup_steps", run.warmup_steps, 0, MAX_STEPS),
        ];
        for (field, value, min, max) in counts {
            if !(min..=max).contains(&value) {
                return refused(format!("{field} is {value}; it must be {min} to {max}"));
            }
        }
        let numbers = [
            ("pretrain.learning_rate", pretrain.learning_rate, 1.0),
            ("sequence.learning_rate", sequence.learning_rate, 1.0),
            ("sequence.reconstruction_weight", sequence.reconstruction_weight, 100.0),
            ("sequence.ssim_weight", sequence.ssim_weight, 100.0),
            ("sequence.short_share", sequence.short_share, 0.9),
            ("sequence.scene_weight", sequence.scene_weight, 100.0),
            ("sequence.motion_weight", sequence.motion_weight, 100.0),
            ("sequence.movers_weight", sequence.movers_weight, 100.0),
            ("sequence.speeds_weight", sequence.speeds_weight, 100.0),
            ("data.hidden", self.data.hidden, 1.0),
            ("data.first_seconds", self.data.first_seconds, MAX_SECONDS),
            ("data.brightness", self.data.brightness, 0.9),
            ("data.crop", self.data.crop, 0.5),
            ("run.final_learning_rate", run.final_learning_rate, 1.0),
            ("run.clip_norm", run.clip_norm, 1e6),
        ];
        for (field, value, max) in numbers {
            if !(0.0..=max).contains(&value) {
                return refused(format!("{field} is {value}; it must be 0 to {max}"));
            }
        }
        let rates = [
            ("sequence.learning_rate", sequence.learning_rate),
            ("run.clip_norm", run.clip_norm),
        ];
        if let Some((field, _)) = rates.iter().find(|(_, value)| *value == 0.0) {
            return refused(format!("{field} is 0, so nothing would be learned; it must be above 0"));
        }
        let (parts, sizes) = (
            run.batch_parts,
            [("pretrain", pretrain.batch_size), ("sequence", sequence.batch_size)],
        );
        if let Some((stage, size)) = sizes.iter().find(|(_, size)| !size.is_multiple_of(parts)) {
            return refused(format!(
                "{stage}.batch_size is {size}; it must be a multiple of run.batch_parts, {parts}"
            ));
        }
        if self.data.windows == WindowBudget::Count(0) {
            return refused("data.windows is 0; it must be at least 1, or \"all\"".to_owned());
        }
        if self.data.first_seconds > 0.0 && self.data.windows != WindowBudget::All {
            return refused(format!(
                "data.first_seconds is {}; that needs data.windows = \"all\"",
                self.data.first_seconds
            ));
        }
        self.validate_together()
    }

    /// Checks the settings that are for some networks only. Errors: `Config` with the first that does not fit, and what would.
    fn validate_for_network(&self) -> Result<(), TrainError> {
        let (run, sequence) = (&self.run, &self.sequence);
        let architecture = self.model.architecture.kind();
        let is_dense = architecture == ArchitectureKind::Dense;
        let uses_muon = run.optimizer == UpdateRule::Muon && is_dense;
        let starts_from_components = self.pretrain.start == CodecStart::Principal && !is_dense;
        let is_forced = sequence.feedback == TrainingFeedback::TeacherForcing && !is_dense;
        let counts_few = sequence.short_share > 0.0 && architecture != ArchitectureKind::Flow;
        let of_flow = [sequence.scene_weight, sequence.movers_weight, sequence.speeds_weight];
        let [scene, movers, speeds] = of_flow.map(|weight| weight > 0.0 && architecture == ArchitectureKind::Sprites);
        let of_others = [
            ("run.optimizer", uses_muon, "the flow and sprite networks", "adam"),
            ("pretrain.start", starts_from_components, "the dense network", "random"),
            ("sequence.feedback", is_forced, "the dense network", "prediction"),
            ("sequence.short_share", counts_few, "the flow network", "0"),
            ("sequence.scene_weight", scene, "the flow network", "0"),
            ("sequence.movers_weight", movers, "the flow network", "0"),
            ("sequence.speeds_weight", speeds, "the flow network", "0"),
        ];
        if let Some((field, _, networks, needed)) = of_others.iter().find(|(_, is_set, _, _)| *is_set) {
            return refused(format!(
                "{field} is for {networks} only; it must be {needed} where model.architecture is {architecture}"
            ));
        }
        if architecture == ArchitectureKind::Sprites && sequence.reconstruction_weight == 0.0 {
            return refused(
                "sequence.reconstruction_weight is 0, but the sprite network learns what the sprites look like from the frames that it sees; \
                 it must be above 0 where model.architecture is sprites"
                    .to_owned(),
            );
        }
        if !is_dense && self.pretrain.steps > 0 {
            return refused(format!(
                "pretrain.steps is {}; only the dense network has pre-training, so it must be 0",
                self.pretrain.steps
            ));
        }
        Ok(())
    }

    /// Checks the settings that others must allow. Errors: `Config` with the first that does not fit, and what would.
    fn validate_together(&self) -> Result<(), TrainError> {
        self.validate_for_network()?;
        let sequence = &self.sequence;
        if self.data.mirror == Mirror::Movers && self.model.conditioning != Conditioning::None {
            return refused(format!(
                "data.mirror is \"movers\", which is for a camera that stands and takes no actions and no state; \
                 model.conditioning is {}: set it to none, or data.mirror to off",
                self.model.conditioning
            ));
        }
        if self.data.reverse && self.model.conditioning != Conditioning::None {
            return refused(format!(
                "data.reverse is true, but actions and states do not fit a window that is played backwards; \
                 model.conditioning is {}: set it to none, or data.reverse to false",
                self.model.conditioning
            ));
        }
        if self.data.hidden > 0.0 && !self.sees_speeds() {
            return refused(format!(
                "data.hidden is {}, but without states and actions only a network with model.flow.speeds can tell how the camera \
                 drives; set that to true, or data.hidden to 0",
                self.data.hidden
            ));
        }
        if self.remembers_room() && (self.data.hidden > 0.0 || self.data.mirror != Mirror::Off) {
            let now = match self.data.mirror {
                Mirror::Off => format!("data.hidden is {}", self.data.hidden),
                _ => "data.mirror is not off".to_owned(),
            };
            return refused(format!(
                "model.flow.memory is true, so set data.mirror to off and data.hidden to 0 (now {now}): a mirrored room is another one, and \
                 a hidden pose does not say where the room is seen from"
            ));
        }
        if sequence.short_share > 0.0 && !(1..=self.model.horizon).contains(&sequence.short_horizon) {
            return refused(format!(
                "sequence.short_horizon is {}; it must be 1 to model.horizon, {}",
                sequence.short_horizon, self.model.horizon
            ));
        }
        Ok(())
    }
}

fn refused(reason: String) -> Result<(), TrainError> {
    Err(TrainError::Config(reason))
}
