//! The rays of a camera's pixels. Each step of each prediction needs them, mostly of the same few cameras, so a thread keeps those of
//! the last ones.
// A closure's vector instructions reach what is inlined into it, and only that.
#![allow(clippy::inline_always)]

use std::cell::RefCell;
use std::sync::Arc;

use super::camera::Viewer;
use crate::nn::ops::gathering::{OfPlaces, SAMPLED_TOGETHER};

/// Cameras whose rays a thread keeps.
const MOST_KEPT: usize = 6;
/// Pixels of the largest frames for which it does: their rays take 400 KB.
const MOST_PIXELS: usize = 1 << 14;

thread_local! {
    /// The camera used last is the last one.
    static KEPT: RefCell<Vec<ViewerRays>> = const { RefCell::new(Vec::new()) };
}

/// A camera with the ray of each of its pixels, which are computed once.
#[derive(Clone, Debug)]
pub(in crate::nn) struct ViewerRays {
    pub(in crate::nn) viewer: Viewer,
    pub(in crate::nn) rays: Arc<[[f32; 3]]>,
    /// The same, each axis on its own, and zeros after the last pixel.
    axes: Arc<[Vec<f32>; 3]>,
}

impl ViewerRays {
    /// The rays of that camera.
    pub(in crate::nn) fn of(viewer: Viewer) -> Self {
        if viewer.size().pixels() > MOST_PIXELS {
            return Self::new(viewer);
        }
        KEPT.with_borrow_mut(|kept| {
            let same = |other: &Self| other.viewer.size() == viewer.size() && other.viewer.camera() == viewer.camera();
            let found = match kept.iter().rposition(same) {
                Some(place) => kept.remove(place),
                None => Self::new(viewer),
            };
            if kept.len() == MOST_KEPT {
                kept.remove(0);
            }
            kept.push(found.clone());
            found
        })
    }

    fn new(viewer: Viewer) -> Self {
        let rays = viewer.rays();
        let axis = |axis: usize| {
            let mut values = Vec::with_capacity(rays.len() + SAMPLED_TOGETHER);
            values.extend(rays.iter().map(|ray| ray[axis]));
            values.resize(rays.len() + SAMPLED_TOGETHER, 0.0);
            values
        };
        Self {
            viewer,
            axes: Arc::new([axis(0), axis(1), axis(2)]),
            rays: rays.into(),
        }
    }

    /// The rays of neighbouring pixels, from one on, by axis.
    #[inline(always)]
    #[expect(clippy::expect_used, reason = "there are so many zeros after the last pixel")]
    pub(in crate::nn) fn together(&self, first: usize) -> [&OfPlaces; 3] {
        // Not `map`, which is not inlined.
        let [x, y, z] = &*self.axes;
        let x = x[first..].first_chunk().expect("a ray after the last pixel is a bug");
        let y = y[first..].first_chunk().expect("a ray after the last pixel is a bug");
        let z = z[first..].first_chunk().expect("a ray after the last pixel is a bug");
        [x, y, z]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::warp::CameraModel;
    use crate::nn::ops::sampling::ImageSize;

    fn viewer(tilt_rad: f32, width: usize) -> Viewer {
        let size = ImageSize { height: 4, width };
        Viewer::new(CameraModel::new(1.0, tilt_rad).unwrap(), size)
    }

    #[test]
    fn rays_are_kept_for_the_same_camera_and_size_only() {
        let kept = ViewerRays::of(viewer(0.2, 6));
        for other in [viewer(0.3, 6), viewer(0.2, 8)] {
            assert_eq!(*ViewerRays::of(other).rays, *other.rays());
        }
        assert!(Arc::ptr_eq(&ViewerRays::of(viewer(0.2, 6)).rays, &kept.rays));
    }

    #[test]
    fn a_thread_keeps_the_rays_of_a_bounded_number_of_cameras() {
        let first = ViewerRays::of(viewer(0.0, 6));
        for other in 1..=MOST_KEPT {
            ViewerRays::of(viewer(0.01 * other as f32, 6));
        }
        assert!(!Arc::ptr_eq(&ViewerRays::of(viewer(0.0, 6)).rays, &first.rays));
        assert_eq!(KEPT.with_borrow(Vec::len), MOST_KEPT);
        let large = viewer(0.0, MOST_PIXELS);
        assert!(!Arc::ptr_eq(&ViewerRays::of(large).rays, &ViewerRays::of(large).rays));
    }
}
