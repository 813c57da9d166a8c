//! The device that networks compute on. The program chooses it once, when it starts; without a choice it is the CPU. A graphics card is
//! opened when the first network is built, so that commands without networks need none.

use std::fmt;
use std::str::FromStr;
use std::sync::OnceLock;

use candle_core::{DType, Device, Tensor};
use serde::{Deserialize, Serialize};

use super::error::NnError;

/// The chosen device.
static CHOSEN: OnceLock<DeviceName> = OnceLock::new();
/// The graphics card, or why it cannot be used.
static CARD: OnceLock<Result<Device, String>> = OnceLock::new();

/// The name of a device: `cpu`, `cuda` or `cuda:N`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum DeviceName {
    /// The processor.
    #[default]
    Cpu,
    /// The NVIDIA graphics card of that number.
    Cuda(usize),
}

impl fmt::Display for DeviceName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Cuda(0) => f.write_str("cuda"),
            Self::Cuda(number) => write!(f, "cuda:{number}"),
        }
    }
}

impl FromStr for DeviceName {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = match text {
            "cpu" => return Ok(Self::Cpu),
            "cuda" => Some(0),
            _ => text.strip_prefix("cuda:").and_then(|number| number.parse().ok()),
        };
        let unknown = || format!("unknown device \"{text}\"; a device is \"cpu\", \"cuda\" or \"cuda:N\"");
        number.map(Self::Cuda).ok_or_else(unknown)
    }
}

impl TryFrom<String> for DeviceName {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<DeviceName> for String {
    fn from(name: DeviceName) -> Self {
        name.to_string()
    }
}

/// Makes all networks that are built from now on compute there. Errors: `Device` if this program is built without CUDA, or another device
/// was chosen before.
pub fn choose(name: DeviceName) -> Result<(), NnError> {
    if name != DeviceName::Cpu && !candle_core::utils::cuda_is_available() {
        let reason = "this program was built without CUDA; build it with `cargo build --release --features cuda`";
        return Err(refused(name, reason));
    }
    let chosen = *CHOSEN.get_or_init(|| name);
    if chosen != name {
        return Err(refused(name, &format!("this process already computes on \"{chosen}\"")));
    }
    Ok(())
}

/// The device of new networks. Errors: `Device` if it cannot be used.
pub(super) fn current() -> Result<Device, NnError> {
    match CHOSEN.get() {
        None | Some(DeviceName::Cpu) => Ok(Device::Cpu),
        Some(&name @ DeviceName::Cuda(number)) => {
            let card = CARD.get_or_init(|| open(number));
            card.clone().map_err(|reason| refused(name, &reason))
        }
    }
}

fn refused(name: DeviceName, reason: &str) -> NnError {
    NnError::Device {
        device: name.to_string(),
        reason: reason.to_owned(),
    }
}

/// Opens a card and computes something on it, since candle loads its kernels late. All threads share one queue of operations: candle's
/// own choice, one for each thread, does not order them.
fn open(number: usize) -> Result<Device, String> {
    let tried = || -> candle_core::Result<Device> {
        let device = Device::new_cuda_with_stream(number)?;
        let ones = Tensor::ones(1, DType::F32, &device)?;
        (&ones + &ones)?.to_vec1::<f32>()?;
        Ok(device)
    };
    tried().map_err(|error| {
        // What follows the first line is a list of functions.
        let error = error.to_string();
        let error = error.lines().next().unwrap_or_default();
        format!("the graphics card cannot be used ({error}); `nvidia-smi` lists the cards and what uses them")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_has_a_name() {
        for name in ["cpu", "cuda", "cuda:3"] {
            assert_eq!(name.parse::<DeviceName>().unwrap().to_string(), name);
        }
        assert_eq!("cuda:0".parse(), Ok(DeviceName::Cuda(0)));
        for wrong in ["gpu", "cuda:", "cuda:x", "CUDA", ""] {
            assert!(wrong.parse::<DeviceName>().unwrap_err().contains(wrong));
        }
    }

    #[cfg(not(feature = "cuda"))]
    #[test]
    fn a_program_without_cuda_says_how_to_build_it() {
        let error = choose(DeviceName::Cuda(0)).unwrap_err().to_string();
        assert!(
            error.contains("device is \"cuda\"") && error.contains("--features cuda"),
            "{error}"
        );
        // The refused choice counts for nothing.
        choose(DeviceName::Cpu).unwrap();
        choose(DeviceName::Cpu).unwrap();
    }
}
