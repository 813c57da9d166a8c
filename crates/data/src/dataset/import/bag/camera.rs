//! The camera model of a data set, from a camera's `CameraInfo` and how its images are resized.

use super::messages::Projection;
use crate::dataset::import::options::ImportOptions;
use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::warp::CameraModel;

/// Focal lengths in columns and rows may differ by this share; a camera model has square pixels.
const SQUARE_TOLERANCE: f64 = 0.02;

/// The camera model, if one can hold how the camera projects: without distortion (or in a topic of rectified images) and
/// with square pixels. `CameraInfo` does not say how the camera is tilted; it is taken to look straight ahead.
pub(super) fn model(projection: &Projection, topic: &str, options: &ImportOptions) -> Option<CameraModel> {
    let is_rectified = topic.contains("rect");
    let [focal_x, focal_y] = if is_rectified {
        projection.rectified_focal_px
    } else {
        projection.focal_px
    };
    let is_usable = focal_x > 0.0 && focal_y > 0.0 && (is_rectified || !projection.is_distorted);
    if !is_usable || projection.width_px == 0 || projection.height_px == 0 {
        return None;
    }
    let (width, height) = (f64::from(projection.width_px), f64::from(projection.height_px));
    let aspect = f64::from(options.frame_width_px) / f64::from(options.frame_height_px);
    let shown_width = match options.resize {
        Resize::Crop => width.min(height * aspect),
        Resize::Letterbox => width.max(height * aspect),
        Resize::Stretch => width,
    };
    let vertical_scale = match options.resize {
        Resize::Stretch => width / (height * aspect),
        _ => 1.0,
    };
    if (focal_y / focal_x / vertical_scale - 1.0).abs() > SQUARE_TOLERANCE {
        return None;
    }
    CameraModel::new((2.0 * (shown_width / (2.0 * focal_x)).atan()) as f32, 0.0).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    const PROJECTION: Projection = Projection {
        width_px: 640,
        height_px: 480,
        focal_px: [320.0, 320.0],
        rectified_focal_px: [240.0, 240.0],
        is_distorted: false,
    };

    fn fov(projection: &Projection, topic: &str, resize: Resize) -> Option<f32> {
        let options = ImportOptions {
            resize,
            ..ImportOptions::default()
        };
        model(projection, topic, &options).map(|model| model.horizontal_fov_rad.to_degrees().round())
    }

    #[test]
    fn the_field_of_view_is_that_of_the_resized_image() {
        // 480 of 640 columns are kept: 2 · atan(240 / 320).
        assert_eq!(fov(&PROJECTION, "/image_raw", Resize::Crop), Some(74.0));
        assert_eq!(fov(&PROJECTION, "/image_raw", Resize::Letterbox), Some(90.0));
        assert_eq!(fov(&PROJECTION, "/image_raw", Resize::Stretch), None);
        assert_eq!(fov(&PROJECTION, "/image_rect", Resize::Crop), Some(90.0));
    }

    #[test]
    fn a_distorted_image_has_no_camera_model() {
        let distorted = Projection {
            is_distorted: true,
            ..PROJECTION
        };
        assert_eq!(fov(&distorted, "/image_raw", Resize::Crop), None);
        assert_eq!(fov(&distorted, "/image_rect", Resize::Crop), Some(90.0));
    }
}
