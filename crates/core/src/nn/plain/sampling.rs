//! Bilinear sampling at places that lie between pixels, in two forms: by the pixels around each place, whose gradients go to the
//! places, and by matrix products, whose gradients go to the image. (On a graphics card, candle adds up the gradients of gathered
//! values one after another, which is slow.)

use candle_core::{DType, Device, Result, Tensor};

use crate::nn::ops::sampling::{ImageSize, own_places};

/// Places in images, K for each of M items.
#[derive(Clone, Debug)]
pub(in crate::nn) struct Places {
    /// Columns `[M, K]`, 0 at the first pixel's middle.
    pub(in crate::nn) x: Tensor,
    /// Rows `[M, K]`.
    pub(in crate::nn) y: Tensor,
}

impl Places {
    /// Each pixel's own place, once: `[1, P]`.
    pub(in crate::nn) fn own(size: ImageSize, device: &Device) -> Result<Self> {
        let places = Tensor::from_vec(own_places(size), (size.pixels(), 2), device)?
            .t()?
            .contiguous()?;
        Ok(Self {
            x: places.narrow(0, 0, 1)?,
            y: places.narrow(0, 1, 1)?,
        })
    }

    /// For so many items, where they are the same for all.
    pub(in crate::nn) fn of_items(&self, items: usize) -> Result<Self> {
        let all = |values: &Tensor| values.broadcast_as((items, values.dim(1)?))?.contiguous();
        Ok(Self {
            x: all(&self.x)?,
            y: all(&self.y)?,
        })
    }

    /// Without gradients.
    pub(in crate::nn) fn detach(&self) -> Self {
        Self {
            x: self.x.detach(),
            y: self.y.detach(),
        }
    }

    /// Both kinds of places, one after another.
    pub(in crate::nn) fn joined(&self, others: &Self) -> Result<Self> {
        Ok(Self {
            x: Tensor::cat(&[&self.x, &others.x], 1)?,
            y: Tensor::cat(&[&self.y, &others.y], 1)?,
        })
    }

    /// How far each lies outside the middles of the border's pixels: columns plus rows.
    pub(in crate::nn) fn outside(&self, size: ImageSize) -> Result<Tensor> {
        let beyond = |at: &Tensor, side: usize| {
            let middle = (side as f64 - 1.0) / 2.0;
            ((at - middle)?.abs()? - middle)?.relu()
        };
        beyond(&self.x, size.width)? + beyond(&self.y, size.height)?
    }

    /// 1 for places that lie at most `margin` outside the middles of the border's pixels in each direction, else 0.
    pub(in crate::nn) fn inside(&self, size: ImageSize, margin: f64) -> Result<Tensor> {
        let is_near = |at: &Tensor, side: usize| {
            let middle = (side as f64 - 1.0) / 2.0;
            (at - middle)?.abs()?.le(middle + margin)?.to_dtype(DType::F32)
        };
        is_near(&self.x, size.width)? * is_near(&self.y, size.height)?
    }

    /// The middles of the 4×4 blocks of places of all pixels `[M, P]`, as places on the grid of a quarter of the sides.
    pub(in crate::nn) fn coarse(&self, size: ImageSize) -> Result<Self> {
        let quarter = size.shrunk(4);
        let middles = |values: &Tensor| {
            let blocks = values.reshape(&[values.dim(0)?, quarter.height, 4, quarter.width, 4][..])?;
            let middle = blocks.narrow(2, 1, 2)?.narrow(4, 1, 2)?;
            let mean = middle.sum(4)?.sum(2)?.affine(0.25, 0.0)?;
            mean.affine(0.25, -1.5 / 4.0)?.flatten_from(1)
        };
        Ok(Self {
            x: middles(&self.x)?,
            y: middles(&self.y)?,
        })
    }
}

/// Each value, `most` if it is more. (Of a scalar, candle's `minimum` first makes a tensor on the device.)
pub(in crate::nn) fn at_most(values: &Tensor, most: f64) -> Result<Tensor> {
    values.affine(-1.0, most)?.relu()?.affine(-1.0, most)
}

/// Each value, `least` if it is less.
pub(in crate::nn) fn at_least(values: &Tensor, least: f64) -> Result<Tensor> {
    (values - least)?.relu()? + least
}

/// Each value, limited to 0 to `most`.
fn within(values: &Tensor, most: f64) -> Result<Tensor> {
    at_most(&values.relu()?, most)
}

/// Images of one channel `[M, P]` at places: `[M, K]`. Beyond the border, the border's pixel. Gradients go to the places only.
pub(in crate::nn) fn sample(images: &Tensor, size: ImageSize, places: &Places) -> Result<Tensor> {
    let (last_x, last_y) = (size.width as f64 - 1.0, size.height as f64 - 1.0);
    let (x, y) = (within(&places.x, last_x)?, within(&places.y, last_y)?);
    let left = at_most(&x.detach().floor()?, last_x - 1.0)?;
    let top = at_most(&y.detach().floor()?, last_y - 1.0)?;
    let (right, lower) = ((x - &left)?, (y - &top)?);
    let first = ((top * size.width as f64)? + left)?;
    let width = size.width as f64;
    let corners = [0.0, 1.0, width, width + 1.0].map(|step| first.affine(1.0, step));
    let [a, b, c, d] = corners;
    let corners = Tensor::cat(&[a?, b?, c?, d?], 1)?.to_dtype(DType::U32)?;
    let values = images.detach().contiguous()?.gather(&corners, 1)?;
    let count = right.dim(1)?;
    let corner = |index: usize| values.narrow(1, index * count, count);
    let between = |from: &Tensor, to: &Tensor, share: &Tensor| from + ((to - from)? * share)?;
    let upper = between(&corner(0)?, &corner(1)?, &right)?;
    let below = between(&corner(2)?, &corner(3)?, &right)?;
    between(&upper, &below, &lower)
}

/// The share of each of `side` columns (or rows) at the places' columns `[M, K]`: `[M, side, K]`.
fn shares(at: &Tensor, side: usize) -> Result<Tensor> {
    let own = Tensor::arange(0f32, side as f32, at.device())?.reshape((1, side, 1))?;
    let at = within(&at.detach(), side as f64 - 1.0)?.unsqueeze(1)?;
    at.broadcast_sub(&own)?.abs()?.affine(-1.0, 1.0)?.relu()
}

/// As [`sample`], but gradients go to the images only.
pub(in crate::nn) fn sample_tracked(images: &Tensor, size: ImageSize, places: &Places) -> Result<Tensor> {
    let images = images.reshape((images.dim(0)?, size.height, size.width))?;
    let of_rows = images.matmul(&shares(&places.x, size.width)?)?;
    (of_rows * shares(&places.y, size.height)?)?.sum(1)
}

/// Features `[M, C, h, w]` at places `[M, h · w]`: `[M, C, h, w]`. Zero where a place lies more than a pixel outside. Gradients go to the
/// features only.
pub(in crate::nn) fn sample_features(features: &Tensor, places: &Places) -> Result<Tensor> {
    let (_, _, height, width) = features.dims4()?;
    let size = ImageSize { height, width };
    let of_columns = shares(&places.x, width)?.unsqueeze(1)?;
    let of_rows = shares(&places.y, height)?.unsqueeze(2)?;
    let shares = of_rows.broadcast_mul(&of_columns)?.flatten(1, 2)?;
    let shares = shares.broadcast_mul(&places.inside(size, 1.0)?.detach().unsqueeze(1)?)?;
    features.flatten_from(2)?.matmul(&shares)?.reshape(features.shape())
}
