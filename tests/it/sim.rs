//! The simulated world: closed forms, seeds, bounds, collisions, camera.

use foreframe_core::types::{Action, Seed};
use foreframe_sim::camera::Camera;
use foreframe_sim::scenario::{HELD_OUT_HEADING_GAIN, HELD_OUT_PAIRS};
use foreframe_sim::{
    Look, Observation, PlanarPose, Scenario, TrialParameters, World, WorldConfig, action_channels, arena, robot,
    state_channels,
};

pub(crate) fn action(linear: f32, angular: f32) -> Action {
    Action::try_from(vec![linear, angular]).unwrap()
}

pub(crate) fn small() -> WorldConfig {
    WorldConfig {
        frame_width_px: 16,
        frame_height_px: 16,
        ..WorldConfig::default()
    }
}

/// A moving-observer trial in which Tb1 starts at this pose.
fn world_from(x_m: f32, y_m: f32, heading_rad: f32, config: &WorldConfig) -> World {
    let mut parameters = TrialParameters::draw(Scenario::MovingObserver, Seed(3), 0);
    parameters.observer = PlanarPose { x_m, y_m, heading_rad };
    World::from_parameters(parameters, config).unwrap()
}

pub(crate) fn whole_trial(
    scenario: Scenario,
    seed: Seed,
    trial: u64,
    config: &WorldConfig,
) -> (Vec<Observation>, World) {
    let mut world = World::new(scenario, config, seed, trial).unwrap();
    let mut seen = vec![world.observe()];
    loop {
        let step = world.step(&world.policy_action()).unwrap();
        seen.push(step.observation);
        if step.terminated || step.truncated {
            return (seen, world);
        }
    }
}

#[test]
fn constant_wheel_speeds_drive_an_exact_arc() {
    let mut world = world_from(1.2, -0.9, 0.3, &small());
    let (linear, angular) = (0.4f64, 0.7f64);
    // Half a second is enough to reach the speeds; the arc is measured from there.
    for _ in 0..5 {
        world.step(&action(linear as f32, angular as f32)).unwrap();
    }
    let from = world.observer_pose();
    for _ in 0..10 {
        world.step(&action(linear as f32, angular as f32)).unwrap();
    }
    let to = world.observer_pose();
    // Closed form of a unicycle at constant speeds: a circle of radius v/ω.
    let turned = angular * 2.0;
    let heading = f64::from(from.heading_rad);
    let radius = linear / angular;
    let x = f64::from(from.x_m) + radius * ((heading + turned).sin() - heading.sin());
    let y = f64::from(from.y_m) - radius * ((heading + turned).cos() - heading.cos());
    assert!((f64::from(to.x_m) - x).abs() < 1e-3, "{} {x}", to.x_m);
    assert!((f64::from(to.y_m) - y).abs() < 1e-3, "{} {y}", to.y_m);
    assert!(f64::from(robot::wrap(to.heading_rad - (heading + turned) as f32)).abs() < 1e-3);
}

#[test]
fn wheels_accelerate_at_their_limit() {
    let mut world = world_from(1.0, 0.0, 0.0, &small());
    world.step(&action(0.6, 0.0)).unwrap();
    let speed = world.observe().state.as_slice()[4];
    assert!((speed - robot::MAX_RIM_ACCELERATION_M_S2 * 0.2).abs() < 1e-3, "{speed}");
}

#[test]
fn odometry_equals_the_true_pose_without_slip() {
    let mut world = world_from(1.0, 0.0, 0.2, &small());
    for _ in 0..10 {
        world.step(&action(0.3, -0.4)).unwrap();
    }
    let (state, truth) = (world.observe().state, world.observer_pose());
    let [x, y, cos, sin, linear, angular] = state.as_slice() else {
        panic!("six components")
    };
    assert!((x - truth.x_m).abs() < 1e-3 && (y - truth.y_m).abs() < 1e-3);
    assert!((sin.atan2(*cos) - truth.heading_rad).abs() < 1e-3);
    assert!((linear - 0.3).abs() < 1e-4 && (angular + 0.4).abs() < 1e-4);
}

#[test]
fn a_wall_stops_the_robot_while_its_wheels_turn() {
    let mut world = world_from(4.3, 1.2, 0.0, &small());
    let mut least = 1.0f32;
    for _ in 0..15 {
        least = least.min(world.step(&action(0.5, 0.0)).unwrap().reward);
    }
    let truth = world.observer_pose();
    let reach = arena::LENGTH_M - 0.177;
    assert!((truth.x_m - reach).abs() < 0.02, "{} {reach}", truth.x_m);
    assert!(world.observe().state.as_slice()[0] > truth.x_m + 0.3);
    assert!(least < 0.0, "a collision must have a negative reward: {least}");
}

#[test]
fn a_pillar_stops_the_robot() {
    let pillar = arena::PILLARS[1];
    let [x, y] = pillar.position_m;
    let mut world = world_from(x - 0.9, y, 0.0, &small());
    for _ in 0..15 {
        world.step(&action(0.5, 0.0)).unwrap();
        let apart = arena::distance(arena::position(world.observer_pose()), [x, y]);
        assert!(apart > pillar.radius_m + 0.177 - 0.02, "{apart}");
    }
}

#[test]
fn robots_never_overlap() {
    for trial in 0..10 {
        let config = WorldConfig {
            max_duration_s: 20.0,
            ..small()
        };
        let mut world = World::new(Scenario::Crowded, &config, Seed(5), trial).unwrap();
        while !world.step(&world.policy_action()).unwrap().truncated {
            let mut places: Vec<[f32; 2]> = world.other_robot_poses().into_iter().map(arena::position).collect();
            places.push(arena::position(world.observer_pose()));
            for (index, &one) in places.iter().enumerate() {
                for &other in &places[..index] {
                    assert!(arena::distance(one, other) > 0.33, "trial {trial}");
                }
            }
        }
    }
}

#[test]
fn commands_are_clamped_to_the_speed_limits() {
    let mut world = world_from(1.0, 0.0, 0.0, &small());
    for _ in 0..5 {
        world.step(&action(9.0, 50.0)).unwrap();
    }
    let state = world.observe().state;
    assert!((state.as_slice()[4] - robot::MAX_LINEAR_M_S).abs() < 1e-3);
    assert!((state.as_slice()[5] - robot::MAX_ANGULAR_RAD_S).abs() < 1e-3);
}

#[test]
fn the_seed_determines_the_trial() {
    for scenario in Scenario::ALL {
        let config = WorldConfig::default();
        let (first, _) = whole_trial(scenario, Seed(11), 4, &config);
        let (again, _) = whole_trial(scenario, Seed(11), 4, &config);
        let (other, _) = whole_trial(scenario, Seed(12), 4, &config);
        assert!(first == again, "{scenario}");
        assert!(first != other, "{scenario}");
    }
}

#[test]
fn a_world_rebuilt_from_its_parameters_is_the_same() {
    let config = WorldConfig::default();
    let world = World::new(Scenario::Crowded, &config, Seed(2), 7).unwrap();
    let written = serde_json::to_string(world.parameters()).unwrap();
    let again = World::from_parameters(serde_json::from_str(&written).unwrap(), &config).unwrap();
    assert_eq!(world.observe(), again.observe());
    assert_eq!(world.render().unwrap().0, world.observe().frame);
}

#[test]
fn static_trials_show_the_whole_robot_for_twelve_frames() {
    let config = small();
    let mut lengths = Vec::new();
    for trial in 0..400 {
        let mut world = World::new(Scenario::StaticObserver, &config, Seed(1), trial).unwrap();
        let mut frames = 1;
        loop {
            assert!(
                is_whole(&world.camera(), world.other_robot_poses()[0]),
                "trial {trial}, frame {frames}"
            );
            let step = world.step(&world.policy_action()).unwrap();
            frames += 1;
            if step.terminated || step.truncated {
                break;
            }
        }
        lengths.push(frames);
    }
    lengths.sort_unstable();
    println!(
        "shortest {}, median {}, longest {}",
        lengths[0], lengths[200], lengths[399]
    );
    assert!(lengths[0] >= 12, "{lengths:?}");
    assert!(lengths[399] <= 40);
}

/// Whether the whole width and height of a TurtleBot is inside the frame of 16×16 px.
fn is_whole(camera: &Camera, pose: PlanarPose) -> bool {
    [(0.0, -0.17), (0.0, 0.17), (0.42, -0.17), (0.42, 0.17)]
        .into_iter()
        .all(|(z, aside)| {
            let at = camera.project([pose.x_m, pose.y_m + aside, z]);
            at.is_some_and(|[column, row]| (0.0..16.0).contains(&column) && (0.0..16.0).contains(&row))
        })
}

#[test]
fn a_moving_observer_trial_has_40_frames() {
    let (seen, _) = whole_trial(Scenario::MovingObserver, Seed(1), 0, &small());
    assert_eq!(seen.len(), 40);
    assert!((seen[39].time_s - 7.8).abs() < 1e-9);
}

#[test]
fn the_policy_of_tb1_follows_tb2_and_rarely_collides() {
    let (mut frames, mut shown, mut bumps) = (0, 0, 0);
    for trial in 0..40 {
        let mut world = World::new(Scenario::MovingObserver, &small(), Seed(9), trial).unwrap();
        loop {
            let wish = world.policy_action();
            assert!((0.0..=0.5).contains(&wish.as_slice()[0]) && wish.as_slice()[1].abs() <= 0.8);
            let step = world.step(&wish).unwrap();
            frames += 1;
            shown += usize::from(step.observation.mask.contains(&1));
            bumps += usize::from(step.reward < 0.0);
            if step.truncated {
                break;
            }
        }
    }
    println!("Tb2 in {shown} of {frames} frames, {bumps} with a bump");
    assert!(shown * 2 > frames, "{shown} of {frames}");
    assert!(bumps * 10 < frames, "{bumps} of {frames}");
}

#[test]
fn held_out_trials_are_the_held_out_pairs_and_gains() {
    let trials: Vec<TrialParameters> = (0..4000)
        .map(|trial| TrialParameters::draw(Scenario::StaticObserver, Seed(1), trial))
        .collect();
    let by_pair = trials.iter().filter(|trial| trial.has_held_out_pair()).count();
    let by_gain = trials
        .iter()
        .filter(|trial| HELD_OUT_HEADING_GAIN.contains(&trial.gains.heading.proportional))
        .count();
    assert!((550..780).contains(&by_pair), "2 of 12 pairs: {by_pair} of 4000");
    assert!((320..480).contains(&by_gain), "a tenth: {by_gain} of 4000");
    for trial in trials {
        let held = HELD_OUT_PAIRS.contains(&(trial.start, trial.goal))
            || HELD_OUT_HEADING_GAIN.contains(&trial.gains.heading.proportional);
        assert_eq!(trial.is_held_out(), held);
    }
}

#[test]
fn the_camera_projects_points_as_a_pinhole() {
    let mut config = WorldConfig::default();
    config.camera.tilt_down_rad = 0.0;
    let pose = PlanarPose {
        x_m: 1.0,
        y_m: 0.5,
        heading_rad: std::f32::consts::FRAC_PI_2,
    };
    let camera = Camera::new(&config, &config.camera, pose);
    // Two metres ahead (along y), at the camera's height: the image's middle.
    let height = config.camera.height_m as f32;
    let [column, row] = camera.project([1.0, 2.5, height]).unwrap();
    assert!((column - 32.0).abs() < 1e-4 && (row - 32.0).abs() < 1e-4);
    // Half the field of view of 60° to the right: the right edge; as far down: the lower edge.
    let half = 2.0 * 30f32.to_radians().tan();
    let [column, row] = camera.project([1.0 + half, 2.5, height - half]).unwrap();
    assert!((column - 64.0).abs() < 1e-3 && (row - 64.0).abs() < 1e-3);
    assert_eq!(camera.project([1.0, 0.0, height]), None);
}

#[test]
fn the_mask_of_tb2_is_where_its_body_projects() {
    let config = WorldConfig {
        frame_width_px: 128,
        frame_height_px: 128,
        ..WorldConfig::default()
    };
    for trial in 0..40 {
        let mut world = World::new(Scenario::StaticObserver, &config, Seed(6), trial).unwrap();
        for _ in 0..5 {
            world.step(&action(0.0, 0.0)).unwrap();
        }
        let (mask, pose) = (world.observe().mask, world.other_robot_poses()[0]);
        assert!(mask.iter().all(|&owner| owner <= 1));
        let pixels: Vec<usize> = (0..mask.len()).filter(|&index| mask[index] == 1).collect();
        let mean = pixels.iter().map(|index| (index % 128) as f32 + 0.5).sum::<f32>() / pixels.len() as f32;
        let [column, _] = world.camera().project([pose.x_m, pose.y_m, 0.2]).unwrap();
        let [_, foot] = world.camera().project([pose.x_m - 0.17, pose.y_m, 0.015]).unwrap();
        assert!((mean - column).abs() < 1.5, "trial {trial}: {mean} {column}");
        let lowest = (pixels.iter().max().unwrap() / 128) as f32 + 0.5;
        assert!((lowest - foot).abs() < 2.0, "trial {trial}: {lowest} {foot}");
        let [_, top] = world.camera().project([pose.x_m + 0.17, pose.y_m, 0.42]).unwrap();
        let highest = (pixels.iter().min().unwrap() / 128) as f32 + 0.5;
        assert!((highest - top).abs() < 2.0, "trial {trial}: {highest} {top}");
    }
}

#[test]
fn crowded_masks_contain_every_robot() {
    let mut seen = [false; 5];
    for trial in 0..30 {
        let world = World::new(Scenario::Crowded, &WorldConfig::default(), Seed(4), trial).unwrap();
        for owner in world.observe().mask {
            seen[usize::from(owner)] = true;
        }
    }
    assert_eq!(seen, [true; 5]);
}

#[test]
fn a_still_camera_sees_a_still_background() {
    let mut config = WorldConfig::default();
    config.camera.noise_std = 0.0;
    let (seen, _) = whole_trial(Scenario::StaticObserver, Seed(1), 0, &config);
    let (first, last) = (&seen[0], &seen[seen.len() - 1]);
    // The top rows show only wall.
    assert_eq!(first.frame.pixels()[..64 * 4], last.frame.pixels()[..64 * 4]);
    assert!(first.frame != last.frame);
}

#[test]
fn channel_lists_match_actions_and_states() {
    let world = World::new(Scenario::StaticObserver, &small(), Seed(1), 0).unwrap();
    assert_eq!(world.policy_action().as_slice(), [0.0, 0.0]);
    assert_eq!(action_channels().len(), 2);
    assert_eq!(state_channels().len(), world.observe().state.as_slice().len());
}

#[test]
fn a_bright_room_is_white_where_no_robot_is() {
    let bright = WorldConfig {
        look: Look::Bright,
        ..WorldConfig::default()
    };
    let (seen, _) = whole_trial(Scenario::StaticObserver, Seed(4), 2, &bright);
    let observation = &seen[0];
    let pixels = observation.frame.pixels().iter().zip(&observation.mask);
    let (mut room, mut robot) = (Vec::new(), Vec::new());
    pixels.for_each(|(&pixel, &id)| if id == 0 { &mut room } else { &mut robot }.push(pixel));
    let mean = |values: &[u8]| values.iter().map(|&value| f64::from(value)).sum::<f64>() / values.len() as f64;
    assert!(mean(&room) > 240.0, "{}", mean(&room));
    assert!(mean(&robot) < 160.0, "{}", mean(&robot));
}
