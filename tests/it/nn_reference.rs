//! The dense network in plain tensor operations, step by step and in f64, to check the fused f32 operations. Its gradients
//! are candle's own.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Result, Tensor, Var};
use foreframe_core::nn::spec::MIN_CHANNEL_STD;
use foreframe_core::nn::{
    ChannelScale, ConditioningTensors, DenseSpec, ModelSpec, Parameters, PredictorOutput, Reconstruction,
};

/// Output and cell state of an LSTM, `[B, H]` each.
#[derive(Clone)]
pub(crate) struct CellState {
    pub(crate) h: Tensor,
    pub(crate) c: Tensor,
}

/// One step of an LSTM cell (paper, equations 1–5). `tensor` gives `w_x`, `w_h`, `bias` and the three peepholes by name.
pub(crate) fn step<'a>(tensor: impl Fn(&str) -> &'a Tensor, x: &Tensor, state: &CellState) -> Result<CellState> {
    let sums = (x.matmul(tensor("w_x"))?.broadcast_add(tensor("bias"))? + state.h.matmul(tensor("w_h"))?)?;
    let hidden = state.c.dim(1)?;
    let gate = |index: usize| sums.narrow(1, index * hidden, hidden);
    let peephole = |name: &str, c: &Tensor| c.broadcast_mul(tensor(name));
    let i = candle_nn::ops::sigmoid(&(gate(0)? + peephole("peephole_i", &state.c)?)?)?;
    let f = candle_nn::ops::sigmoid(&(gate(1)? + peephole("peephole_f", &state.c)?)?)?;
    let c = ((f * &state.c)? + (i * gate(2)?.tanh()?)?)?;
    let o = candle_nn::ops::sigmoid(&(gate(3)? + peephole("peephole_o", &c)?)?)?;
    Ok(CellState { h: (o * c.tanh()?)?, c })
}

pub(crate) struct Reference<'a> {
    spec: &'a ModelSpec,
    sizes: &'a DenseSpec,
    pub(crate) vars: BTreeMap<String, Var>,
}

impl<'a> Reference<'a> {
    pub(crate) fn new(spec: &'a ModelSpec, parameters: &Parameters) -> Self {
        let double = |(name, var): (&str, &Var)| (name.to_owned(), Var::from_tensor(&in_f64(var)).unwrap());
        Self {
            spec,
            sizes: spec.dense().unwrap(),
            vars: parameters.iter().map(double).collect(),
        }
    }

    /// Frames `[B, horizon, P]` and context `[B, context, P]` as predicted and reconstructed from frames `[B, context, P]`.
    /// `truth` `[B, horizon, F]` replaces the predictor's own features as its inputs.
    pub(crate) fn frames(
        &self,
        frames: &Tensor,
        condition: &ConditioningTensors,
        truth: Option<&Tensor>,
    ) -> Result<[Tensor; 2]> {
        let features = self.linear("frame_encoder", &in_f64(frames))?.tanh()?;
        let (mut state, mut outputs) = (self.zeros(features.dim(0)?)?, Vec::new());
        for t in 0..self.spec.context {
            state = self.step("encoder", &features.get_on_dim(1, t)?.contiguous()?, &state)?;
            outputs.push(state.h.clone());
        }
        let predicted = self.predict(&features, state.clone(), condition, truth)?;
        let again = self.reconstruct(&features, state, &outputs)?;
        Ok([
            self.linear("frame_decoder", &predicted)?,
            self.linear("frame_decoder", &again)?,
        ])
    }

    fn predict(
        &self,
        features: &Tensor,
        mut state: CellState,
        condition: &ConditioningTensors,
        truth: Option<&Tensor>,
    ) -> Result<Tensor> {
        let mut last = features.get_on_dim(1, self.spec.context - 1)?.contiguous()?;
        let mut predicted = Vec::new();
        for k in 0..self.spec.horizon {
            let mut inputs = vec![last.clone()];
            if self.spec.action_inputs().is_some() {
                let actions = condition.actions.as_ref().unwrap().get_on_dim(1, k)?;
                inputs.push(scaled(&actions, &self.spec.actions)?);
            }
            if self.spec.state_inputs().is_some() {
                inputs.push(scaled(condition.state.as_ref().unwrap(), &self.spec.states)?);
            }
            state = self.step("predictor", &Tensor::cat(&inputs, 1)?, &state)?;
            let output = self.linear("predictor.output", &state.h)?;
            let next = match self.sizes.predictor_output {
                PredictorOutput::Residual => (&last + output)?,
                PredictorOutput::Absolute => output,
            };
            last = match truth {
                Some(truth) => in_f64(&truth.get_on_dim(1, k)?.contiguous()?),
                None => next.clone(),
            };
            predicted.push(next);
        }
        Tensor::stack(&predicted, 1)
    }

    fn reconstruct(&self, features: &Tensor, last: CellState, outputs: &[Tensor]) -> Result<Tensor> {
        let mut again: Vec<Tensor> = Vec::new();
        let mut state = match self.sizes.reconstruction {
            Reconstruction::Sequence => last,
            Reconstruction::Stepwise => self.zeros(features.dim(0)?)?,
        };
        for output in outputs {
            let input = match (self.sizes.reconstruction, again.last()) {
                (Reconstruction::Stepwise, _) => output.clone(),
                (Reconstruction::Sequence, Some(previous)) => previous.clone(),
                (Reconstruction::Sequence, None) => features.get_on_dim(1, 0)?.zeros_like()?.contiguous()?,
            };
            state = self.step("reconstructor", &input, &state)?;
            again.push(self.linear("reconstructor.output", &state.h)?);
        }
        Tensor::stack(&again, 1)
    }

    fn linear(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        let [weight, bias] = ["weight", "bias"].map(|part| self.tensor(name, part));
        x.broadcast_matmul(weight)?.broadcast_add(bias)
    }

    fn step(&self, cell: &str, x: &Tensor, state: &CellState) -> Result<CellState> {
        step(|part| self.tensor(cell, part), x, state)
    }

    fn tensor(&self, layer: &str, part: &str) -> &Tensor {
        self.vars[&format!("{layer}.{part}")].as_tensor()
    }

    fn zeros(&self, batch: usize) -> Result<CellState> {
        let zeros = Tensor::zeros((batch, self.sizes.hidden), DType::F64, &Device::Cpu)?;
        Ok(CellState {
            h: zeros.clone(),
            c: zeros,
        })
    }
}

/// (values − mean) / std along the last dimension, in f64.
fn scaled(values: &Tensor, channels: &[ChannelScale]) -> Result<Tensor> {
    let row = |of: &dyn Fn(&ChannelScale) -> f32| {
        let row: Vec<f64> = channels.iter().map(|channel| f64::from(of(channel))).collect();
        Tensor::new(row, &Device::Cpu)
    };
    let std = row(&|channel| channel.std.max(MIN_CHANNEL_STD))?;
    in_f64(values)
        .broadcast_sub(&row(&|channel| channel.mean)?)?
        .broadcast_div(&std)
}

pub(crate) fn in_f64(tensor: &Tensor) -> Tensor {
    tensor.detach().to_dtype(DType::F64).unwrap()
}
