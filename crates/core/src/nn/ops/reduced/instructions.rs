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
    Avx512Halves,
    #[cfg(target_arch = "x86_64")]
    Avx512Bytes,
    #[cfg(target_arch = "x86_64")]
    Avx2Bytes,
    #[cfg(target_arch = "aarch64")]
    ArmBytes,
}

impl ReducedInstructions {
    /// Those of this processor for a precision, the fastest first.
    pub(super) fn all(precision: Precision) -> Vec<Self> {
        let each: &[(Self, Precision)] = &[
            #[cfg(target_arch = "x86_64")]
            (Self::Avx512Halves, Precision::Bf16),
            #[cfg(target_arch = "x86_64")]
            (Self::Avx512Bytes, Precision::Int8),
            #[cfg(target_arch = "x86_64")]
            (Self::Avx2Bytes, Precision::Int8),
            #[cfg(target_arch = "aarch64")]
            (Self::ArmBytes, Precision::Int8),
        ];
        let suitable = each
            .iter()
            .filter(|(instructions, of)| *of == precision && instructions.are_supported());
        suitable.map(|(instructions, _)| *instructions).collect()
    }

    fn are_supported(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Halves => Precision::Bf16.is_supported(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Bytes => Precision::Int8.is_supported(),
            // Those of four bytes at once.
            _ => multiplies_four_bytes(),
        }
    }

    /// Most vectors of outputs whose sums are kept in registers together.
    pub(super) fn most_vectors(self) -> usize {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Halves | Self::Avx512Bytes => 3,
            _ => 1,
        }
    }

    /// The largest byte of a weight.
    pub(super) fn most_of_weight(self) -> f32 {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Bytes => avx2::MOST_OF_WEIGHT,
            _ => 127.0,
        }
    }

    /// Computes a product. A processor without the instructions is a bug.
    #[expect(
        unsafe_code,
        reason = "only the processor can tell whether it has the instructions, and it is asked first"
    )]
    pub(super) fn multiply(self, product: ReducedProduct) {
        assert!(self.are_supported(), "{self:?} on this processor is a bug");
        // SAFETY: this processor has the instructions.
        unsafe {
            match self {
                #[cfg(target_arch = "x86_64")]
                Self::Avx512Halves => avx512::multiply_halves(product),
                #[cfg(target_arch = "x86_64")]
                Self::Avx512Bytes => avx512::multiply_bytes(product),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2Bytes => avx2::multiply_bytes(product),
                #[cfg(target_arch = "aarch64")]
                Self::ArmBytes => arm::multiply_bytes(product),
            }
        }
    }
}
