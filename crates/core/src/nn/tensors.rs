//! Converts between tensors and plain slices, for the fused operations of this crate.
// `pulp` compiles a closure with vector instructions; that includes only functions that are inlined into it.
#![allow(clippy::inline_always)]

use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, Layout, Result, Storage, Tensor, bail};

use crate::vectorized::vectorized;

/// The values of a contiguous f32 storage.
pub(super) fn slice<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (CpuStorage::F32(values), Some((from, to))) => Ok(&values[from..to]),
        _ => bail!("a fused operation needs contiguous f32 tensors"),
    }
}

/// Calls `read` with the values of an f32 tensor.
pub fn with_values<T>(tensor: &Tensor, read: impl FnOnce(&[f32]) -> T) -> Result<T> {
    let tensor = tensor.contiguous()?;
    let (storage, layout) = tensor.storage_and_layout();
    Ok(read(slice(on_cpu(&storage)?, layout)?))
}

/// The storage, if it is the CPU's.
pub(super) fn on_cpu(storage: &Storage) -> Result<&CpuStorage> {
    match storage {
        Storage::Cpu(storage) => Ok(storage),
        _ => bail!("a fused operation needs tensors on the CPU"),
    }
}

/// The product of two f32 matrices, which lie in these storages.
pub(super) fn product(
    (left, left_layout): (&CpuStorage, &Layout),
    (right, right_layout): (&CpuStorage, &Layout),
) -> Result<Vec<f32>> {
    let ((rows, inner), (_, columns)) = (left_layout.shape().dims2()?, right_layout.shape().dims2()?);
    match left.matmul(right, (1, rows, columns, inner), left_layout, right_layout)? {
        CpuStorage::F32(values) => Ok(values),
        _ => bail!("a fused operation needs f32 tensors"),
    }
}

/// The product of a matrix, given by its rows, with a tensor `[rows' length, columns]`.
pub(super) fn rows_times(rows: &[f32], matrix: &Tensor) -> Result<Vec<f32>> {
    let inner = matrix.dim(0)?;
    let layout = Layout::contiguous((rows.len() / inner, inner));
    let (storage, matrix_layout) = matrix.storage_and_layout();
    product(
        (&CpuStorage::F32(rows.to_vec()), &layout),
        (on_cpu(&storage)?, matrix_layout),
    )
}

/// Adds the column sums of `values` `[N, sums.len()]` to `sums`.
#[inline(always)]
pub(super) fn add_columns(sums: &mut [f32], values: &[f32]) {
    for row in values.chunks_exact(sums.len()) {
        for (sum, value) in sums.iter_mut().zip(row) {
            *sum += value;
        }
    }
}

/// As [`add_columns`], with vector instructions.
pub(super) fn sum_columns(sums: &mut [f32], values: &[f32]) {
    vectorized(
        #[inline(always)]
        || add_columns(sums, values),
    );
}
