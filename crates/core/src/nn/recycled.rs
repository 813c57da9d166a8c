//! Buffers of tensors that nobody reads any more. Each thread keeps some for its next tensors of the same size: a new buffer would be filled
//! with zeros, and the system's memory would be asked for again and again.

use std::cell::Cell;

use candle_core::{CpuStorage, InplaceOp1, Layout, Result, Tensor};

/// Buffers that a thread keeps.
const MOST_BUFFERS: usize = 16;
/// Values of the largest that it keeps: of 512 KiB, four times as large as those of frames of 64×64 px.
const MOST_VALUES: usize = 1 << 17;

thread_local! {
    static KEPT: Cell<Vec<Vec<f32>>> = const { Cell::new(Vec::new()) };
}

/// A buffer of that many values, whose contents are unspecified.
pub(super) fn buffer(length: usize) -> Vec<f32> {
    let mut kept = KEPT.take();
    let found = kept.iter().rposition(|buffer| buffer.len() == length);
    let found = found.map(|place| kept.remove(place));
    KEPT.set(kept);
    found.unwrap_or_else(|| vec![0.0; length])
}

/// Keeps the buffer of a tensor on the CPU, which is empty afterwards: to read it, or one that shares its buffer, would be a bug.
pub(super) fn recycle(tensor: &Tensor) -> Result<()> {
    tensor.inplace_op1(&Taking)
}

struct Taking;

impl InplaceOp1 for Taking {
    fn name(&self) -> &'static str {
        "recycle"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, _: &Layout) -> Result<()> {
        let CpuStorage::F32(values) = storage else {
            return Ok(());
        };
        let values = std::mem::take(values);
        if (1..=MOST_VALUES).contains(&values.len()) {
            let mut kept = KEPT.take();
            if kept.len() == MOST_BUFFERS {
                kept.remove(0);
            }
            kept.push(values);
            KEPT.set(kept);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;

    #[test]
    fn the_buffer_of_a_tensor_serves_the_next_one_of_its_size() {
        let tensor = Tensor::from_vec(vec![7.0f32; 12], (3, 4), &Device::Cpu).unwrap();
        recycle(&tensor).unwrap();
        assert_eq!(buffer(11), [0.0; 11]);
        assert_eq!(buffer(12), [7.0; 12]);
        assert_eq!(buffer(12), [0.0; 12]);
    }

    #[test]
    fn a_thread_keeps_a_bounded_number_of_buffers() {
        for length in 1..=MOST_BUFFERS + 1 {
            recycle(&Tensor::from_vec(vec![7.0f32; length], length, &Device::Cpu).unwrap()).unwrap();
        }
        assert_eq!((buffer(1), buffer(2)), (vec![0.0], vec![7.0; 2]));
        recycle(&Tensor::ones(MOST_VALUES + 1, candle_core::DType::F32, &Device::Cpu).unwrap()).unwrap();
        assert_eq!(buffer(MOST_VALUES + 1)[0].to_bits(), 0);
    }
}
