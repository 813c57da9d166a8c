//! Moving pixels: sampling a frame at other places, and where a turning camera sees each of its new pixels in the old
//! picture.
//!
//! A grid holds one coordinate [column, row] per pixel, in pixels from the top left corner; the centre of the first pixel
//! is [0.5, 0.5].

use serde::{Deserialize, Serialize};

use super::FrameError;

/// Depths below this are treated as this deep, so that what is beside or behind the camera lands far outside the frame.
pub(crate) const MIN_DEPTH: f32 = 1e-3;

/// How a pinhole camera with square pixels projects. It looks ahead of the robot, tilted down.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(try_from = "UncheckedCameraModel")]
pub struct CameraModel {
    /// Angle between the left and the right edge of the image, in radians: above 0, below π.
    pub horizontal_fov_rad: f32,
    /// How far the camera looks down from the horizontal, in radians: above −π/2, below π/2.
    pub tilt_down_rad: f32,
    /// Height of the pinhole above the floor, in metres, above 0; none where it is not known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height_m: Option<f32>,
}

/// A camera model as it is read, before its ranges are checked.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct UncheckedCameraModel {
    horizontal_fov_rad: f32,
    tilt_down_rad: f32,
    #[serde(default)]
    height_m: Option<f32>,
}

impl TryFrom<UncheckedCameraModel> for CameraModel {
    type Error = FrameError;

    fn try_from(unchecked: UncheckedCameraModel) -> Result<Self, FrameError> {
        let model = Self {
            horizontal_fov_rad: unchecked.horizontal_fov_rad,
            tilt_down_rad: unchecked.tilt_down_rad,
            height_m: unchecked.height_m,
        };
        model.validate()?;
        Ok(model)
    }
}

impl CameraModel {
    /// What counts where nothing is known of a camera.
    pub(crate) const USUAL: Self = Self {
        horizontal_fov_rad: 1.05,
        tilt_down_rad: 0.2,
        height_m: Some(Self::USUAL_HEIGHT_M),
    };
    /// Height of a camera whose height is not known.
    pub(crate) const USUAL_HEIGHT_M: f32 = 0.3;

    /// A camera of that field of view and tilt, in radians, at an unknown height. Errors: `Camera` if one is out of range.
    pub fn new(horizontal_fov_rad: f32, tilt_down_rad: f32) -> Result<Self, FrameError> {
        let unchecked = UncheckedCameraModel {
            horizontal_fov_rad,
            tilt_down_rad,
            height_m: None,
        };
        unchecked.try_into()
    }

    /// Errors: `Camera` if the field of view or the tilt is out of range, `CameraHeight` if the height is.
    pub fn validate(&self) -> Result<(), FrameError> {
        use std::f32::consts::{FRAC_PI_2, PI};
        // NaN fails both comparisons.
        let fov_is_valid = self.horizontal_fov_rad > 0.0 && self.horizontal_fov_rad < PI;
        let tilt_is_valid = self.tilt_down_rad.abs() < FRAC_PI_2;
        if !(fov_is_valid && tilt_is_valid) {
            return Err(FrameError::Camera {
                horizontal_fov_rad: self.horizontal_fov_rad,
                tilt_down_rad: self.tilt_down_rad,
            });
        }
        match self.height_m {
            Some(height_m) if !(height_m.is_finite() && height_m > 0.0) => Err(FrameError::CameraHeight { height_m }),
            _ => Ok(()),
        }
    }
}

/// A camera that takes frames of some size: the ray of each pixel and the place of each point.
///
/// Rays and points are in the robot's axes (x ahead, y to the left, z up); their origin is the pinhole.
#[derive(Clone, Copy, Debug)]
pub struct CameraView {
    tilt_sin: f32,
    tilt_cos: f32,
    /// Size of a pixel at depth 1.
    pub(crate) pixel_size: f32,
    middle_column: f32,
    middle_row: f32,
}

impl CameraView {
    /// The view of that camera in frames of that size, in pixels.
    #[must_use]
    pub fn new(camera: CameraModel, width: usize, height: usize) -> Self {
        let (tilt_sin, tilt_cos) = camera.tilt_down_rad.sin_cos();
        Self {
            tilt_sin,
            tilt_cos,
            pixel_size: 2.0 * (camera.horizontal_fov_rad / 2.0).tan() / width as f32,
            middle_column: width as f32 / 2.0,
            middle_row: height as f32 / 2.0,
        }
    }

    /// The ray through the middle of a pixel; 1 long along the camera's axis.
    #[must_use]
    #[inline]
    pub fn ray(&self, column: usize, row: usize) -> [f32; 3] {
        let right = (column as f32 + 0.5 - self.middle_column) * self.pixel_size;
        let down = (row as f32 + 0.5 - self.middle_row) * self.pixel_size;
        [
            self.tilt_cos - down * self.tilt_sin,
            -right,
            -self.tilt_sin - down * self.tilt_cos,
        ]
    }

    /// The ray of each pixel of a frame of that size, row by row.
    pub fn rays(&self, width: usize, height: usize) -> impl Iterator<Item = [f32; 3]> + '_ {
        (0..height).flat_map(move |row| (0..width).map(move |column| self.ray(column, row)))
    }

    /// Depth of a point, and how far it lies below the camera's axis.
    #[inline]
    pub(crate) fn depth_and_down(&self, [ahead, _, up]: [f32; 3]) -> [f32; 2] {
        [
            self.tilt_cos * ahead - self.tilt_sin * up,
            -(self.tilt_sin * ahead + self.tilt_cos * up),
        ]
    }

    /// The place [column, row] of a point. One beside or behind the camera lies far outside the frame.
    #[must_use]
    #[inline]
    pub fn project(&self, point: [f32; 3]) -> [f32; 2] {
        let [depth, down] = self.depth_and_down(point);
        let scale = depth.max(MIN_DEPTH) * self.pixel_size;
        [self.middle_column - point[1] / scale, self.middle_row + down / scale]
    }
}

/// For each pixel of the view after the camera turned by `yaw_rad` about the vertical (counter-clockwise is positive),
/// its place in the view before: a grid of width · height coordinates, row by row.
#[must_use]
pub fn rotation_grid(camera: CameraModel, width: usize, height: usize, yaw_rad: f32) -> Vec<[f32; 2]> {
    let view = CameraView::new(camera, width, height);
    let (yaw_sin, yaw_cos) = yaw_rad.sin_cos();
    // Each ray after the turn, in the robot's axes then and in those before the turn.
    let place = |[ahead, left, up]: [f32; 3]| {
        view.project([yaw_cos * ahead - yaw_sin * left, yaw_sin * ahead + yaw_cos * left, up])
    };
    view.rays(width, height).map(place).collect()
}

/// Which points of a grid lie inside a frame of that size.
fn inside(width: usize, height: usize, grid: &[[f32; 2]]) -> Vec<bool> {
    let (width, height) = (width as f32, height as f32);
    grid.iter()
        .map(|&[column, row]| (0.0..=width).contains(&column) && (0.0..=height).contains(&row))
        .collect()
}

/// A frame's values (row by row, width · height of them) at the points of a grid, bilinear; outside the frame the nearest
/// edge counts. Beside them, which points lie inside.
#[must_use]
pub fn sample(values: &[f32], width: usize, height: usize, grid: &[[f32; 2]]) -> (Vec<f32>, Vec<bool>) {
    debug_assert_eq!(values.len(), width * height);
    let last_column = width.saturating_sub(1);
    let last_row = height.saturating_sub(1);
    let sampled = grid
        .iter()
        .map(|&[column, row]| {
            let x = (column - 0.5).clamp(0.0, last_column as f32);
            let y = (row - 0.5).clamp(0.0, last_row as f32);
            // The casts cut off.
            let (left, top) = (x as usize, y as usize);
            let (right, bottom) = ((left + 1).min(last_column), (top + 1).min(last_row));
            let (to_right, to_bottom) = (x - left as f32, y - top as f32);
            let upper = mix(values[top * width + left], values[top * width + right], to_right);
            let lower = mix(values[bottom * width + left], values[bottom * width + right], to_right);
            mix(upper, lower, to_bottom)
        })
        .collect();
    (sampled, inside(width, height, grid))
}

fn mix(from: f32, to: f32, share: f32) -> f32 {
    from + share * (to - from)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: CameraModel = CameraModel {
        horizontal_fov_rad: 1.0,
        tilt_down_rad: 0.2,
        height_m: None,
    };

    #[test]
    fn without_a_turn_every_pixel_stays() {
        let values: Vec<f32> = (0..48).map(|value| value as f32).collect();
        let grid = rotation_grid(CAMERA, 8, 6, 0.0);
        let (sampled, inside) = sample(&values, 8, 6, &grid);
        for (sampled, value) in sampled.iter().zip(&values) {
            assert!((sampled - value).abs() < 1e-4, "{sampled} {value}");
        }
        assert!(inside.iter().all(|&inside| inside));
    }

    #[test]
    fn a_turn_to_the_left_shows_what_was_further_left() {
        let grid = rotation_grid(CAMERA, 8, 6, 0.3);
        let (columns, inside) = (grid.iter().map(|point| point[0]), inside(8, 6, &grid));
        assert!(
            columns
                .zip(0..)
                .all(|(column, index)| column < (index % 8) as f32 + 0.5)
        );
        assert!(!inside[0] && inside[7]);
    }

    #[test]
    fn beyond_the_edge_the_edge_pixel_counts() {
        let (sampled, inside) = sample(&[1.0, 2.0, 3.0, 4.0], 2, 2, &[[-9.0, 0.5], [1.0, 1.0], [99.0, 99.0]]);
        assert_eq!((sampled, inside), (vec![1.0, 2.5, 4.0], vec![false, true, false]));
    }

    #[test]
    fn what_was_behind_the_camera_is_outside() {
        let grid = rotation_grid(CAMERA, 8, 6, std::f32::consts::PI);
        assert!(inside(8, 6, &grid).iter().all(|&inside| !inside));
    }

    #[test]
    fn a_camera_keeps_its_height_in_json() {
        let text = r#"{"horizontal_fov_rad":1.0,"tilt_down_rad":0.2,"height_m":0.3}"#;
        let camera: CameraModel = serde_json::from_str(text).unwrap();
        assert_eq!(camera.height_m, Some(0.3));
        assert_eq!(serde_json::to_string(&camera).unwrap(), text);
        assert!(!serde_json::to_string(&CAMERA).unwrap().contains("height_m"));
        let error = serde_json::from_str::<CameraModel>(&text.replace("0.3", "-1")).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the camera is at a height of -1 m; it must be a finite number above 0"
        );
    }

    #[test]
    fn an_impossible_camera_is_refused_in_one_sentence() {
        for (fov, tilt) in [
            (0.0, 0.2),
            (3.2, 0.2),
            (f32::NAN, 0.2),
            (1.0, -1.6),
            (1.0, f32::INFINITY),
        ] {
            assert!(CameraModel::new(fov, tilt).is_err(), "{fov} {tilt}");
        }
        let error =
            serde_json::from_str::<CameraModel>(r#"{"horizontal_fov_rad": 4, "tilt_down_rad": 0.2}"#).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the camera model has a field of view of 4 rad and a tilt of 0.2 rad; the field of view must be above 0 and \
             below π, the tilt above -π/2 and below π/2"
        );
    }
}
