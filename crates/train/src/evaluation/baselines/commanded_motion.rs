//! How a camera moves under the commanded actions.

use super::input::BaselineInput;
use foreframe_core::types::Channel;
use foreframe_data::dataset::DatasetInfo;
use foreframe_sim::PlanarPose;
use foreframe_sim::robot::{MAX_ANGULAR_RAD_S, MAX_LINEAR_M_S, MAX_RIM_ACCELERATION_M_S2, WHEEL_BASE_M, roll};

/// Steps in which a frame period is integrated.
const SUBSTEPS: usize = 10;

/// The place of the last input frame's camera, from which others are measured.
pub(super) const ORIGIN: PlanarPose = PlanarPose {
    x_m: 0.0,
    y_m: 0.0,
    heading_rad: 0.0,
};

/// Speeds of the robot.
#[derive(Clone, Copy)]
struct RobotSpeeds {
    linear_m_s: f32,
    angular_rad_s: f32,
}

/// Positions of the speeds among the components of an action or a state.
#[derive(Clone, Copy)]
struct SpeedChannels {
    /// None where only the turn is known.
    linear: Option<usize>,
    angular: usize,
}

impl SpeedChannels {
    fn of(channels: &[Channel]) -> Option<Self> {
        let position = |unit: &str| channels.iter().position(|channel| channel.unit == unit);
        Some(Self {
            linear: position("m/s"),
            angular: position("rad/s")?,
        })
    }

    /// A speed that is not among the values is 0.
    fn read(self, values: &[f32]) -> RobotSpeeds {
        let value = |channel: usize| values.get(channel).copied().unwrap_or(0.0);
        RobotSpeeds {
            linear_m_s: self.linear.map_or(0.0, value),
            angular_rad_s: value(self.angular),
        }
    }
}

/// How a camera moves under commanded actions.
pub(super) struct CommandedMotion {
    period_s: f32,
    commanded: SpeedChannels,
    /// Where the simulated robot's speeds are measured: its wheels reach a command at a known limit. None for other robots,
    /// which follow a command at once.
    measured: Option<SpeedChannels>,
}

impl CommandedMotion {
    /// None unless an action component has the unit rad/s.
    pub(super) fn of(info: &DatasetInfo) -> Option<Self> {
        let commanded = SpeedChannels::of(&info.action_channels)?;
        let measured = SpeedChannels::of(&info.state_channels);
        let is_complete = |channels: &SpeedChannels| channels.linear.is_some();
        Some(Self {
            period_s: info.frame_period_s as f32,
            commanded,
            measured: measured
                .filter(is_complete)
                .filter(|_| is_complete(&commanded) && info.scenario.is_some()),
        })
    }

    /// Whether the actions say how far the robot drives, not only how far it turns.
    pub(super) fn commands_translation(&self) -> bool {
        self.commanded.linear.is_some()
    }

    /// Where the camera is at each predicted frame, in the axes of the last input frame.
    pub(super) fn poses(&self, input: &BaselineInput) -> Vec<PlanarPose> {
        let mut pose = ORIGIN;
        let mut wheels = self.measured.map(|measured| Wheels::at(measured.read(input.state)));
        let moved = input.actions.iter().map(|action| {
            let command = self.commanded.read(action);
            pose = match &mut wheels {
                Some(wheels) => wheels.drive(pose, command, self.period_s),
                None => roll(pose, command.linear_m_s, command.angular_rad_s, self.period_s),
            };
            pose
        });
        moved.collect()
    }
}

/// Speeds of the wheels' rims, in metres a second.
struct Wheels {
    left_m_s: f32,
    right_m_s: f32,
}

impl Wheels {
    fn at(speeds: RobotSpeeds) -> Self {
        let turn = speeds.angular_rad_s * WHEEL_BASE_M / 2.0;
        Self {
            left_m_s: speeds.linear_m_s - turn,
            right_m_s: speeds.linear_m_s + turn,
        }
    }

    /// Drives for one period towards commanded speeds at the wheels' greatest acceleration; gives the pose after that.
    fn drive(&mut self, mut pose: PlanarPose, command: RobotSpeeds, period_s: f32) -> PlanarPose {
        let targets = Self::at(RobotSpeeds {
            linear_m_s: command.linear_m_s.clamp(-MAX_LINEAR_M_S, MAX_LINEAR_M_S),
            angular_rad_s: command.angular_rad_s.clamp(-MAX_ANGULAR_RAD_S, MAX_ANGULAR_RAD_S),
        });
        let dt = period_s / SUBSTEPS as f32;
        let most = MAX_RIM_ACCELERATION_M_S2 * dt;
        for _ in 0..SUBSTEPS {
            self.left_m_s += (targets.left_m_s - self.left_m_s).clamp(-most, most);
            self.right_m_s += (targets.right_m_s - self.right_m_s).clamp(-most, most);
            let linear = f32::midpoint(self.left_m_s, self.right_m_s);
            let angular = (self.right_m_s - self.left_m_s) / WHEEL_BASE_M;
            pose = roll(pose, linear, angular, dt);
        }
        pose
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_core::types::{Action, Seed};
    use foreframe_sim::robot::wrap;
    use foreframe_sim::{Scenario, World, WorldConfig, action_channels, state_channels};

    #[test]
    fn the_motion_is_that_of_the_simulated_robot() {
        let config = WorldConfig::default();
        let info = DatasetInfo {
            frame_period_s: config.frame_period_s,
            action_channels: action_channels(),
            state_channels: state_channels(),
            scenario: Some("moving-observer".to_owned()),
            ..DatasetInfo::default()
        };
        let motion = CommandedMotion::of(&info).unwrap();
        let mut world = World::new(Scenario::MovingObserver, &config, Seed(3), 1).unwrap();
        world.step(&Action::try_from(vec![0.1, 0.5]).unwrap()).unwrap();
        let (state, before) = (world.observe().state, world.observer_pose());
        let actions = [[0.2, 1.4], [0.3, -0.6]];
        let input = BaselineInput {
            previous_action: &actions[0],
            actions: actions.iter().map(<[f32; 2]>::as_slice).collect(),
            state: state.as_slice(),
            ..BaselineInput::default()
        };
        let (sin, cos) = before.heading_rad.sin_cos();
        for (action, pose) in actions.iter().zip(motion.poses(&input)) {
            world.step(&Action::try_from(action.to_vec()).unwrap()).unwrap();
            let after = world.observer_pose();
            let (x, y) = (after.x_m - before.x_m, after.y_m - before.y_m);
            let differences = [
                wrap(after.heading_rad - before.heading_rad - pose.heading_rad),
                cos * x + sin * y - pose.x_m,
                cos * y - sin * x - pose.y_m,
            ];
            assert!(differences.iter().all(|d| d.abs() < 2e-3), "{differences:?}");
        }
    }

    #[test]
    fn without_known_wheels_the_command_alone_moves_the_camera() {
        let info = DatasetInfo {
            frame_period_s: 0.5,
            action_channels: vec![Channel::new("turn", "rad/s")],
            ..DatasetInfo::default()
        };
        let input = BaselineInput {
            actions: vec![&[0.4], &[-0.2]],
            ..BaselineInput::default()
        };
        let motion = CommandedMotion::of(&info).unwrap();
        let poses = motion.poses(&input);
        assert!((poses[0].heading_rad - 0.2).abs() < 1e-6 && (poses[1].heading_rad - 0.1).abs() < 1e-6);
        assert!(poses[1].x_m.abs() < 1e-6 && !motion.commands_translation());
    }
}
