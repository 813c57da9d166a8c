//! What is imported, and how a recording is read.

use std::path::PathBuf;

use serde::Serialize;

use super::error::ImportError;
use foreframe_core::frame::resize::Resize;
use foreframe_core::frame::{FrameSize, MAX_SIDE_PX};
use foreframe_core::types::Channel;

/// In place of the names of actions or states: there are none.
const NONE: &str = "none";
/// The largest [`ImportOptions::every`].
const MAX_EVERY: usize = 1_000_000;

/// What to import, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportConfig {
    /// The recording: a folder of images, a Donkeycar tub, a `LeRobot` data set, a bag, a `NumPy` file, a video, or an archive of one
    /// of these.
    pub source: PathBuf,
    /// The data set's directory.
    pub out: PathBuf,
    /// How its records are read.
    pub options: ImportOptions,
    /// Disk space for what is decompressed before it is imported, an archive or frames, in MiB.
    pub disk_mib: u64,
    /// Maximum number of files in an archive.
    pub max_files: u64,
}

/// The default of [`ImportConfig::disk_mib`].
pub const DEFAULT_DISK_MIB: u64 = 16 << 10;

/// The default of [`ImportConfig::max_files`].
pub const DEFAULT_MAX_FILES: u64 = 1_000_000;

/// How a recording is read. All of it has defaults. With the feature `cli`, the fields are options of `foreframe import`, whose
/// help is what is written above them; the program sets width and height.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "cli", derive(clap::Args))]
pub struct ImportOptions {
    /// Width of the data set's frames in pixels
    #[cfg_attr(feature = "cli", arg(skip))]
    pub frame_width_px: u32,
    /// Height of the data set's frames in pixels
    #[cfg_attr(feature = "cli", arg(skip))]
    pub frame_height_px: u32,
    /// How images of another shape are resized: crop, letterbox or stretch
    #[cfg_attr(feature = "cli", arg(long, default_value = "crop"))]
    pub resize: Resize,
    /// Frames per second: of the data set or, where the source has no times, of the recording
    #[cfg_attr(feature = "cli", arg(long = "rate", value_name = "HZ"))]
    pub rate_hz: Option<f64>,
    /// Keep every Nth frame, 1 to 1000000
    // Actions in between are averaged.
    #[cfg_attr(feature = "cli", arg(long, value_name = "N", default_value_t = 1))]
    pub every: usize,
    /// The CSV file, if it is not the only one in the folder
    #[cfg_attr(feature = "cli", arg(long, value_name = "FILE"))]
    pub csv: Option<PathBuf>,
    /// The column, input, camera, array or topic with the images [default: found by name or type]
    #[cfg_attr(feature = "cli", arg(long, value_name = "NAME"))]
    pub image: Option<String>,
    /// The column or array with the times [default: found by name]; for a bag, `header` or `log` [default: header if near log]
    // In seconds, unless its name ends with _ms, _us or _ns.
    #[cfg_attr(feature = "cli", arg(long, value_name = "NAME"))]
    pub time: Option<String>,
    /// A component of the action, or a TOPIC or TOPIC:FIELD,FIELD of a bag; may be given many times; `none` leaves all out [default: found by name or type]
    #[cfg_attr(feature = "cli", arg(long = "action", value_name = "NAME"))]
    pub actions: Vec<String>,
    /// A component of the state, or a topic as for the action; may be given many times; `none` leaves all out [default: found by name or type]
    #[cfg_attr(feature = "cli", arg(long = "state", value_name = "NAME"))]
    pub states: Vec<String>,
    /// The unit of an action or state, as in speed=m/s; may be given many times
    #[cfg_attr(feature = "cli", arg(long = "unit", value_name = "NAME=UNIT"))]
    pub units: Vec<String>,
    /// For how long the last action and state of a bag hold
    #[cfg_attr(feature = "cli", arg(long = "hold", value_name = "SECONDS", default_value_t = 1.0))]
    pub hold_s: f64,
    /// The angle between the left and the right edge of the recorded images, 5 to 170 degrees [default: known from some bags]
    #[cfg_attr(feature = "cli", arg(long = "fov", value_name = "DEGREES"))]
    // Absent options are not written, so that imports begun by earlier versions of the program go on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fov_deg: Option<f64>,
    /// How far the camera looks down from the horizontal, -85 to 85 degrees [default: 0, if the field of view is known]
    #[cfg_attr(
        feature = "cli",
        arg(long = "tilt", value_name = "DEGREES", allow_negative_numbers = true)
    )]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tilt_deg: Option<f64>,
    /// Height of the camera above the floor, 0.01 to 10 metres
    #[cfg_attr(feature = "cli", arg(long = "camera-height", value_name = "METRES"))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera_height_m: Option<f64>,
    /// Leave out what is damaged and list it, instead of stopping there
    #[cfg_attr(feature = "cli", arg(long))]
    pub skip_bad: bool,
    /// Import the records of a Donkeycar tub that are marked as deleted, too
    #[cfg_attr(feature = "cli", arg(long))]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub include_deleted: bool,
}

impl Default for ImportOptions {
    fn default() -> Self {
        Self {
            frame_width_px: 64,
            frame_height_px: 64,
            resize: Resize::Crop,
            rate_hz: None,
            every: 1,
            csv: None,
            image: None,
            time: None,
            actions: Vec::new(),
            states: Vec::new(),
            units: Vec::new(),
            hold_s: 1.0,
            fov_deg: None,
            tilt_deg: None,
            camera_height_m: None,
            skip_bad: false,
            include_deleted: false,
        }
    }
}

/// Whether the names of actions or states say that there are none.
pub(super) fn are_none(names: &[String]) -> bool {
    matches!(names, [one] if one == NONE)
}

/// Width and height in pixels, written as in `64x64`. Errors: what would be right.
pub fn parse_size(text: &str) -> Result<FrameSize, &'static str> {
    let size = |(width, height): (&str, &str)| {
        Some(FrameSize {
            width: width.parse().ok()?,
            height: height.parse().ok()?,
        })
    };
    text.split_once('x')
        .and_then(size)
        .ok_or("write WIDTHxHEIGHT, as in 64x64")
}

impl ImportOptions {
    /// Errors: `Option` if an option names values that a source of frames alone cannot have.
    pub(super) fn names_no_values(&self, source: &str) -> Result<(), ImportError> {
        let named = [
            ("--csv", self.csv.is_some()),
            ("--image", self.image.is_some()),
            ("--time", self.time.is_some()),
            ("--action", !self.actions.is_empty() && !are_none(&self.actions)),
            ("--state", !self.states.is_empty() && !are_none(&self.states)),
        ];
        match named.iter().find(|(_, is_given)| *is_given) {
            None => Ok(()),
            Some((option, _)) => Err(ImportError::Option(format!(
                "{source} has only frames; leave out {option}"
            ))),
        }
    }

    /// Checks what can be checked without the source. Errors: `OptionValue`.
    pub fn validate(&self) -> Result<(), ImportError> {
        let (width, height) = (self.frame_width_px, self.frame_height_px);
        let sides = 1..=MAX_SIDE_PX;
        let bad_unit = self.units.iter().find(|unit| !unit.contains('='));
        let wrong = |option, value, right| Err(ImportError::OptionValue { option, value, right });
        if !(1..=MAX_EVERY).contains(&self.every) {
            return wrong("every", self.every.to_string(), format!("it must be 1 to {MAX_EVERY}"));
        }
        for (option, value, range, unit) in [
            ("rate", self.rate_hz, 0.01..=1000.0, "frames per second"),
            ("hold", Some(self.hold_s), 0.0..=3600.0, "seconds"),
            ("fov", self.fov_deg, 5.0..=170.0, "degrees"),
            ("tilt", self.tilt_deg, -85.0..=85.0, "degrees"),
            ("camera-height", self.camera_height_m, 0.01..=10.0, "metres"),
        ] {
            if let Some(value) = value.filter(|value| !range.contains(value)) {
                let right = format!("it must be {} to {} {unit}", range.start(), range.end());
                return wrong(option, value.to_string(), right);
            }
        }
        if !sides.contains(&width) || !sides.contains(&height) {
            let right = format!("each side must be 1 to {MAX_SIDE_PX} px");
            return wrong("size", format!("{width}x{height}"), right);
        }
        bad_unit.map_or(Ok(()), |unit| {
            let given = format!("\"{}\"", unit.escape_default());
            wrong("unit", given, "write NAME=UNIT, as in speed=m/s".to_owned())
        })
    }

    /// Whether they say something of the camera.
    pub(super) fn describes_camera(&self) -> bool {
        [self.fov_deg, self.tilt_deg, self.camera_height_m]
            .iter()
            .any(Option::is_some)
    }

    /// A channel with the unit that `--unit NAME=UNIT` gives it, or else with that of the source.
    pub(super) fn channel(&self, name: &str, unit: &str) -> Channel {
        let mut given = self.units.iter().filter_map(|unit| unit.split_once('='));
        let given = given.find(|(channel, unit)| *channel == name && !unit.is_empty());
        Channel::new(name, given.map_or(unit, |(_, unit)| unit))
    }
}
