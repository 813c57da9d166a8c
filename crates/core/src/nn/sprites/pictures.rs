//! Pictures that are moved and laid over each other.

use candle_core::Tensor;

use super::layers::SPRITES;
use super::tents::tents;
use crate::nn::error::NnError;
use crate::nn::ops::sampling::ImageSize;

/// Pictures `[M, H, W]` (or `[M, T, H, W]`) at T places each, `[M, T, H, W]`: moved by `moves` and spread by `widths`, both `[M, T, 2]`.
pub(super) fn placed(pictures: &Tensor, moves: &Tensor, widths: &Tensor) -> Result<Tensor, NnError> {
    let (rows, times, _) = moves.dims3()?;
    let dims = pictures.dims();
    let (height, width) = (dims[dims.len() - 2], dims[dims.len() - 1]);
    let along = |axis: usize, side: usize| {
        let of_axis = [moves, widths].map(|values| values.narrow(2, axis, 1)?.reshape((rows * times, 1)));
        let [moves, widths] = of_axis;
        tents(&Tensor::cat(&[moves?, widths?], 1)?, side)
    };
    let (down, across) = (along(1, height)?, along(0, width)?);
    let moved = if pictures.rank() == 3 {
        down.reshape((rows, times * height, height))?
            .matmul(pictures)?
            .reshape((rows * times, height, width))?
    } else {
        down.matmul(&pictures.contiguous()?.reshape((rows * times, height, width))?)?
    };
    Ok(moved.matmul(&across.t()?)?.reshape((rows, times, height, width))?)
}

/// Both sprites `[2 N, T, H, W]` in one frame `[N, T, P]`.
pub(super) fn together(sprites: &Tensor, size: ImageSize) -> Result<Tensor, NnError> {
    let (rows, times, _, _) = sprites.dims4()?;
    let windows = rows / SPRITES;
    let of_sprite = |sprite: usize| {
        sprites
            .narrow(0, sprite * windows, windows)?
            .reshape((windows, times, size.pixels()))
    };
    united(&[of_sprite(0)?, of_sprite(1)?])
}

/// Light over light: `1 − (1 − a) · (1 − b)`. Where one is black, the other one shows.
pub(super) fn united([one, other]: &[Tensor; 2]) -> Result<Tensor, NnError> {
    Ok(((one + other)? - (one * other)?)?)
}

/// The values in reverse order along the second axis.
pub(super) fn reversed(values: &Tensor) -> candle_core::Result<Tensor> {
    let count = values.dim(1)? as u32;
    let order = Tensor::from_iter((0..count).rev(), values.device())?;
    values.contiguous()?.index_select(&order, 1)
}
