//! Past motion of the camera, from the poses in the states.

use foreframe_core::types::Channel;
use foreframe_sim::PlanarPose;
use foreframe_sim::robot::wrap;

/// Positions of the pose among the components of a state.
#[derive(Clone, Copy)]
pub(super) struct PoseChannels {
    x: usize,
    y: usize,
    heading_cos: usize,
    heading_sin: usize,
}

impl PoseChannels {
    /// By name; none where the states hold no pose.
    pub(super) fn of(channels: &[Channel]) -> Option<Self> {
        let position = |name: &str| channels.iter().position(|channel| channel.name == name);
        Some(Self {
            x: position("x")?,
            y: position("y")?,
            heading_cos: position("heading_cos")?,
            heading_sin: position("heading_sin")?,
        })
    }

    fn pose(self, state: &[f32]) -> PlanarPose {
        let value = |channel: usize| state.get(channel).copied().unwrap_or(0.0);
        PlanarPose {
            x_m: value(self.x),
            y_m: value(self.y),
            heading_rad: value(self.heading_sin).atan2(value(self.heading_cos)),
        }
    }

    /// The pose in the state `other`, in the axes of the pose in `state`. Only differences count, since odometry drifts.
    pub(super) fn motion(self, state: &[f32], other: &[f32]) -> PlanarPose {
        let (here, there) = (self.pose(state), self.pose(other));
        let (sin, cos) = here.heading_rad.sin_cos();
        let (x, y) = (there.x_m - here.x_m, there.y_m - here.y_m);
        PlanarPose {
            x_m: cos * x + sin * y,
            y_m: cos * y - sin * x,
            heading_rad: wrap(there.heading_rad - here.heading_rad),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use foreframe_sim::state_channels;

    #[test]
    fn a_step_back_and_a_turn_are_found() {
        let channels = PoseChannels::of(&state_channels()).unwrap();
        // Heading along y, then along x; 1 m behind and 2 m to the right before.
        let now = [3.0, 5.0, 0.0, 1.0, 0.0, 0.0];
        let before = [5.0, 4.0, 1.0, 0.0, 0.0, 0.0];
        let motion = channels.motion(&now, &before);
        let expected = [-1.0, -2.0, -std::f32::consts::FRAC_PI_2];
        for (found, expected) in [motion.x_m, motion.y_m, motion.heading_rad].iter().zip(expected) {
            assert!((found - expected).abs() < 1e-6, "{motion:?}");
        }
    }

    #[test]
    fn states_without_a_pose_have_no_odometry() {
        assert!(PoseChannels::of(&state_channels()[2..]).is_none());
    }
}
