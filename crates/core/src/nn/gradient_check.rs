//! Gradients of our own operations against finite differences, in f32.

use candle_core::{Device, Result, Tensor, Var};

/// Values −1 to 1 without a pattern, the same for the same seed.
pub fn noise(shape: &[usize], seed: u64) -> Tensor {
    use rand::Rng;
    let mut rng = crate::types::Seed(seed).rng();
    let values: Vec<f32> = (0..shape.iter().product())
        .map(|_| 2.0 * rng.random::<f32>() - 1.0)
        .collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

/// All values, row by row.
pub(super) fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

/// Compares the gradients of a weighted sum of the operation's outputs with central differences of step `step`.
pub(super) fn assert_gradients(inputs: &[Tensor], step: f32, operation: impl Fn(&[Tensor]) -> Result<Tensor>) {
    let vars: Vec<Var> = inputs.iter().map(|input| Var::from_tensor(input).unwrap()).collect();
    let tensors: Vec<Tensor> = vars.iter().map(|var| var.as_tensor().clone()).collect();
    let out = operation(&tensors).unwrap();
    let weights = noise(out.dims(), 99);
    let value = |inputs: &[Tensor]| -> f64 {
        let (out, weights) = (values(&operation(inputs).unwrap()), values(&weights));
        let products = out.iter().zip(&weights).map(|(a, b)| f64::from(*a) * f64::from(*b));
        products.sum()
    };
    let gradients = (out * &weights).unwrap().sum_all().unwrap().backward().unwrap();
    for (index, var) in vars.iter().enumerate() {
        let found = values(gradients.get(var.as_tensor()).unwrap());
        let base = values(&inputs[index]);
        let largest = found.iter().fold(0.0f32, |most, value| most.max(value.abs()));
        for place in (0..base.len()).step_by(base.len().div_ceil(40)) {
            let shifted = |by: f32| {
                let mut shifted = base.clone();
                shifted[place] += by;
                let mut all: Vec<Tensor> = inputs.to_vec();
                all[index] = Tensor::from_vec(shifted, inputs[index].dims(), &Device::Cpu).unwrap();
                value(&all)
            };
            let expected = ((shifted(step) - shifted(-step)) / (2.0 * f64::from(step))) as f32;
            let error = (found[place] - expected).abs();
            assert!(
                error < 0.02 * largest.max(0.05),
                "input {index}, value {place}: gradient {}, by differences {expected}",
                found[place]
            );
        }
    }
}
