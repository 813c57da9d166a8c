//! What a pixel of a future frame shows: something that the last frame shows too, that only an earlier frame shows, that no frame
//! shows, or a robot. And the errors in each of these classes.

use serde::{Deserialize, Serialize};

use super::method::Method;
use super::replay::ReplayedView;
use foreframe_core::named_enum;

/// A point is hidden if what the frame shows there is nearer than the point by more than this share of the point's depth.
const DEPTH_TOLERANCE: f32 = 0.03;
/// A point's place in a frame is inside it from this depth on, in metres.
const NEAREST_M: f32 = 0.01;

named_enum! {
    /// What a pixel of a future frame shows, in the order of the tables.
    #[derive(Serialize, Deserialize)]
    #[serde(rename_all = "kebab-case")]
    pub enum PixelClass {
        /// Something that the last frame of the context shows too.
        LastFrame = "the last frame shows it",
        /// Something that only an earlier frame of the context shows.
        EarlierFrame = "only an earlier frame shows it",
        /// Something that no frame of the context shows.
        NeverSeen = "never seen",
        /// A robot.
        Robot = "robots",
    }
}

/// Errors by what a pixel shows, over all steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VisibilityScores {
    /// Windows whose pixels were classified.
    pub windows: usize,
    /// What the columns are: the order of the lists below.
    pub classes: Vec<PixelClass>,
    /// Share of the pixels in each class.
    pub shares: Vec<f64>,
    /// The errors of model and baselines.
    pub methods: Vec<VisibilityErrors>,
}

/// The errors of one row.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VisibilityErrors {
    /// Who predicted.
    pub method: Method,
    /// Mean squared error in each class; absent in a class without pixels.
    pub mse: Vec<Option<f64>>,
}

/// Pixels and sums of squared errors of a window, class by class.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct ClassSums {
    pub(super) pixels: [u64; PixelClass::ALL.len()],
    /// For each row of the tables.
    pub(super) errors: Vec<[f64; PixelClass::ALL.len()]>,
}

/// The scores of all windows; `None` if the simulator could not replay one of them.
pub(super) fn scores(methods: &[Method], windows: Vec<Option<ClassSums>>) -> Option<VisibilityScores> {
    let windows = windows.into_iter().collect::<Option<Vec<_>>>()?;
    let pixels = PixelClass::ALL.map(|class| windows.iter().map(|window| window.pixels[class as usize]).sum::<u64>());
    let all = pixels.iter().sum::<u64>() as f64;
    let mse = |row: usize, class: PixelClass| {
        let sum: f64 = windows.iter().map(|window| window.errors[row][class as usize]).sum();
        let pixels = pixels[class as usize];
        (pixels > 0).then(|| sum / pixels as f64)
    };
    let rows = methods.iter().enumerate().map(|(row, &method)| VisibilityErrors {
        method,
        mse: PixelClass::ALL.iter().map(|&class| mse(row, class)).collect(),
    });
    (!windows.is_empty()).then(|| VisibilityScores {
        windows: windows.len(),
        classes: PixelClass::ALL.to_vec(),
        shares: pixels.iter().map(|&pixels| pixels as f64 / all).collect(),
        methods: rows.collect(),
    })
}

/// What each pixel of a frame shows, after these views were seen, the last one last.
pub(super) fn classes(view: &ReplayedView, seen: &[ReplayedView]) -> Vec<PixelClass> {
    let [width, _] = view.camera.size_px();
    let pixels = view.depths_m.iter().zip(&view.robots).enumerate();
    let class = |(pixel, (&depth_m, &robot)): (usize, (&f32, &u8))| {
        if robot != 0 {
            return PixelClass::Robot;
        }
        let center = [(pixel % width) as f32 + 0.5, (pixel / width) as f32 + 0.5];
        let point_m = view.camera.point_m(center, depth_m);
        let Some((last, earlier)) = seen.split_last() else {
            return PixelClass::NeverSeen;
        };
        if shows(last, point_m) {
            PixelClass::LastFrame
        } else if earlier.iter().any(|view| shows(view, point_m)) {
            PixelClass::EarlierFrame
        } else {
            PixelClass::NeverSeen
        }
    };
    pixels.map(class).collect()
}

/// Whether a frame shows a point of the room: the point is inside of it, and not hidden at all four pixels around its place.
fn shows(view: &ReplayedView, point_m: [f32; 3]) -> bool {
    let [width, height] = view.camera.size_px();
    let depth_m = view.camera.depth_m(point_m);
    let Some([column, row]) = view.camera.project(point_m).filter(|_| depth_m > NEAREST_M) else {
        return false;
    };
    if !(0.0..=width as f32).contains(&column) || !(0.0..=height as f32).contains(&row) {
        return false;
    }
    // The pixels whose centers surround the place; a negative number becomes 0.
    let around = |place: f32, count: usize| [(place - 0.5) as usize, ((place + 0.5) as usize).min(count - 1)];
    let shown = around(row, height)
        .into_iter()
        .flat_map(|row| around(column, width).map(|column| view.depths_m[row * width + column]));
    shown.fold(0.0, f32::max) >= depth_m * (1.0 - DEPTH_TOLERANCE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_sim::camera::Camera;
    use foreframe_sim::{CameraConfig, PlanarPose, WorldConfig};

    /// A wall two metres ahead of a level camera at the origin, which looks along x from that place on y.
    fn view(y_m: f32, nearer: &[usize]) -> ReplayedView {
        let config = WorldConfig {
            frame_width_px: 16,
            frame_height_px: 16,
            ..WorldConfig::default()
        };
        let level = CameraConfig {
            tilt_down_rad: 0.0,
            ..config.camera
        };
        let pose = PlanarPose {
            x_m: 0.0,
            y_m,
            heading_rad: 0.0,
        };
        let depth = |pixel| if nearer.contains(&pixel) { 1.0 } else { 2.0 };
        ReplayedView {
            camera: Camera::new(&config, &level, pose),
            depths_m: (0..256).map(depth).collect(),
            robots: vec![0; 256],
        }
    }

    #[test]
    fn what_the_context_shows_is_told_apart_from_what_is_new() {
        let everything = classes(&view(0.0, &[]), &[view(0.0, &[])]);
        assert!(everything.iter().all(|&class| class == PixelClass::LastFrame));
        // One pixel is 2 · 2 m · tan(0.52) / 16 = 0.144 m wide; 4 pixels to the left of the last frame are new.
        let moved = classes(&view(0.577, &[]), &[view(0.0, &[])]);
        assert!(
            moved[..4].iter().all(|&class| class == PixelClass::NeverSeen),
            "{moved:?}"
        );
        assert!(
            moved[4..16].iter().all(|&class| class == PixelClass::LastFrame),
            "{moved:?}"
        );
        let before = classes(&view(0.577, &[]), &[view(0.6, &[]), view(0.0, &[])]);
        assert!(
            before[..4].iter().all(|&class| class == PixelClass::EarlierFrame),
            "{before:?}"
        );
    }

    #[test]
    fn what_something_nearer_hides_was_not_seen() {
        let hidden: Vec<usize> = (0..256).filter(|pixel| (6..10).contains(&(pixel % 16))).collect();
        let classes = classes(&view(0.0, &[]), &[view(0.0, &hidden)]);
        let of_row: Vec<PixelClass> = classes[..16].to_vec();
        // A pixel beside the edge is surrounded by one that shows it.
        assert!(
            of_row[7..9].iter().all(|&class| class == PixelClass::NeverSeen),
            "{of_row:?}"
        );
        assert!(
            of_row[..6]
                .iter()
                .chain(&of_row[10..])
                .all(|&class| class == PixelClass::LastFrame)
        );
    }

    #[test]
    fn a_robot_is_a_class_of_its_own() {
        let mut frame = view(0.0, &[]);
        frame.robots[3] = 2;
        assert_eq!(classes(&frame, &[view(0.0, &[])])[3], PixelClass::Robot);
    }

    #[test]
    fn errors_are_means_over_the_pixels_of_a_class() {
        let window = |pixels, errors| {
            Some(ClassSums {
                pixels,
                errors: vec![errors],
            })
        };
        let found = scores(
            &[Method::Model],
            vec![
                window([6, 0, 1, 1], [0.6, 0.0, 0.5, 0.1]),
                window([6, 0, 1, 1], [0.0, 0.0, 0.3, 0.3]),
            ],
        )
        .unwrap();
        assert_eq!(found.shares, [0.75, 0.0, 0.125, 0.125]);
        let expected = [Some(0.05), None, Some(0.4), Some(0.2)];
        let thousandths = |mse: &Option<f64>| mse.map(|mse| (1000.0 * mse).round());
        let found = &found.methods[0].mse;
        assert!(
            found.iter().map(thousandths).eq(expected.iter().map(thousandths)),
            "{found:?}"
        );
        assert!(scores(&[Method::Model], vec![None]).is_none() && scores(&[Method::Model], Vec::new()).is_none());
    }
}
