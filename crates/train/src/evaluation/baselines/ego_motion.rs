//! The last frame warped by the rotation that the commanded actions bring about, through the data set's camera model.

use super::input::BaselineInput;
use foreframe_core::frame::warp::{CameraModel, rotation_grid, sample};
use foreframe_core::types::Channel;
use foreframe_data::dataset::DatasetInfo;
use foreframe_sim::robot::{MAX_ANGULAR_RAD_S, MAX_LINEAR_M_S, MAX_RIM_ACCELERATION_M_S2, WHEEL_BASE_M};

/// Steps in which a frame period is integrated.
const SUBSTEPS: usize = 10;

/// Positions of the linear and the angular velocity among the components of an action or a state.
#[derive(Clone, Copy)]
struct VelocityChannels {
    linear: usize,
    angular: usize,
}

impl VelocityChannels {
    fn of(channels: &[Channel]) -> Option<Self> {
        Some(Self {
            linear: position(channels, "m/s")?,
            angular: position(channels, "rad/s")?,
        })
    }

    fn read(self, values: &[f32]) -> Option<(f32, f32)> {
        Some((*values.get(self.linear)?, *values.get(self.angular)?))
    }
}

fn position(channels: &[Channel], unit: &str) -> Option<usize> {
    channels.iter().position(|channel| channel.unit == unit)
}

/// How far a camera turns under commanded actions.
pub(super) struct CameraTurn {
    camera: CameraModel,
    width: usize,
    height: usize,
    period_s: f32,
    /// The commanded rate of turn among the components of an action.
    yaw_rate: usize,
    /// Where the simulated robot's velocities are commanded and measured: its wheels reach a command at a known limit.
    wheels: Option<[VelocityChannels; 2]>,
}

impl CameraTurn {
    /// None unless the data set describes its camera and an action component has the unit rad/s.
    pub(super) fn of(info: &DatasetInfo) -> Option<Self> {
        let wheels = VelocityChannels::of(&info.action_channels).zip(VelocityChannels::of(&info.state_channels));
        Some(Self {
            camera: info.camera?,
            width: info.frame_width_px as usize,
            height: info.frame_height_px as usize,
            period_s: info.frame_period_s as f32,
            yaw_rate: position(&info.action_channels, "rad/s")?,
            wheels: wheels
                .filter(|_| info.scenario.is_some())
                .map(|(action, state)| [action, state]),
        })
    }

    /// One frame for each action of the input.
    pub(super) fn predict(&self, input: &BaselineInput, last: &[f32]) -> Vec<Vec<f32>> {
        self.yaws_rad(input)
            .into_iter()
            .map(|yaw_rad| {
                let grid = rotation_grid(self.camera, self.width, self.height, yaw_rad);
                sample(last, self.width, self.height, &grid).0
            })
            .collect()
    }

    /// How far the camera has turned since the last input frame, at each predicted frame.
    fn yaws_rad(&self, input: &BaselineInput) -> Vec<f32> {
        let mut yaw_rad = 0.0;
        let start = self.wheels.and_then(|[_, state]| state.read(input.state));
        let mut rims = start.map(rim_speeds);
        let turned = input.actions.iter().map(|action| {
            let target = self.wheels.and_then(|[commanded, _]| commanded.read(action));
            yaw_rad += match (&mut rims, target) {
                (Some(rims), Some(target)) => drive(rims, target, self.period_s),
                _ => action.get(self.yaw_rate).copied().unwrap_or(0.0) * self.period_s,
            };
            yaw_rad
        });
        turned.collect()
    }
}

/// Speeds of the left and the right wheel's rim, in metres a second.
fn rim_speeds((linear_m_s, angular_rad_s): (f32, f32)) -> [f32; 2] {
    let turn = angular_rad_s * WHEEL_BASE_M / 2.0;
    [linear_m_s - turn, linear_m_s + turn]
}

/// Drives for one period towards commanded velocities at the wheels' greatest acceleration; gives the turn in radians.
fn drive(rims: &mut [f32; 2], (linear_m_s, angular_rad_s): (f32, f32), period_s: f32) -> f32 {
    let targets = rim_speeds((
        linear_m_s.clamp(-MAX_LINEAR_M_S, MAX_LINEAR_M_S),
        angular_rad_s.clamp(-MAX_ANGULAR_RAD_S, MAX_ANGULAR_RAD_S),
    ));
    let dt = period_s / SUBSTEPS as f32;
    let most = MAX_RIM_ACCELERATION_M_S2 * dt;
    let mut yaw_rad = 0.0;
    for _ in 0..SUBSTEPS {
        for (speed, target) in rims.iter_mut().zip(targets) {
            *speed += (target - *speed).clamp(-most, most);
        }
        yaw_rad += (rims[1] - rims[0]) / WHEEL_BASE_M * dt;
    }
    yaw_rad
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::types::{Action, Seed};
    use foreframe_sim::{Scenario, World, WorldConfig, action_channels, state_channels};

    #[test]
    fn the_turn_is_that_of_the_simulated_robot() {
        let config = WorldConfig::default();
        let info = DatasetInfo {
            frame_width_px: 64,
            frame_height_px: 64,
            frame_period_s: config.frame_period_s,
            action_channels: action_channels(),
            state_channels: state_channels(),
            scenario: Some("moving-observer".to_owned()),
            camera: Some(config.camera.model()),
            ..DatasetInfo::default()
        };
        let turn = CameraTurn::of(&info).unwrap();
        let mut world = World::new(Scenario::MovingObserver, &config, Seed(3), 1).unwrap();
        world.step(&Action::try_from(vec![0.1, 0.5]).unwrap()).unwrap();
        let (state, before) = (world.observe().state, world.observer_pose().heading_rad);
        let actions = [[0.2, 1.4], [0.0, -0.6]];
        let input = BaselineInput {
            inputs: &[],
            previous_action: &actions[0],
            actions: actions.iter().map(<[f32; 2]>::as_slice).collect(),
            state: state.as_slice(),
        };
        for (action, yaw_rad) in actions.iter().zip(turn.yaws_rad(&input)) {
            world.step(&Action::try_from(action.to_vec()).unwrap()).unwrap();
            let turned = foreframe_sim::robot::wrap(world.observer_pose().heading_rad - before);
            assert!((turned - yaw_rad).abs() < 2e-3, "{turned} {yaw_rad}");
        }
    }

    #[test]
    fn without_known_wheels_the_command_alone_turns_the_camera() {
        let info = DatasetInfo {
            frame_width_px: 4,
            frame_height_px: 4,
            frame_period_s: 0.5,
            action_channels: vec![Channel::new("turn", "rad/s")],
            camera: CameraModel::new(1.0, 0.0).ok(),
            ..DatasetInfo::default()
        };
        let input = BaselineInput {
            inputs: &[],
            previous_action: &[0.0],
            actions: vec![&[0.4], &[-0.2]],
            state: &[],
        };
        let yaws = CameraTurn::of(&info).unwrap().yaws_rad(&input);
        assert!((yaws[0] - 0.2).abs() < 1e-6 && (yaws[1] - 0.1).abs() < 1e-6);
    }
}
