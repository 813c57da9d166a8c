//! The camera model of a data set, from a camera's `CameraInfo` and how its images are resized.

use super::messages::Projection;
use crate::dataset::import::camera::RecordedProjection;
use crate::dataset::import::options::ImportOptions;
use foreframe_core::frame::warp::CameraModel;

/// The camera model, if one can hold how the camera projects: without distortion (or in a topic of rectified images) and
/// with square pixels. `CameraInfo` does not say how the camera is tilted; it is taken to look straight ahead.
pub(super) fn model(projection: &Projection, topic: &str, options: &ImportOptions) -> Option<CameraModel> {
    let is_rectified = topic.contains("rect");
    let focal_px = if is_rectified {
        projection.rectified_focal_px
    } else {
        projection.focal_px
    };
    let is_usable = focal_px.iter().all(|&focal| focal > 0.0) && (is_rectified || !projection.is_distorted);
    if !is_usable || projection.width_px == 0 || projection.height_px == 0 {
        return None;
    }
    let recorded = RecordedProjection {
        width_px: projection.width_px,
        height_px: projection.height_px,
        focal_px,
    };
    CameraModel::new(recorded.resized_fov_rad(options)?, 0.0).ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::frame::resize::Resize;

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
