//! What follows from a model's specification: its tensors, the number of its parameters and its cost.

use std::collections::BTreeMap;

use super::error::NnError;
use super::spec::{Architecture, MAX_PARAMETERS, ModelSpec, in_range};
use super::{dense, flow, sprites};

impl ModelSpec {
    /// Checks the range of every field, and the size of the model. Errors: `OutOfRange`, `NoChannels`, `ChannelScale`,
    /// `Camera`, `RecurrentActions`, `FrameSides`.
    pub fn validate(&self) -> Result<(), NnError> {
        self.check_fields()?;
        in_range(
            "number of parameters",
            self.parameter_count() as f64,
            1.0,
            MAX_PARAMETERS as f64,
        )
    }

    /// Name and shape of every trained tensor.
    #[must_use]
    pub fn tensor_shapes(&self) -> BTreeMap<String, Vec<usize>> {
        match &self.architecture {
            Architecture::Dense(sizes) => dense::tensor_shapes(self, sizes),
            Architecture::Flow(sizes) => flow::tensor_shapes(self, sizes),
            Architecture::Sprites(sizes) => sprites::tensor_shapes(self, sizes),
        }
    }

    /// Number of parameters, including the reconstructor's.
    #[must_use]
    pub fn parameter_count(&self) -> u64 {
        self.tensor_shapes()
            .values()
            .map(|shape| shape.iter().map(|&size| size as u64).product::<u64>())
            .sum()
    }

    /// Multiply–add operations with weights per predicted frame, rounded up: the products of all layers with their weights,
    /// with the cost of encoding the context divided by the horizon. A session keeps the features of earlier frames, so it
    /// computes less.
    #[must_use]
    pub fn multiply_adds_per_frame(&self) -> u64 {
        match &self.architecture {
            Architecture::Dense(sizes) => dense::multiply_adds_per_frame(self, sizes),
            Architecture::Flow(sizes) => flow::multiply_adds_per_frame(self, sizes),
            Architecture::Sprites(sizes) => sprites::multiply_adds_per_frame(self, sizes),
        }
    }
}
