//! The camera model of the resized images, from that of the recorded ones.

use std::sync::atomic::AtomicBool;

use super::ImportError;
use super::options::ImportOptions;
use super::skipped::SkippedList;
use super::timing::ImportPlan;
use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::warp::CameraModel;

/// Focal lengths in columns and rows may differ by this share; a camera model has square pixels.
const SQUARE_TOLERANCE: f64 = 0.02;

/// How recorded images are projected, in pixels.
#[expect(clippy::struct_field_names, reason = "the unit")]
#[derive(Clone, Copy, Debug)]
pub(super) struct RecordedProjection {
    pub(super) width_px: u32,
    pub(super) height_px: u32,
    /// In columns and rows.
    pub(super) focal_px: [f64; 2],
}

impl RecordedProjection {
    /// The projection of images with square pixels.
    fn of_fov(fov_deg: f64, width_px: u32, height_px: u32) -> Self {
        let focal_px = f64::from(width_px) / 2.0 / (fov_deg.to_radians() / 2.0).tan();
        Self {
            width_px,
            height_px,
            focal_px: [focal_px; 2],
        }
    }

    /// The angle between the left and the right edge of the resized images, in radians; none if their pixels are not square.
    pub(super) fn resized_fov_rad(&self, options: &ImportOptions) -> Option<f32> {
        let [focal_x, focal_y] = self.focal_px;
        let (width, height) = (f64::from(self.width_px), f64::from(self.height_px));
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
        let is_square = (focal_y / focal_x / vertical_scale - 1.0).abs() <= SQUARE_TOLERANCE;
        is_square.then(|| (2.0 * (shown_width / (2.0 * focal_x)).atan()) as f32)
    }
}

/// What the options say of the camera replaces what the recording says. Errors: `Option` if a part of the camera is given but
/// its field of view is not known, or if images are stretched; those of the first image.
pub(super) fn describe(
    plan: &mut ImportPlan,
    options: &ImportOptions,
    cancelled: &AtomicBool,
) -> Result<(), ImportError> {
    if !options.describes_camera() {
        return Ok(());
    }
    let found = plan.recording.camera;
    let horizontal_fov_rad = match (options.fov_deg, found) {
        (Some(fov_deg), _) => match fov_of_frames(fov_deg, plan, options, cancelled)? {
            Some(fov_rad) => fov_rad,
            // Without any image, there will be no data set.
            None => return Ok(()),
        },
        (None, Some(found)) => found.horizontal_fov_rad,
        (None, None) => {
            return Err(ImportError::Option(
                "--tilt and --camera-height need --fov, since the recording does not say the camera's field of view"
                    .to_owned(),
            ));
        }
    };
    let tilt_rad = options.tilt_deg.map(|tilt_deg| tilt_deg.to_radians() as f32);
    let height_m = options.camera_height_m.map(|height_m| height_m as f32);
    let camera = CameraModel {
        horizontal_fov_rad,
        tilt_down_rad: tilt_rad.or(found.map(|found| found.tilt_down_rad)).unwrap_or(0.0),
        height_m: height_m.or(found.and_then(|found| found.height_m)),
    };
    let checked = camera.validate();
    checked.map_err(|error| ImportError::Option(format!("--fov does not fit the images: {error}")))?;
    plan.recording.camera = Some(camera);
    Ok(())
}

/// The field of view of the frames, in radians, where images of the first one's size have this one; none if no image can be
/// read. Errors: `Option` if the frames' pixels are not square; those of the images.
fn fov_of_frames(
    fov_deg: f64,
    plan: &ImportPlan,
    options: &ImportOptions,
    cancelled: &AtomicBool,
) -> Result<Option<f32>, ImportError> {
    let recording = &plan.recording;
    for frame in plan.episodes.iter().flatten() {
        match recording.images.read(&recording.records[frame.record], cancelled) {
            Ok(image) => {
                let projection = RecordedProjection::of_fov(fov_deg, image.width(), image.height());
                let stretched = || {
                    ImportError::Option(format!(
                        "--fov cannot describe images that are stretched from {}×{} to {}×{} px; resize them with crop or letterbox",
                        image.width(),
                        image.height(),
                        options.frame_width_px,
                        options.frame_height_px
                    ))
                };
                return projection.resized_fov_rad(options).map(Some).ok_or_else(stretched);
            }
            // The import itself lists it.
            Err(error) => error.leave_out(options.skip_bad, &mut SkippedList::default())?,
        }
    }
    Ok(None)
}
