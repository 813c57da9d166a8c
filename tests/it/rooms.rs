//! Worlds in which each trial has a room, a camera and robots of its own.

use foreframe_core::types::Seed;
use foreframe_sim::{Observation, RoomSet, Scenario, World, WorldConfig};

use crate::sim::{small, whole_trial};

fn config(rooms: RoomSet) -> WorldConfig {
    WorldConfig {
        rooms: Some(rooms),
        max_duration_s: 4.0,
        ..small()
    }
}

/// The observations of a trial that the built-in policy drives.
fn trial(config: &WorldConfig, scenario: Scenario, trial: u64) -> (Vec<Observation>, World) {
    whole_trial(scenario, Seed(7), trial, config)
}

#[test]
fn the_seed_determines_the_room() {
    let config = config(RoomSet::Varied);
    let (first, world) = trial(&config, Scenario::MovingObserver, 3);
    assert_eq!(first, trial(&config, Scenario::MovingObserver, 3).0);
    // Also from the parameters alone, as they are stored.
    let text = serde_json::to_string(world.parameters()).unwrap();
    let again = World::from_parameters(serde_json::from_str(&text).unwrap(), &config).unwrap();
    assert_eq!(first[0], again.observe());
}

#[test]
fn every_trial_has_another_room_and_camera() {
    let config = config(RoomSet::Varied);
    let worlds: Vec<World> = (0..20)
        .map(|trial| World::new(Scenario::MovingObserver, &config, Seed(7), trial).unwrap())
        .collect();
    for (index, world) in worlds.iter().enumerate() {
        for other in &worlds[..index] {
            assert_ne!(world.observe().frame, other.observe().frame);
            assert_ne!(world.parameters().room, other.parameters().room);
        }
    }
}

#[test]
fn every_scenario_runs_in_rooms_of_its_own() {
    for scenario in Scenario::ALL {
        for set in RoomSet::ALL {
            for number in 0..4 {
                let (seen, _) = trial(&config(set), scenario, number);
                assert!(seen.len() > 2, "{scenario} in {set}");
            }
        }
    }
}

#[test]
fn odometry_in_a_room_starts_at_zero_and_drifts() {
    let drifts = config(RoomSet::Varied);
    let exact = WorldConfig {
        true_pose: true,
        ..drifts.clone()
    };
    let mut greatest: f32 = 0.0;
    for number in 0..10 {
        let (seen, world) = trial(&drifts, Scenario::MovingObserver, number);
        let (truth, _) = trial(&exact, Scenario::MovingObserver, number);
        assert_eq!(seen[0].state.as_slice()[..4], [0.0, 0.0, 1.0, 0.0]);
        // The way in the axes of the first pose.
        let way = |seen: &[Observation]| {
            let (first, last) = (seen[0].state.as_slice(), seen[seen.len() - 1].state.as_slice());
            (last[0] - first[0]).hypot(last[1] - first[1])
        };
        greatest = greatest.max((way(&seen) - way(&truth)).abs());
        let (pose, last) = (world.observer_pose(), truth[truth.len() - 1].state.as_slice());
        assert!((pose.x_m - last[0]).hypot(pose.y_m - last[1]) < 1e-6);
    }
    assert!((1e-3..0.6).contains(&greatest), "{greatest}");
}

#[test]
fn the_driver_rarely_collides_with_furniture() {
    let (mut steps, mut touched) = (0, 0);
    for number in 0..20 {
        let mut world = World::new(Scenario::MovingObserver, &config(RoomSet::Varied), Seed(9), number).unwrap();
        loop {
            let step = world.step(&world.policy_action()).unwrap();
            steps += 1;
            touched += usize::from(step.reward < 0.0);
            if step.truncated {
                break;
            }
        }
    }
    assert!(touched * 20 < steps, "{touched} of {steps} steps touched something");
}

#[test]
fn an_unknown_set_of_rooms_is_refused_with_the_known_ones() {
    let error = "old".parse::<RoomSet>().unwrap_err().to_string();
    assert_eq!(
        error,
        "there are no rooms \"old\"; there are varied, new-materials, new-cameras"
    );
}
