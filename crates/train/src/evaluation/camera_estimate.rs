//! Estimates the camera of a recording: the one with which a model that sees depth predicts its frames best.

use std::fmt::{self, Display, Formatter};
use std::sync::atomic::AtomicBool;

use super::EvaluationError;
use super::statistics::mean_and_deviation;
use super::window_errors::{window_errors, windows_of};
use super::windows::{evenly, window_shape};
use foreframe_core::frame::warp::CameraModel;
use foreframe_core::registry::Model;
use foreframe_data::dataset::Dataset;
use foreframe_data::dataset::sampler::{Split, first_seconds};

/// Training windows that are predicted with each camera.
const WINDOWS: usize = 48;
/// Fields of view that are tried first, in degrees.
const FIELDS_OF_VIEW: [f32; 5] = [50.0, 70.0, 90.0, 110.0, 130.0];
/// Tilts that are tried first, in degrees.
const TILTS: [f32; 5] = [-10.0, 0.0, 10.0, 20.0, 30.0];
/// What is tried around the best one: half of the distance between those before, of the field of view and of the tilt.
const FINER: [f32; 2] = [10.0, 5.0];
/// Standard errors by which the errors of another camera may differ for it to count as possible.
const POSSIBLE: f64 = 2.0;

/// A camera that was estimated.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraEstimate {
    /// The one with the least error.
    pub camera: CameraModel,
    /// Least and greatest field of view of the cameras that are as good as the windows can tell, in degrees.
    pub fields_of_view_deg: [f32; 2],
    /// The same of the tilt.
    pub tilts_deg: [f32; 2],
    /// Windows that were predicted with each camera.
    pub windows: usize,
}

impl Display for CameraEstimate {
    fn fmt(&self, formatter: &mut Formatter<'_>) -> fmt::Result {
        let ([narrowest, widest], [highest, lowest]) = (self.fields_of_view_deg, self.tilts_deg);
        write!(
            formatter,
            "estimated from {} windows: field of view {:.0}° ({narrowest:.0}° to {widest:.0}° fit as well), tilted down by {:.0}° \
             ({highest:.0}° to {lowest:.0}°)",
            self.windows,
            self.camera.horizontal_fov_rad.to_degrees(),
            self.camera.tilt_down_rad.to_degrees(),
        )
    }
}

/// One that was tried, with the error of each window.
struct TriedCamera {
    degrees: [f32; 2],
    errors: Vec<f64>,
}

impl TriedCamera {
    fn mean(&self) -> f64 {
        let [mean, _] = mean_and_deviation(self.errors.iter().copied());
        mean
    }

    /// Whether its errors may be no larger than those of the other.
    fn is_as_good_as(&self, best: &Self) -> bool {
        let differences = self.errors.iter().zip(&best.errors).map(|(a, b)| a - b);
        let [mean, deviation] = mean_and_deviation(differences);
        mean <= POSSIBLE * deviation / (self.errors.len() as f64).sqrt()
    }
}

/// The camera of a data set whose camera is not known, by its training windows of the first so many `seconds` (0 for all); `height_m` says in
/// which unit distances count. `None` if no window fits. Errors: `Mismatch`, `Cancelled`, those of the network and of
/// [`Dataset::pixels`].
pub fn estimate_camera(
    loaded: &Model,
    dataset: &Dataset,
    height_m: f32,
    seconds: f64,
    cancelled: &AtomicBool,
) -> Result<Option<CameraEstimate>, EvaluationError> {
    super::compatible::check(loaded, dataset)?;
    let (shape, period_s) = (window_shape(loaded.spec()), dataset.info().frame_period_s);
    let all = windows_of(loaded, dataset, Split::Train)?;
    let windows = evenly(&first_seconds(all, shape, period_s, seconds), WINDOWS);
    if windows.is_empty() {
        return Ok(None);
    }
    let camera = |[field, tilt]: [f32; 2]| CameraModel {
        horizontal_fov_rad: field.to_radians(),
        tilt_down_rad: tilt.to_radians(),
        height_m: Some(height_m),
    };
    let try_one = |degrees: [f32; 2]| -> Result<TriedCamera, EvaluationError> {
        let with_camera = dataset.clone().with_camera(camera(degrees));
        // Later steps say less: their pictures blur with any camera.
        let errors = window_errors(loaded, &with_camera, &windows, 1, cancelled)?;
        Ok(TriedCamera { degrees, errors })
    };
    let first = FIELDS_OF_VIEW
        .into_iter()
        .flat_map(|field| TILTS.map(|tilt| [field, tilt]));
    let mut tried = first.map(try_one).collect::<Result<Vec<_>, _>>()?;
    let [field, tilt] = best(&tried).degrees;
    for [more, down] in [
        [-1.0, 0.0],
        [1.0, 0.0],
        [0.0, -1.0],
        [0.0, 1.0],
        [-1.0, -1.0],
        [1.0, 1.0],
        [-1.0, 1.0],
        [1.0, -1.0],
    ] {
        tried.push(try_one([field + more * FINER[0], tilt + down * FINER[1]])?);
    }
    let best = best(&tried);
    let possible = tried.iter().filter(|other| other.is_as_good_as(best));
    let range = |part: usize| {
        let values = possible.clone().map(|other| other.degrees[part]);
        values.fold([f32::INFINITY, f32::NEG_INFINITY], |[least, most], value| {
            [least.min(value), most.max(value)]
        })
    };
    Ok(Some(CameraEstimate {
        camera: camera(best.degrees),
        fields_of_view_deg: range(0),
        tilts_deg: range(1),
        windows: windows.len(),
    }))
}

fn best(tried: &[TriedCamera]) -> &TriedCamera {
    let least = tried.iter().min_by(|a, b| a.mean().total_cmp(&b.mean()));
    least.expect("no camera that was tried is a bug")
}
