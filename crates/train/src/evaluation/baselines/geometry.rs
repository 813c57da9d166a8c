//! The last frame warped as a camera at a known height sees it that moves as commanded, over a flat floor and towards a wall
//! around it: at one distance for all frames, or at distances found in the input frames (plane sweep).

mod floor_view;
mod odometry;
mod sweep;

use foreframe_core::frame::quality::mse;
use foreframe_core::frame::warp::sample;
use foreframe_data::dataset::sampler::WindowShape;
use foreframe_data::dataset::{Dataset, Window};
use rayon::prelude::*;

use self::floor_view::FloorView;
use self::odometry::PoseChannels;
use super::commanded_motion::{CommandedMotion, ORIGIN};
use super::input::BaselineInput;
use crate::evaluation::EvaluationError;
use crate::evaluation::windows::{evenly, true_frame};

/// Windows that the wall's distance is fitted to at most, evenly spread.
const MAX_WINDOWS: usize = 200;
/// Distance of the wall where there is no training window to fit it to, in metres.
const DEFAULT_WALL_M: f32 = 2.0;
/// Nearest wall that is looked for, in metres.
const NEAREST_WALL_M: f32 = 0.5;
/// Ratio of a distance of the wall to the next one that is looked for.
const WALL_RATIO: f32 = 1.2;
/// Number of distances that are looked for.
const WALLS: usize = 18;

/// The distances of the wall that are looked for, in metres, increasing.
fn walls_m() -> [f32; WALLS] {
    std::array::from_fn(|index| NEAREST_WALL_M * WALL_RATIO.powi(index as i32))
}

/// Where the wall stands.
#[derive(Clone, Copy)]
pub(super) enum WallDistance {
    /// At the distance that fits the training split best.
    Fitted,
    /// In each column of the last frame, where the earlier frames show it.
    Swept,
}

/// A floor and a wall in front of a moving camera.
pub(super) struct Geometry {
    width: usize,
    height: usize,
    motion: CommandedMotion,
    /// Where the states hold a pose.
    odometry: Option<PoseChannels>,
    wall_m: f32,
}

impl Geometry {
    /// None unless the camera's height is known in every episode and the actions command speeds in m/s and rad/s. The wall's
    /// distance is fitted to the windows. Errors: those of [`Dataset::pixels`].
    pub(super) fn fit(
        dataset: &Dataset,
        windows: &[Window],
        shape: WindowShape,
    ) -> Result<Option<Self>, EvaluationError> {
        let info = dataset.info();
        let has_height = |episode| dataset.camera(episode).is_some_and(|camera| camera.height_m.is_some());
        let motion = CommandedMotion::of(info).filter(CommandedMotion::commands_translation);
        let (Some(motion), true) = (
            motion,
            dataset.episodes().iter().all(|episode| has_height(episode.index)),
        ) else {
            return Ok(None);
        };
        let mut geometry = Self {
            width: info.frame_width_px as usize,
            height: info.frame_height_px as usize,
            motion,
            odometry: PoseChannels::of(&info.state_channels),
            wall_m: DEFAULT_WALL_M,
        };
        let errors = evenly(windows, MAX_WINDOWS)
            .into_par_iter()
            .map(|window| geometry.errors(dataset, window, shape))
            .try_reduce(
                || [0.0; WALLS],
                |one, other| Ok(std::array::from_fn(|wall| one[wall] + other[wall])),
            )?;
        if !windows.is_empty() {
            let best = errors
                .iter()
                .zip(walls_m())
                .min_by(|one, other| one.0.total_cmp(other.0));
            geometry.wall_m = best.map_or(DEFAULT_WALL_M, |(_, wall_m)| wall_m);
        }
        Ok(Some(geometry))
    }

    /// Whether the past motion of the camera is known, so that its frames can be compared.
    pub(super) fn can_sweep(&self) -> bool {
        self.odometry.is_some()
    }

    /// One frame for each action of the input; none where the camera's height is not known.
    pub(super) fn predict(&self, input: &BaselineInput, last: &[f32], wall: WallDistance) -> Vec<Vec<f32>> {
        let Some(view) = self.view(input) else {
            return Vec::new();
        };
        let walls_m = match (wall, self.odometry) {
            (WallDistance::Swept, Some(channels)) => {
                let earlier = input.inputs.iter().zip(&input.past_states);
                let seen = earlier.map(|(frame, state)| sweep::EarlierFrame {
                    values: frame,
                    pose: channels.motion(input.state, state),
                });
                sweep::walls_m(&view, last, &seen.collect::<Vec<_>>(), self.wall_m)
            }
            _ => vec![self.wall_m; self.width],
        };
        self.warp(&view, input, last, &walls_m)
    }

    fn view(&self, input: &BaselineInput) -> Option<FloorView> {
        FloorView::new(input.camera?, self.width, self.height)
    }

    /// The last frame as the camera sees it at each predicted frame, for a wall at these distances in its columns.
    fn warp(&self, view: &FloorView, input: &BaselineInput, last: &[f32], walls_m: &[f32]) -> Vec<Vec<f32>> {
        let seen_at = |pose| {
            if pose == ORIGIN {
                return last.to_vec();
            }
            sample(last, self.width, self.height, &view.places_in_last(pose, walls_m)).0
        };
        self.motion.poses(input).into_iter().map(seen_at).collect()
    }

    /// The sum of the steps' errors in a window, for each distance of the wall.
    fn errors(&self, dataset: &Dataset, window: Window, shape: WindowShape) -> Result<[f64; WALLS], EvaluationError> {
        let last = true_frame(dataset, window.first_frame + shape.context - 1)?;
        let truth = (shape.context..shape.frames())
            .map(|step| true_frame(dataset, window.first_frame + step))
            .collect::<Result<Vec<_>, _>>()?;
        let input = BaselineInput::of_window(dataset, window, shape, &[]);
        let Some(view) = self.view(&input) else {
            return Ok([0.0; WALLS]);
        };
        Ok(walls_m().map(|wall_m| {
            let predicted = self.warp(&view, &input, &last, &vec![wall_m; self.width]);
            let steps = predicted.iter().zip(&truth);
            steps.map(|(predicted, truth)| mse(predicted, truth)).sum()
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::baselines::ego_motion::CameraTurn;
    use foreframe_core::frame::preprocess::scale;
    use foreframe_core::frame::warp::CameraModel;
    use foreframe_core::types::{Action, Channel, Seed};
    use foreframe_data::dataset::{DatasetInfo, EpisodeData};
    use foreframe_sim::{RoomSet, Scenario, World, WorldConfig, action_channels, state_channels};

    const SHAPE: WindowShape = WindowShape { context: 3, horizon: 3 };
    const FRAMES: usize = SHAPE.context + SHAPE.horizon;

    /// One trial in a room of its own: Tb1 drives a bend.
    fn driven(trial: u64) -> Dataset {
        let mut config = WorldConfig {
            rooms: Some(RoomSet::Varied),
            ..WorldConfig::default()
        };
        config.camera.noise_std = 0.0;
        let mut world = World::new(Scenario::MovingObserver, &config, Seed(8), trial).unwrap();
        let mut data = EpisodeData {
            trial: Some(world.parameters().clone()),
            ..EpisodeData::default()
        };
        for frame in 0..FRAMES {
            let seen = world.observe();
            data.timestamps_s.push(frame as f64 * config.frame_period_s);
            data.pixels.extend_from_slice(seen.frame.pixels());
            data.states.extend_from_slice(seen.state.as_slice());
            let action = [0.5, 0.4];
            data.actions.extend(action);
            world.step(&Action::try_from(action.to_vec()).unwrap()).unwrap();
        }
        let info = DatasetInfo {
            scenario: Some(Scenario::MovingObserver.to_string()),
            world: Some(config),
            ..described(action_channels())
        };
        Dataset::from_episodes(info, vec![data]).unwrap()
    }

    fn described(action_channels: Vec<Channel>) -> DatasetInfo {
        DatasetInfo {
            name: "driven".to_owned(),
            frame_width_px: 64,
            frame_height_px: 64,
            frame_period_s: 0.2,
            action_channels,
            state_channels: state_channels(),
            ..DatasetInfo::default()
        }
    }

    const WINDOW: Window = Window {
        episode: 0,
        first_frame: 0,
    };

    /// Mean square difference over the pixels whose rays meet the floor within 1.2 m.
    fn floor_error(dataset: &Dataset, predicted: &[f32], frame: usize) -> f64 {
        let camera = dataset.camera(0).unwrap();
        let truth = scale(&dataset.pixels(frame).unwrap());
        let view = foreframe_core::frame::warp::CameraView::new(camera, 64, 64);
        let is_floor = |pixel: usize| {
            let [x, y, up] = view.ray(pixel % 64, pixel / 64);
            up < 0.0 && x.hypot(y) * camera.height_m.unwrap() / -up < 1.2
        };
        let floor = |values: &[f32]| -> Vec<f32> {
            let pixels = values.iter().enumerate().filter(|(pixel, _)| is_floor(*pixel));
            pixels.map(|(_, &value)| value).collect()
        };
        mse(&floor(predicted), &floor(&truth))
    }

    #[test]
    fn the_floor_moves_as_the_simulated_camera_sees_it() {
        let (mut warped, mut turned) = (0.0, 0.0);
        for trial in 0..12 {
            let dataset = driven(trial);
            let last = scale(&dataset.pixels(SHAPE.context - 1).unwrap());
            let inputs: Vec<Vec<f32>> = (0..SHAPE.context)
                .map(|frame| scale(&dataset.pixels(frame).unwrap()))
                .collect();
            let input = BaselineInput::of_window(&dataset, WINDOW, SHAPE, &inputs);
            let geometry = Geometry::fit(&dataset, &[], SHAPE).unwrap().unwrap();
            let of_wall = geometry.predict(&input, &last, WallDistance::Fitted);
            let of_turn = CameraTurn::of(&dataset).unwrap().predict(&input, &last);
            let step = SHAPE.horizon - 1;
            warped += floor_error(&dataset, &of_wall[step], FRAMES - 1);
            turned += floor_error(&dataset, &of_turn[step], FRAMES - 1);
        }
        assert!(warped < 0.5 * turned, "{warped} {turned}");
    }

    #[test]
    fn without_a_height_or_a_commanded_speed_there_is_no_geometry() {
        let fitted = |info: DatasetInfo| {
            let data = EpisodeData {
                timestamps_s: vec![0.0],
                pixels: vec![0; 64 * 64],
                actions: vec![0.0; info.action_channels.len()],
                states: vec![0.0; info.state_channels.len()],
                ..EpisodeData::default()
            };
            let dataset = Dataset::from_episodes(info, vec![data]).unwrap();
            Geometry::fit(&dataset, &[], SHAPE).unwrap().is_some()
        };
        let camera = |height_m| {
            Some(CameraModel {
                height_m,
                ..CameraModel::new(1.0, 0.2).unwrap()
            })
        };
        let turning = vec![Channel::new("turn", "rad/s")];
        for (action_channels, camera, expected) in [
            (action_channels(), camera(Some(0.5)), true),
            (action_channels(), camera(None), false),
            (action_channels(), None, false),
            (turning, camera(Some(0.5)), false),
        ] {
            let info = DatasetInfo {
                camera,
                ..described(action_channels)
            };
            assert_eq!(fitted(info), expected);
        }
    }
}
