//! Random initial weights of the codec, centred: each feature is 0 at the mean training frame, and the mean features give
//! the mean frame. Without that, the sum over thousands of bright pixels drives most tanh units into saturation, where they
//! do not learn.

use candle_core::Tensor;

use super::TrainError;
use foreframe_core::nn::Parameters;

/// Sets the codec's biases for `frames` and `targets` `[N, P]`. Errors: `Network` if the shapes do not match.
pub(super) fn centre(parameters: &Parameters, frames: &Tensor, targets: &Tensor) -> Result<(), TrainError> {
    let weight = parameters.require("frame_encoder.weight")?;
    let bias = frames
        .mean_keepdim(0)?
        .matmul(weight.as_tensor())?
        .neg()?
        .flatten_all()?;
    parameters.require("frame_encoder.bias")?.set(&bias)?;
    parameters.require("frame_decoder.bias")?.set(&targets.mean(0)?)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use foreframe_core::nn::{Architecture, DenseSpec, ModelSpec, Network};
    use foreframe_core::types::Seed;

    #[test]
    fn centred_units_are_not_saturated() {
        let spec = ModelSpec {
            frame_width_px: 32,
            frame_height_px: 32,
            architecture: Architecture::Dense(DenseSpec {
                features: 32,
                ..DenseSpec::default()
            }),
            ..ModelSpec::default()
        };
        // Bright frames with a small dark square each.
        let frames: Vec<f32> = (0..20 * 1024)
            .map(|pixel| if (pixel / 7 + pixel / 1024) % 9 == 0 { 0.1 } else { 0.95 })
            .collect();
        let frames = Tensor::from_vec(frames, (20, 1024), &Device::Cpu).unwrap();
        let parameters = Parameters::initialize(&spec, Seed(3)).unwrap();
        let largest = |parameters: &Parameters| {
            let model = Network::new(spec.clone(), parameters).unwrap();
            let features = model.encode_frames(&frames).unwrap();
            features.abs().unwrap().mean_all().unwrap().to_scalar::<f32>().unwrap()
        };
        let before = largest(&parameters);
        centre(&parameters, &frames, &frames).unwrap();
        let after = largest(&parameters);
        assert!(after < 0.6 * before, "{before} {after}");
    }
}
