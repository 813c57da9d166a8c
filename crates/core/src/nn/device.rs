//! The device that networks compute on. The program chooses it once, when it starts; without a choice it is the CPU.

use std::fmt;
use std::str::FromStr;
use std::sync::OnceLock;

use candle_core::Device;
use serde::{Deserialize, Serialize};

use super::error::NnError;

/// The chosen device.
static CHOSEN: OnceLock<Device> = OnceLock::new();

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

/// Makes all networks that are built from now on compute there. Only the first choice counts. Errors: `Device` if this program cannot
/// use it.
pub fn choose(name: DeviceName) -> Result<(), NnError> {
    let device = open(name)?;
    CHOSEN.get_or_init(|| device);
    Ok(())
}

/// The device of new networks.
pub(super) fn current() -> Device {
    CHOSEN.get().cloned().unwrap_or(Device::Cpu)
}

fn open(name: DeviceName) -> Result<Device, NnError> {
    let DeviceName::Cuda(number) = name else {
        return Ok(Device::Cpu);
    };
    let refused = |reason: String| NnError::Device {
        device: name.to_string(),
        reason,
    };
    if !candle_core::utils::cuda_is_available() {
        let reason = "this program was built without CUDA; build it with `cargo build --release --features cuda`";
        return Err(refused(reason.to_owned()));
    }
    Device::new_cuda(number).map_err(|error| {
        // What follows the first line is a list of functions.
        let error = error.to_string();
        let error = error.lines().next().unwrap_or_default();
        refused(format!(
            "there is no such graphics card, or its driver does not work ({error}); `nvidia-smi` lists the cards"
        ))
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
    }
}
