//! The precision of products with weights in predictions. The program chooses it once, when it starts; without a choice it is single
//! precision. Trainings, and predictions on a graphics card, are always in single precision.

use std::sync::OnceLock;

use serde::{Deserialize, Serialize};

use super::error::NnError;
use crate::named_enum;

/// The chosen precision.
static CHOSEN: OnceLock<Precision> = OnceLock::new();

named_enum! {
    /// The numbers in which predictions multiply inputs with weights. A few layers take more bits. Sums of bytes
    /// are exact whole numbers; all else is in single precision.
    #[derive(Default, Serialize, Deserialize)]
    #[serde(try_from = "String", into = "String")]
    pub enum Precision {
        /// Single precision, 32 bits.
        #[default]
        F32 = "f32",
        /// bfloat16: 16 bits, of which 8 are the exponent.
        Bf16 = "bf16",
        /// Whole numbers of 8 bits with factors: one for each output of the weights, and one for each item of the inputs. With AVX2, weights
        /// have 7 bits.
        Int8 = "int8",
    }
    else |text| -> String { format!("unknown precision \"{text}\"; a precision is \"f32\", \"bf16\" or \"int8\"") }
}

impl Precision {
    /// Whether this processor multiplies such numbers. For bf16 and int8 it must have instructions for it: without them, these would be
    /// slower than single precision. With AVX2 and without AVX-512 VNNI, int8 is for dense networks only: the others stay in single
    /// precision.
    #[must_use]
    pub fn is_supported(self) -> bool {
        match self {
            Self::F32 => true,
            #[cfg(target_arch = "x86_64")]
            Self::Bf16 => has_avx512() && is_x86_feature_detected!("avx512bf16"),
            #[cfg(target_arch = "x86_64")]
            Self::Int8 => is_x86_feature_detected!("avx2"),
            #[cfg(target_arch = "aarch64")]
            Self::Int8 => multiplies_four_bytes(),
            #[cfg(not(target_arch = "x86_64"))]
            _ => false,
        }
    }

    /// The precision of layers for which 8 bits are too few, and of layers with few inputs and rows, where finding the scale of bytes takes
    /// as long as the products. A processor without bf16 takes single precision there.
    pub(super) fn at_least_bf16(self) -> Self {
        match self {
            Self::Int8 if Self::Bf16.is_supported() => Self::Bf16,
            Self::Int8 => Self::F32,
            Self::F32 | Self::Bf16 => self,
        }
    }

    /// The precision of convolutions, of the flow network's layers around its decoder and of those for the rays of a room. They stay in
    /// single precision unless one instruction adds up four products of bytes: tiles of places save more than AVX2's bytes.
    pub(super) fn of_convolutions(self) -> Self {
        match self {
            Self::Int8 if !multiplies_four_bytes() => Self::F32,
            Self::F32 | Self::Bf16 | Self::Int8 => self,
        }
    }

    /// Errors: `Precision` if this processor does not multiply such numbers.
    pub(super) fn check_support(self) -> Result<(), NnError> {
        if self.is_supported() {
            return Ok(());
        }
        let supported: Vec<String> = Self::ALL
            .into_iter()
            .filter(|precision| precision.is_supported())
            .map(|precision| format!("\"{precision}\""))
            .collect();
        let (instructions, supported) = (self.instructions(), supported.join(" or "));
        Err(self.refused(format!(
            "this processor has no {instructions}; it predicts in {supported}"
        )))
    }

    fn refused(self, reason: String) -> NnError {
        NnError::Precision {
            precision: self.to_string(),
            reason,
        }
    }

    /// What a processor needs for it.
    fn instructions(self) -> &'static str {
        match self {
            Self::F32 => "",
            Self::Bf16 => "AVX-512 BF16 (of x86-64)",
            Self::Int8 if cfg!(target_arch = "aarch64") => "dot products of bytes (ARM's \"asimddp\")",
            Self::Int8 => "AVX2",
        }
    }
}

impl TryFrom<String> for Precision {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Precision> for String {
    fn from(precision: Precision) -> Self {
        precision.to_string()
    }
}

/// Whether one instruction of this processor adds up four products of bytes: AVX-512 VNNI, or ARM's dot products. AVX-VNNI is not used.
pub(super) fn multiplies_four_bytes() -> bool {
    #[cfg(target_arch = "x86_64")]
    return has_avx512() && is_x86_feature_detected!("avx512vnni");
    #[cfg(target_arch = "aarch64")]
    return std::arch::is_aarch64_feature_detected!("dotprod");
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    false
}

/// Whether the processor has AVX-512, also for shorter vectors.
#[cfg(target_arch = "x86_64")]
fn has_avx512() -> bool {
    is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512vl")
}

/// Makes all models that are loaded from now on predict with it. Errors: `Precision` if this processor cannot, or another precision was
/// chosen before.
pub fn choose(precision: Precision) -> Result<(), NnError> {
    precision.check_support()?;
    let chosen = *CHOSEN.get_or_init(|| precision);
    if chosen != precision {
        return Err(precision.refused(format!("this process already predicts in \"{chosen}\"")));
    }
    Ok(())
}

/// The precision of models that are loaded now.
#[must_use]
pub fn current() -> Precision {
    CHOSEN.get().copied().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_precision_has_a_name() {
        for precision in Precision::ALL {
            assert_eq!(precision.to_string().parse(), Ok(precision));
        }
        for wrong in ["fp32", "INT8", "int4", ""] {
            assert!(wrong.parse::<Precision>().unwrap_err().contains(wrong));
        }
    }
}
