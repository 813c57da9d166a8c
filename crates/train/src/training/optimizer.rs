//! Adam (Kingma & Ba 2015), or Muon for some weights and Adam for the others. The moments can be exported, so that a resumed
//! training continues bit by bit. [`Gradients`] are separate values, so that parts of a batch can be computed in parallel and
//! averaged. candle-nn's `AdamW` keeps its moments to itself, so it cannot continue from a checkpoint, and takes a pass for each
//! operation; it has no Muon.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

mod gradients;
mod muon;

pub use gradients::Gradients;

use std::collections::BTreeMap;

use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};

use foreframe_core::nn::Parameters;
use foreframe_core::nn::TensorError;
use foreframe_core::nn::tensors::with_values;
use foreframe_core::vectorized::vectorized;

/// Prefixes of the exported tensors' names: first and second moments, and the number of steps.
const FIRST: &str = "adam.first.";
const SECOND: &str = "adam.second.";
const STEP: &str = "adam.step";

/// Adam's decay of the first and of the second moment.
const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
/// Added to the square root of the second moment.
const EPSILON: f64 = 1e-8;

/// Why an update failed. Parameters and moments are unchanged, except where the tensor library failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OptimizerError {
    /// The loss is NaN or infinite.
    #[error("the loss is {value}; it must be a finite number")]
    LossNotFinite {
        /// The value found.
        value: f64,
    },
    /// A gradient holds NaN or an infinity.
    #[error("the gradient of tensor \"{name}\" contains a value that is not a finite number")]
    GradientNotFinite {
        /// The tensor.
        name: String,
    },
    /// There are no gradients to average.
    #[error("there are no gradients to average; there must be at least one part")]
    Join,
    /// An exported state does not match the parameters.
    #[error("optimizer state: tensor \"{name}\" {problem}")]
    State {
        /// The exported tensor.
        name: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The tensor library failed.
    #[error("tensor computation failed")]
    Tensor(#[source] TensorError),
}

#[doc(hidden)]
impl From<candle_core::Error> for OptimizerError {
    fn from(error: candle_core::Error) -> Self {
        Self::Tensor(error.into())
    }
}

/// How weights are updated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UpdateRule {
    /// Adam for all tensors.
    #[default]
    Adam,
    /// Muon for the weights of the flow network's hidden layers, Adam for all other tensors.
    Muon,
}

/// The optimizer's settings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OptimizerConfig {
    /// How weights are updated.
    pub rule: UpdateRule,
    /// Gradients with a larger norm are scaled down to this norm; infinite for no clipping.
    pub clip_norm: f64,
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        Self {
            rule: UpdateRule::Adam,
            clip_norm: 1.0,
        }
    }
}

/// Running means of a tensor's gradient and of its square; Muon keeps no mean of the square, and leaves zeros.
#[derive(Clone, Debug)]
struct Moments {
    shape: Vec<usize>,
    first: Vec<f32>,
    second: Vec<f32>,
}

/// The optimizer with its moments, by tensor name.
#[derive(Clone, Debug)]
pub struct Optimizer {
    config: OptimizerConfig,
    step: u64,
    moments: BTreeMap<String, Moments>,
}

impl Optimizer {
    /// An optimizer before its first update.
    #[must_use]
    pub fn new(config: OptimizerConfig) -> Self {
        Self {
            config,
            step: 0,
            moments: BTreeMap::new(),
        }
    }

    /// Number of completed updates.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// Updates the parameters and returns the gradients' norm before clipping. Parameters without a gradient do not change.
    /// Errors: `GradientNotFinite`; then nothing has changed.
    pub fn update(
        &mut self,
        parameters: &Parameters,
        gradients: &Gradients,
        learning_rate: f64,
    ) -> Result<f64, OptimizerError> {
        let norm = gradients.norm()?;
        self.step += 1;
        let steps = i32::try_from(self.step).unwrap_or(i32::MAX);
        let OptimizerConfig { rule, clip_norm } = self.config;
        let second_correction = 1.0 - BETA2.powi(steps);
        let scale = if norm > clip_norm { clip_norm / norm } else { 1.0 };
        let adam = AdamStep {
            scale: scale as f32,
            // θ −= lr · (m / b1) / (√(v / b2) + ε), with √b2 moved out of the square root.
            rate: (learning_rate * second_correction.sqrt() / (1.0 - BETA1.powi(steps))) as f32,
            epsilon: (EPSILON * second_correction.sqrt()) as f32,
        };
        for (name, var) in parameters.iter() {
            let Some(gradient) = gradients.get(name) else {
                continue;
            };
            let moments = self.moments.entry(name.to_owned()).or_insert_with(|| Moments {
                shape: var.dims().to_vec(),
                first: vec![0.0; var.elem_count()],
                second: vec![0.0; var.elem_count()],
            });
            if rule == UpdateRule::Muon && muon::applies_to(name) {
                muon::update(var, gradient, adam.scale, &mut moments.first, learning_rate)?;
                continue;
            }
            let mut values = with_values(var, <[f32]>::to_vec)?;
            with_values(gradient, |gradient| adam.apply(&mut values, gradient, moments))?;
            var.set(&Tensor::from_vec(values, var.shape(), &Device::Cpu)?)?;
        }
        Ok(norm)
    }

    /// The moments and the number of steps as tensors for a checkpoint.
    pub fn export(&self) -> Result<BTreeMap<String, Tensor>, OptimizerError> {
        let mut tensors = BTreeMap::new();
        let steps = i64::try_from(self.step).unwrap_or(i64::MAX);
        tensors.insert(STEP.to_owned(), Tensor::from_vec(vec![steps], 1, &Device::Cpu)?);
        for (name, moments) in &self.moments {
            for (prefix, values) in [(FIRST, &moments.first), (SECOND, &moments.second)] {
                let tensor = Tensor::from_slice(values, moments.shape.as_slice(), &Device::Cpu)?;
                tensors.insert(format!("{prefix}{name}"), tensor);
            }
        }
        Ok(tensors)
    }

    /// Restores the optimizer from the tensors of [`Optimizer::export`], bit by bit. Tensors with other names are ignored.
    /// Errors: `State`.
    pub fn import(
        config: OptimizerConfig,
        tensors: &BTreeMap<String, Tensor>,
        parameters: &Parameters,
    ) -> Result<Self, OptimizerError> {
        let problem = |name: &str, problem: String| OptimizerError::State {
            name: name.to_owned(),
            problem,
        };
        let steps = tensors
            .get(STEP)
            .ok_or_else(|| problem(STEP, "is missing".to_owned()))?;
        let step = match steps.flatten_all()?.to_vec1::<i64>()?.as_slice() {
            &[step] if step >= 0 => step as u64,
            other => return Err(problem(STEP, format!("is {other:?}; it must be one count"))),
        };
        let mut moments = BTreeMap::new();
        for (name, var) in parameters.iter() {
            let read = |key: &str, tensor: &Tensor| {
                if tensor.dims() != var.dims() {
                    let wrong = format!("has shape {:?}; the parameter has {:?}", tensor.dims(), var.dims());
                    return Err(problem(key, wrong));
                }
                Ok(tensor.flatten_all()?.to_vec1::<f32>()?)
            };
            let keys = [format!("{FIRST}{name}"), format!("{SECOND}{name}")];
            match (tensors.get(&keys[0]), tensors.get(&keys[1])) {
                (None, None) => {}
                (Some(first), Some(second)) => {
                    let shape = var.dims().to_vec();
                    let (first, second) = (read(&keys[0], first)?, read(&keys[1], second)?);
                    moments.insert(name.to_owned(), Moments { shape, first, second });
                }
                (first, _) => return Err(problem(&keys[usize::from(first.is_some())], "is missing".to_owned())),
            }
        }
        Ok(Self { config, step, moments })
    }
}

/// The constants of one update.
#[derive(Clone, Copy)]
struct AdamStep {
    scale: f32,
    rate: f32,
    epsilon: f32,
}

impl AdamStep {
    /// Updates the values of one tensor in one pass.
    fn apply(self, parameters: &mut [f32], gradient: &[f32], moments: &mut Moments) {
        let Moments { first, second, .. } = moments;
        let (beta1, beta2) = (BETA1 as f32, BETA2 as f32);
        vectorized(
            #[inline(always)]
            || {
                let values = parameters.iter_mut().zip(gradient).zip(first).zip(second);
                for (((parameter, &gradient), m), v) in values {
                    let gradient = gradient * self.scale;
                    *m = beta1 * *m + (1.0 - beta1) * gradient;
                    *v = beta2 * *v + (1.0 - beta2) * gradient * gradient;
                    *parameter -= self.rate * *m / (v.sqrt() + self.epsilon);
                }
            },
        );
    }
}
