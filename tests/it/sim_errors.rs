//! Errors of the simulator, and the episodes of an environment.

use foreframe_core::types::{Action, Seed};
use foreframe_sim::{Environment, Scenario, SimError, TrialParameters, World, WorldConfig};

use crate::sim::{action, small};

#[test]
fn an_unknown_scenario_is_refused_with_the_known_ones() {
    let error = "static".parse::<Scenario>().unwrap_err();
    assert_eq!(
        error.to_string(),
        "there is no scenario \"static\"; there are static-observer, moving-observer, crowded, crossing"
    );
    for scenario in Scenario::ALL {
        assert_eq!(scenario.to_string().parse::<Scenario>().unwrap(), scenario);
        assert_eq!(serde_json::to_value(scenario).unwrap(), scenario.name());
    }
}

#[test]
fn settings_out_of_range_are_refused_with_their_range() {
    let refusal = |change: fn(&mut WorldConfig)| {
        let mut config = WorldConfig::default();
        change(&mut config);
        World::new(Scenario::StaticObserver, &config, Seed(1), 0)
            .err()
            .unwrap()
            .to_string()
    };
    assert_eq!(
        refusal(|config| config.frame_width_px = 0),
        "a frame of 0×64 px is out of range; each side must be 1 to 4096 px"
    );
    assert_eq!(
        refusal(|config| config.camera.noise_std = f64::NAN),
        "camera.noise_std is NaN; it must be a finite number from 0 to 1"
    );
    assert!(refusal(|config| config.frame_period_s = 0.0).starts_with("frame_period_s is 0; it must be"));
    assert!(refusal(|config| config.camera.horizontal_fov_rad = 4.0).contains("from 0.1 to 2.8"));
    assert!(refusal(|config| config.camera.height_m = f64::INFINITY).starts_with("camera.height_m is inf"));
    assert!(refusal(|config| config.max_duration_s = 0.1).contains("from 0.4 to 3600"));
    assert!(serde_json::from_str::<WorldConfig>(r#"{"frame_widht_px": 64}"#).is_err());
}

#[test]
fn invalid_trial_parameters_are_refused() {
    let refusal = |change: fn(&mut TrialParameters)| {
        let mut parameters = TrialParameters::draw(Scenario::MovingObserver, Seed(1), 0);
        change(&mut parameters);
        World::from_parameters(parameters, &small()).err().unwrap().to_string()
    };
    assert_eq!(
        refusal(|trial| trial.goal = 4),
        "goal is 4; it must be a finite number from 0 to 3"
    );
    assert!(refusal(|trial| trial.observer.x_m = f32::NAN).starts_with("x_m is NaN"));
    assert!(refusal(|trial| trial.observer.y_m = 3.0).contains("from -2 to 2"));
}

#[test]
fn an_action_of_the_wrong_length_is_refused() {
    let mut world = World::new(Scenario::MovingObserver, &small(), Seed(1), 0).unwrap();
    let error = world.step(&Action::try_from(vec![0.0; 3]).unwrap()).unwrap_err();
    assert_eq!(
        error.to_string(),
        "the action has 3 components; it must have 2: linear (m/s) and angular (rad/s)"
    );
    assert!(Action::try_from(vec![0.0, f32::NAN]).is_err());
}

#[test]
fn an_environment_must_be_reset_before_each_episode() {
    let mut environment = Environment::new(Scenario::StaticObserver, small()).unwrap();
    let still = action(0.0, 0.0);
    assert!(matches!(environment.step(&still), Err(SimError::NotReset)));
    let (first, drawn) = environment.reset(Some(Seed(8))).unwrap();
    assert_eq!((drawn.seed, drawn.trial), (Seed(8), 0));
    while !matches!(environment.step(&still), Err(SimError::Ended)) {}
    let (next, drawn) = environment.reset(None).unwrap();
    assert_eq!(drawn.trial, 1);
    assert!(next != first);
    assert_eq!(environment.reset(Some(Seed(8))).unwrap().0, first);
}
