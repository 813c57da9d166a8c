//! What is imported, and how a recording is read.

use std::fmt::Display;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::error::ImportError;
use foreframe_core::frame::MAX_SIDE_PX;
use foreframe_core::frame::fit::Fit;

/// The largest [`ImportOptions::every`].
const MAX_EVERY: usize = 1_000_000;

/// What to import, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportConfig {
    /// The recording: a folder of images, a Donkeycar tub, a `LeRobot` data set, a bag, a `NumPy` file or a video.
    pub source: PathBuf,
    /// The data set's directory.
    pub out: PathBuf,
    /// How its records are read.
    pub options: ImportOptions,
    /// Disk space for frames that are decompressed before they are imported, in MiB.
    pub disk_mib: u64,
}

/// The default of [`ImportConfig::disk_mib`].
pub const DEFAULT_DISK_MIB: u64 = 16 << 10;

/// How a recording is read. All of it has defaults.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ImportOptions {
    /// Width of the data set's frames in pixels.
    pub frame_width_px: u32,
    /// Height of the data set's frames in pixels.
    pub frame_height_px: u32,
    /// How images of another shape are fitted.
    pub fit: Fit,
    /// Frames per second of the data set. Without timestamps: of the recording. `None` keeps the recording's rate.
    pub rate_hz: Option<f64>,
    /// Keeps every Nth frame, 1 to 1,000,000; actions in between are averaged.
    pub every: usize,
    /// A CSV file with one line per image.
    pub csv: Option<PathBuf>,
    /// The CSV column, the array, or the bag's topic, of the images; by default the usual names.
    pub image: Option<String>,
    /// The CSV column of the time in seconds (or `_ms`, `_us`, `_ns` by its name). For a bag, `header` or `log`.
    pub time: Option<String>,
    /// Names of the action's components; by default those that the source marks as actions.
    pub actions: Vec<String>,
    /// Names of the state's components; by default those that the source marks as states.
    pub states: Vec<String>,
    /// Units as `NAME=UNIT`.
    pub units: Vec<String>,
    /// For how long, in seconds, the last action and state of a bag hold.
    pub hold_s: f64,
    /// Leaves out what is damaged, counts it and lists it, instead of stopping there.
    pub skip_bad: bool,
}

impl Default for ImportOptions {
    fn default() -> Self {
        Self {
            frame_width_px: 64,
            frame_height_px: 64,
            fit: Fit::Crop,
            rate_hz: None,
            every: 1,
            csv: None,
            image: None,
            time: None,
            actions: Vec::new(),
            states: Vec::new(),
            units: Vec::new(),
            hold_s: 1.0,
            skip_bad: false,
        }
    }
}

/// Width and height in pixels, written as in `64x64`. Errors: `OptionValue`.
pub fn parse_size(text: &str) -> Result<(u32, u32), ImportError> {
    let sides = text
        .split_once('x')
        .and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
    sides.ok_or_else(|| ImportError::OptionValue {
        option: "size",
        value: format!("\"{}\"", text.escape_default()),
        right: "write WIDTHxHEIGHT, as in 64x64".to_owned(),
    })
}

impl ImportOptions {
    /// Checks what can be checked without the source. Errors: `OptionValue`.
    pub fn validate(&self) -> Result<(), ImportError> {
        let wrong = |option, value: &dyn Display, right: &str| {
            Err(ImportError::OptionValue {
                option,
                value: value.to_string(),
                right: right.to_owned(),
            })
        };
        if !(1..=MAX_EVERY).contains(&self.every) {
            return wrong("every", &self.every, &format!("it must be 1 to {MAX_EVERY}"));
        }
        if let Some(rate) = self.rate_hz.filter(|rate| !(0.01..=1000.0).contains(rate)) {
            return wrong("rate", &rate, "it must be 0.01 to 1000 frames per second");
        }
        if !(0.0..=3600.0).contains(&self.hold_s) {
            return wrong("hold", &self.hold_s, "it must be 0 to 3600 seconds");
        }
        let (width, height) = (self.frame_width_px, self.frame_height_px);
        let sides = 1..=MAX_SIDE_PX;
        if !(sides.contains(&width) && sides.contains(&height)) {
            let right = format!("each side must be 1 to {MAX_SIDE_PX} px");
            return wrong("size", &format!("{width}x{height}"), &right);
        }
        if let Some(unit) = self.units.iter().find(|unit| !unit.contains('=')) {
            let given = format!("\"{}\"", unit.escape_default());
            return wrong("unit", &given, "write NAME=UNIT, as in speed=m/s");
        }
        Ok(())
    }

    /// The unit that `--unit NAME=UNIT` gives a channel; empty if none does.
    pub(super) fn unit(&self, name: &str) -> String {
        let mut given = self.units.iter().filter_map(|unit| unit.split_once('='));
        let found = given.find(|(channel, _)| *channel == name);
        found.map_or_else(String::new, |(_, unit)| unit.to_owned())
    }
}
