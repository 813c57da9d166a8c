//! Muon (Jordan et al. 2024, <https://kellerjordan.github.io/posts/muon/>): the update of a weight matrix is its momentum with
//! all singular values made about equal, so that no direction is learned much more slowly than the others.

use candle_core::{Device, Tensor, Var};

use super::OptimizerError;
use foreframe_core::nn::tensors::with_values;

/// Decay of the momentum.
const MOMENTUM: f32 = 0.95;
/// The polynomial whose repeated application brings singular values near 1 (a, b, c of a·x + b·x³ + c·x⁵), and how often.
const POLYNOMIAL: [f64; 3] = [3.4445, -4.7750, 2.0315];
const ITERATIONS: usize = 5;
/// Root mean square of an update at a learning rate of 1, about that of Adam's, so that both take similar learning rates
/// (Liu et al. 2025).
const UPDATE_SIZE: f64 = 0.2;
/// Keeps a momentum of zeros at zero.
const LEAST_NORM: f64 = 1e-12;
/// Layers of the flow network that are not hidden layers of its convolutional part.
const OTHER_FLOW_LAYERS: [&str; 5] = [
    "flow.scene.",
    "flow.motion.",
    "flow.modulation.",
    "flow.affine.",
    "flow.head.",
];
/// Layers of the sprite network: the hidden ones of its convolutional part, and those of its motion.
const SPRITE_LAYERS: [&str; 7] = [
    "sprites.halving.",
    "sprites.encoder.",
    "sprites.fine.",
    "sprites.content.first.",
    "sprites.content.second.",
    "sprites.memory.",
    "sprites.step.",
];

/// Whether Muon updates the tensor of that name: weights of most layers. Adam updates the others.
pub(super) fn applies_to(name: &str) -> bool {
    let is_one_of = |layers: &[&str]| layers.iter().any(|layer| name.starts_with(layer));
    let is_hidden = is_one_of(&SPRITE_LAYERS) || name.starts_with("flow.") && !is_one_of(&OTHER_FLOW_LAYERS);
    is_hidden && name.ends_with(".weight")
}

/// Updates a weight `[inputs, outputs]` and its momentum. The gradient is multiplied by `scale` first.
pub(super) fn update(
    var: &Var,
    gradient: &Tensor,
    scale: f32,
    momentum: &mut [f32],
    learning_rate: f64,
) -> Result<(), OptimizerError> {
    let (inputs, outputs) = var.dims2()?;
    let ahead = with_values(gradient, |gradient| -> Vec<f32> {
        let both = momentum.iter_mut().zip(gradient);
        both.map(|(momentum, gradient)| {
            let new = (1.0 - MOMENTUM) * scale * gradient;
            *momentum = MOMENTUM * *momentum + new;
            // Nesterov's look ahead.
            MOMENTUM * *momentum + new
        })
        .collect()
    })?;
    let ahead = Tensor::from_vec(ahead, (inputs, outputs), &Device::Cpu)?;
    let step = if inputs > outputs {
        orthogonal(&ahead.t()?.contiguous()?)?.t()?
    } else {
        orthogonal(&ahead)?
    };
    let size = learning_rate * UPDATE_SIZE * (inputs.max(outputs) as f64).sqrt();
    var.set(&(var.as_tensor().detach() - (step * size)?)?)?;
    Ok(())
}

/// A matrix `[n, m]`, n ≤ m, with all singular values brought near 1 (Newton–Schulz iterations).
fn orthogonal(matrix: &Tensor) -> Result<Tensor, OptimizerError> {
    let norm = f64::from(matrix.sqr()?.sum_all()?.to_scalar::<f32>()?).sqrt();
    let mut x = (matrix / (norm + LEAST_NORM))?;
    let [a, b, c] = POLYNOMIAL;
    for _ in 0..ITERATIONS {
        let square = x.matmul(&x.t()?)?;
        let factor = ((&square * b)? + (square.matmul(&square)? * c)?)?;
        x = ((&x * a)? + factor.matmul(&x)?)?;
    }
    Ok(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::types::Seed;

    /// Values −1 to 1 without a pattern.
    fn noise(shape: &[usize; 2], seed: u64) -> Tensor {
        use rand::Rng as _;
        let mut rng = Seed(seed).rng();
        let values: Vec<f32> = (0..shape[0] * shape[1]).map(|_| rng.random_range(-1.0..=1.0)).collect();
        Tensor::from_vec(values, shape.as_slice(), &Device::Cpu).unwrap()
    }

    #[test]
    fn rows_become_orthogonal_and_of_length_one() {
        let x = orthogonal(&noise(&[4, 32], 1)).unwrap();
        let products: Vec<Vec<f32>> = x.matmul(&x.t().unwrap()).unwrap().to_vec2().unwrap();
        for (row, products) in products.iter().enumerate() {
            for (column, product) in products.iter().enumerate() {
                let expected = if row == column { 0.7..1.3 } else { -0.3..0.3 };
                assert!(expected.contains(product), "{row}, {column}: {product}");
            }
        }
        let nothing = Tensor::zeros((3, 5), candle_core::DType::F32, &Device::Cpu).unwrap();
        assert_eq!(orthogonal(&nothing).unwrap().to_vec2::<f32>().unwrap(), [[0.0; 5]; 3]);
    }

    #[test]
    fn an_update_goes_downhill_with_the_promised_size() {
        for shape in [[18, 4], [4, 18]] {
            let var = Var::from_tensor(&noise(&shape, 2)).unwrap();
            let before = var.as_tensor().copy().unwrap();
            let gradient = noise(&shape, 3);
            let mut momentum = vec![0.0; 72];
            update(&var, &gradient, 1.0, &mut momentum, 0.1).unwrap();
            let change = (var.as_tensor() - before).unwrap();
            let slopes = change.mul(&gradient).unwrap();
            let slope: f32 = slopes.sum_all().unwrap().to_scalar().unwrap();
            assert!(slope < 0.0, "{slope}");
            let square: f32 = change.sqr().unwrap().mean_all().unwrap().to_scalar().unwrap();
            assert!((0.014..0.026).contains(&square.sqrt()), "{}", square.sqrt());
            assert!(momentum.iter().any(|value| *value != 0.0));
        }
    }

    #[test]
    fn hidden_layers_of_flow_and_sprite_networks_only() {
        for name in [
            "stem",
            "encoder.0.first",
            "mix",
            "advance",
            "decoder.0.second",
            "enlarge",
            "fine",
        ] {
            assert!(applies_to(&format!("flow.{name}.weight")), "{name}");
            assert!(!applies_to(&format!("flow.{name}.bias")), "{name}");
        }
        for name in ["scene.hidden", "motion.output", "modulation.inputs", "affine", "head"] {
            assert!(!applies_to(&format!("flow.{name}.weight")), "{name}");
        }
        for name in [
            "halving",
            "encoder.0.first",
            "fine",
            "content.second",
            "memory.inputs",
            "step.output",
        ] {
            assert!(applies_to(&format!("sprites.{name}.weight")), "{name}");
            assert!(!applies_to(&format!("sprites.{name}.bias")), "{name}");
        }
        for name in ["stem", "head", "content.output", "trust", "tracks", "enlarge"] {
            assert!(!applies_to(&format!("sprites.{name}.weight")), "{name}");
        }
        assert!(!applies_to("predictor.output.weight"));
    }
}
