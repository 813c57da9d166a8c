//! Settings of a world and their ranges.

use serde::{Deserialize, Serialize};

use super::arena;
use super::error::SimError;
use super::room_set::RoomSet;
use foreframe_core::frame::MAX_SIDE_PX;
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::named_enum;

/// Tb1's camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct CameraConfig {
    /// Height of the pinhole above the floor, in metres.
    #[cfg_attr(feature = "schema", schema(minimum = 0.15, maximum = 2.3))]
    pub height_m: f64,
    /// How far the camera looks down from the horizontal, in radians.
    #[cfg_attr(feature = "schema", schema(minimum = -1.2, maximum = 1.2))]
    pub tilt_down_rad: f64,
    /// Angle between the left and the right edge of the image, in radians.
    #[cfg_attr(feature = "schema", schema(minimum = 0.1, maximum = 2.8))]
    pub horizontal_fov_rad: f64,
    /// Standard deviation of the sensor's Gaussian noise, where black is 0 and white is 1.
    #[cfg_attr(feature = "schema", schema(minimum = 0, maximum = 1))]
    pub noise_std: f64,
}

impl CameraConfig {
    /// Checks a camera in a room of this height. Errors: `Setting` at the first field that is out of range.
    pub(super) fn validate(&self, room_height_m: f32) -> Result<(), SimError> {
        in_range("camera.height_m", self.height_m, 0.15, f64::from(room_height_m) - 0.1)?;
        in_range("camera.tilt_down_rad", self.tilt_down_rad, -1.2, 1.2)?;
        in_range("camera.horizontal_fov_rad", self.horizontal_fov_rad, 0.1, 2.8)?;
        in_range("camera.noise_std", self.noise_std, 0.0, 1.0)
    }

    /// How it projects, without its height.
    #[must_use]
    pub fn model(&self) -> CameraModel {
        CameraModel {
            horizontal_fov_rad: self.horizontal_fov_rad as f32,
            tilt_down_rad: self.tilt_down_rad as f32,
            height_m: None,
        }
    }

    /// How it projects, with its height.
    #[must_use]
    pub fn model_with_height(&self) -> CameraModel {
        CameraModel {
            height_m: Some(self.height_m as f32),
            ..self.model()
        }
    }
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self {
            height_m: 0.6,
            tilt_down_rad: 0.2,
            horizontal_fov_rad: std::f64::consts::FRAC_PI_3,
            noise_std: 1.0 / 255.0,
        }
    }
}

named_enum! {
    /// What the room looks like.
    #[derive(Default, Serialize, Deserialize)]
    #[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
    #[serde(rename_all = "lowercase")]
    pub enum Look {
        /// Walls, pillars and floor in shades of gray.
        #[default]
        Gray = "gray",
        /// Walls, pillars and floor are white, so that only the robots and their shadows stand out: bright, sparse frames as in
        /// the paper.
        Bright = "bright",
    }
    else |name| -> SimError { SimError::UnknownLook { name: name.to_owned() } }
}

impl Look {
    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
    fn is_gray(&self) -> bool {
        *self == Self::Gray
    }
}

/// Settings of a world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct WorldConfig {
    /// Width of a frame in pixels.
    #[cfg_attr(feature = "schema", schema(minimum = 1, maximum = 512))]
    pub frame_width_px: u32,
    /// Height of a frame in pixels.
    #[cfg_attr(feature = "schema", schema(minimum = 1, maximum = 512))]
    pub frame_height_px: u32,
    /// Seconds from one frame to the next.
    #[cfg_attr(feature = "schema", schema(minimum = 0.01, maximum = 2))]
    pub frame_period_s: f64,
    /// Tb1's camera. With `rooms`, each trial draws its own, and only `noise_std` counts.
    pub camera: CameraConfig,
    /// Time limit of a trial, in seconds. A trial has the frames before this time; the first frame is at 0 s.
    #[cfg_attr(feature = "schema", schema(minimum = 0.02, maximum = 3600))]
    pub max_duration_s: f64,
    /// What the room looks like.
    #[serde(skip_serializing_if = "Look::is_gray")]
    pub look: Look,
    /// The set from which each trial draws a room, a camera and robots of its own. Absent: all trials are in the same room.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rooms: Option<RoomSet>,
    /// Whether the state holds the true pose instead of the odometry's.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub true_pose: bool,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self {
            frame_width_px: 64,
            frame_height_px: 64,
            frame_period_s: 0.2,
            camera: CameraConfig::default(),
            max_duration_s: 8.0,
            look: Look::Gray,
            rooms: None,
            true_pose: false,
        }
    }
}

impl WorldConfig {
    /// Errors: `FrameSize` or `Setting` at the first field that is out of range, with its range.
    pub fn validate(&self) -> Result<(), SimError> {
        let sides = 1..=MAX_SIDE_PX;
        if !sides.contains(&self.frame_width_px) || !sides.contains(&self.frame_height_px) {
            return Err(SimError::FrameSize {
                width: self.frame_width_px,
                height: self.frame_height_px,
            });
        }
        in_range("frame_period_s", self.frame_period_s, 0.01, 2.0)?;
        self.camera.validate(arena::HEIGHT_M)?;
        in_range("max_duration_s", self.max_duration_s, 2.0 * self.frame_period_s, 3600.0)
    }

    /// Frames of a trial that runs until its time limit, including the first frame.
    #[must_use]
    pub fn frame_limit(&self) -> u64 {
        (self.max_duration_s / self.frame_period_s + 1e-6).floor() as u64
    }
}

/// Errors: `Setting` with the range if the value is out of range.
pub(super) fn in_range(name: &'static str, value: f64, min: f64, max: f64) -> Result<(), SimError> {
    if value.is_finite() && (min..=max).contains(&value) {
        return Ok(());
    }
    Err(SimError::Setting {
        name,
        value,
        rule: format!("a finite number from {min} to {max}"),
    })
}
