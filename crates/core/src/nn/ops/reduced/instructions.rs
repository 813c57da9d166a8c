//! Which instructions compute a product.

use super::ReducedProduct;
#[cfg(target_arch = "aarch64")]
use super::arm;
#[cfg(target_arch = "x86_64")]
use super::{avx2, avx512};
use crate::nn::precision::{Precision, multiplies_four_bytes};

/// Instructions that multiply reduced weights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ReducedInstructions {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "aarch64")]
    Arm,
}

impl ReducedInstructions {
    /// Those of this processor for a precision, the fastest first.
    pub(super) fn all(precision: Precision) -> Vec<Self> {
        let is_for_bytes = precision == Precision::Int8;
        let each = [
            #[cfg(target_arch = "x86_64")]
            (Self::Avx512, precision == Precision::Bf16 || multiplies_four_bytes()),
            #[cfg(target_arch = "x86_64")]
            (Self::Avx2, is_for_bytes),
            #[cfg(target_arch = "aarch64")]
            (Self::Arm, is_for_bytes && multiplies_four_bytes()),
        ];
        let supported = each.into_iter().filter(|(_, has)| precision.is_supported() && *has);
        supported.map(|(instructions, _)| instructions).collect()
    }

    /// Most vectors of outputs whose sums are kept in registers together.
    pub(super) fn most_vectors(self) -> usize {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => 3,
            _ => 1,
        }
    }

    /// The largest byte of a weight.
    pub(super) fn most_of_weight(self) -> f32 {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => avx2::MOST_OF_WEIGHT,
            _ => 127.0,
        }
    }

    pub(super) fn multiply(self, product: ReducedProduct) {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => avx512::multiply(product),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => avx2::multiply(product),
            #[cfg(target_arch = "aarch64")]
            Self::Arm => arm::multiply(product),
        }
    }
}
