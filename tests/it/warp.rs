//! Warping by a rotation against the simulator's own pictures.

use foreframe_core::frame::preprocess::scale;
use foreframe_core::frame::quality::mse;
use foreframe_core::frame::warp::{CameraModel, rotation_grid, sample};
use foreframe_core::types::Seed;
use foreframe_sim::{CameraConfig, PlanarPose, Scenario, TrialParameters, World, WorldConfig};

fn config(tilt_down_rad: f64) -> WorldConfig {
    WorldConfig {
        frame_width_px: 64,
        frame_height_px: 48,
        camera: CameraConfig {
            tilt_down_rad,
            noise_std: 0.0,
            ..CameraConfig::default()
        },
        ..WorldConfig::default()
    }
}

/// The first picture of a trial in which Tb1 looks in that direction.
fn picture(heading_rad: f32, config: &WorldConfig) -> Vec<f32> {
    let mut parameters = TrialParameters::draw(Scenario::MovingObserver, Seed(3), 0);
    parameters.observer = PlanarPose {
        x_m: 1.2,
        y_m: -0.4,
        heading_rad,
    };
    let world = World::from_parameters(parameters, config).unwrap();
    scale(world.observe().frame.pixels())
}

#[test]
fn a_rotation_warp_shows_what_the_turned_camera_sees() {
    for tilt_down_rad in [0.2, -0.1, 0.5] {
        let config = config(tilt_down_rad);
        let camera = CameraModel::new(config.camera.horizontal_fov_rad as f32, tilt_down_rad as f32).unwrap();
        let before = picture(0.3, &config);
        for yaw_rad in [-0.35f32, -0.1, 0.05, 0.25] {
            let after = picture(0.3 + yaw_rad, &config);
            let grid = rotation_grid(camera, 64, 48, yaw_rad);
            let (warped, inside) = sample(&before, 64, 48, &grid);
            let seen_twice = |values: &[f32]| -> Vec<f32> {
                let pairs = values.iter().zip(&inside).filter(|(_, inside)| **inside);
                pairs.map(|(&value, _)| value).collect()
            };
            assert!(seen_twice(&after).len() > 64 * 48 / 3);
            let error = mse(&seen_twice(&warped), &seen_twice(&after));
            let unmoved = mse(&seen_twice(&before), &seen_twice(&after));
            assert!(
                error < 5e-4 && error < 0.1 * unmoved,
                "{yaw_rad} {tilt_down_rad}: {error} {unmoved}"
            );
        }
    }
}
