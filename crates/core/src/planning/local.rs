//! Plans on the caller's own thread.

use std::time::Instant;

use super::choice::PlanChoice;
use super::error::PlanError;
use super::judge::PlannerInput;
use super::planner::Planner;
use crate::nn::Occupancy;
use crate::registry::Model;
use crate::serving::{ConditioningInput, Task, compute_task};

/// Searches for the best plan from the context of a task, as long as the budget allows. Errors: what does not fit the model, and what the
/// computation fails with.
pub fn plan(model: &Model, context: &Task, input: PlannerInput) -> Result<PlanChoice, PlanError> {
    plan_around(model, context, input, &mut |_| {})
}

/// As [`plan`], around what `change` makes of what the network sees and expects. Errors: as [`plan`].
pub fn plan_around(
    model: &Model,
    context: &Task,
    input: PlannerInput,
    change: &mut dyn FnMut(&mut Occupancy),
) -> Result<PlanChoice, PlanError> {
    let begun = Instant::now();
    let state = input.state.clone();
    let mut planner = Planner::new(model, input)?;
    let steps = Some(planner.steps());
    while let Some(batch) = planner.next_batch(&|| begun.elapsed())? {
        let asked = Instant::now();
        let inputs = ConditioningInput::of_plans(batch.plans, state.clone(), steps, &model.manifest)?;
        let mut prediction = compute_task(model, &context.with_rollouts(inputs, batch.sees_occupancy))?;
        if let Some(occupancy) = &mut prediction.occupancy {
            change(occupancy);
        }
        planner.record(prediction, asked.elapsed())?;
    }
    Ok(planner.finish())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::time::Duration;

    use super::*;
    use crate::frame::Frame;
    use crate::planning::PlanBatch;
    use crate::planning::{
        ActionLimit, CandidateKind, Goal, PlanCost, PlanSettings, SolverKind, SolverSettings, UnsafeReason,
    };
    use crate::serving::{Prediction, PredictionInput, test_speed_model};
    use crate::types::{Action, RobotState};

    fn limits() -> Vec<ActionLimit> {
        let limit = |low, high| ActionLimit {
            low,
            high,
            max_change: None,
        };
        vec![limit(0.0, 0.5), limit(-0.8, 0.8)]
    }

    fn context(model: &Model) -> Task {
        let input = PredictionInput {
            frames: (0..3).map(|i| Frame::new(8, 4, vec![i * 40; 32]).unwrap()).collect(),
            state: state(),
            plan: Some(vec![action(0.0, 0.0); 2]),
            ..PredictionInput::default()
        };
        input.into_task(&model.manifest).unwrap()
    }

    fn state() -> Option<RobotState> {
        RobotState::try_from(vec![0.0, 0.0, 1.0, 0.0]).ok()
    }

    fn action(linear: f32, angular: f32) -> Action {
        Action::try_from(vec![linear, angular]).unwrap()
    }

    fn input(kind: SolverKind) -> PlannerInput {
        PlannerInput {
            goal: Goal {
                position_m: Some([0.5, 0.1]),
                ..Goal::default()
            },
            settings: PlanSettings {
                solver: SolverSettings {
                    kind,
                    samples: 64,
                    ..SolverSettings::default()
                },
                // What random weights see says nothing.
                costs: BTreeMap::from([(PlanCost::Clearance, 0.0)]),
                limits: Some(limits()),
                radius_m: 0.0,
                ..PlanSettings::default()
            },
            state: state(),
            ..PlannerInput::default()
        }
    }

    fn predicted(model: &Model, context: &Task, batch: PlanBatch) -> Prediction {
        let inputs = ConditioningInput::of_plans(batch.plans, state(), Some(2), &model.manifest).unwrap();
        compute_task(model, &context.with_rollouts(inputs, batch.sees_occupancy)).unwrap()
    }

    #[test]
    fn every_solver_drives_towards_the_goal() {
        let model = test_speed_model();
        for kind in [SolverKind::RandomShooting, SolverKind::Cem, SolverKind::Mppi] {
            let choice = plan(&model, &context(&model), input(kind)).unwrap();
            let all = std::iter::once(&choice.best).chain(&choice.runners_up);
            let stop = all.clone().find(|candidate| candidate.kind == CandidateKind::Stop);
            // Stopping is always among the candidates.
            let (stop, best) = (stop.map(|stop| stop.total), choice.best.total);
            assert!(stop.is_some_and(|stop| stop > best), "{kind:?} {stop:?} {best}");
            assert_eq!((choice.best.kind, choice.unsafe_reason), (CandidateKind::Drawn, None));
            assert!(
                choice.best.actions.iter().all(|action| action.as_slice()[0] > 0.3),
                "{kind:?}"
            );
            assert_eq!(choice.best.rollout.as_ref().unwrap().frames.len(), 2);
            assert_eq!(choice.samples, 64 * 4 + 1);
            let again = plan(&model, &context(&model), input(kind)).unwrap();
            assert_eq!(choice, again, "the same seed finds the same plan");
        }
    }

    #[test]
    fn a_goal_image_steers_the_search_by_predicted_frames() {
        let model = test_speed_model();
        let mut by_image = input(SolverKind::Cem);
        by_image.goal = Goal {
            image: Frame::new(8, 4, vec![60; 32]).ok(),
            ..Goal::default()
        };
        by_image.present = vec![action(0.2, 0.1)];
        let choice = plan(&model, &context(&model), by_image).unwrap();
        assert_eq!((choice.samples, choice.predicted), (64 * 4 + 2, 64 * 4 + 2));
        let kinds: Vec<CandidateKind> = std::iter::once(&choice.best)
            .chain(&choice.runners_up)
            .map(|c| c.kind)
            .collect();
        assert!(kinds.contains(&CandidateKind::Drawn), "{kinds:?}");
        let is_image = |(cost, _): &(PlanCost, f32)| *cost == PlanCost::GoalImage;
        assert!(choice.best.costs.iter().any(is_image));
    }

    #[test]
    fn what_stands_in_the_way_makes_every_plan_unsafe() {
        let model = test_speed_model();
        let mut blocked = input(SolverKind::Cem);
        blocked.settings.radius_m = 0.18;
        blocked.settings.costs.clear();
        // It can hardly brake, and hardly turn.
        blocked.before = Some(vec![0.5, 0.79].try_into().unwrap());
        let limits = blocked.settings.limits.as_mut().unwrap();
        (limits[0].low, limits[0].max_change) = (0.4, Some(0.01));
        blocked.settings.limits.as_mut().unwrap()[1].low = 0.79;
        let mut planner = Planner::new(&model, blocked).unwrap();
        let context = context(&model);
        while let Some(batch) = planner.next_batch(&|| Duration::ZERO).unwrap() {
            let sees = batch.sees_occupancy;
            let mut prediction = predicted(&model, &context, batch);
            if sees {
                let wall = (-20..20).flat_map(|left| [[0.3, left as f32 * 0.05, -0.1]; 3]);
                prediction.occupancy = Some(Occupancy {
                    points: wall.collect(),
                    ..Occupancy::default()
                });
            }
            planner.record(prediction, Duration::ZERO).unwrap();
        }
        let choice = planner.finish();
        assert!(choice.clearance_checked);
        assert_eq!(choice.unsafe_reason, Some(UnsafeReason::NoFreeWay));
        assert_eq!(choice.best.kind, CandidateKind::Stop);
    }

    #[test]
    fn a_search_without_predicted_plans_predicts_stopping_only() {
        let model = test_speed_model();
        let mut fast = input(SolverKind::Cem);
        fast.settings.predicts_plans = false;
        fast.present = vec![action(0.2, 0.1)];
        let choice = plan(&model, &context(&model), fast.clone()).unwrap();
        assert_eq!((choice.predicted, choice.samples), (1, 64 * 4 + 2));
        assert_eq!((choice.best.kind, choice.unsafe_reason), (CandidateKind::Drawn, None));
        assert!(choice.best.rollout.is_none() && choice.best.motion.is_some());
        assert!(choice.best.actions.iter().all(|action| action.as_slice()[0] > 0.3));

        // There is no time for a search: the present plan is known all the same.
        fast.settings.budget = Some(Duration::from_millis(5));
        let mut planner = Planner::new(&model, fast).unwrap();
        let first = planner.next_batch(&|| Duration::ZERO).unwrap().unwrap();
        assert_eq!(first.plans.len(), 1);
        let late = Duration::from_millis(9);
        planner
            .record(predicted(&model, &context(&model), first), late)
            .unwrap();
        assert_eq!(planner.next_batch(&|| late).unwrap(), None);
        let choice = planner.finish();
        assert_eq!((choice.best.kind, choice.samples), (CandidateKind::Present, 2));
    }

    #[test]
    fn stopping_is_standing_whatever_the_limits() {
        let model = test_speed_model();
        let mut hurried = input(SolverKind::Cem);
        hurried.settings.limits.as_mut().unwrap()[0].low = 0.4;
        let answer = Planner::new(&model, hurried).unwrap().finish();
        assert_eq!(answer.unsafe_reason, Some(UnsafeReason::NoTime));
        assert!(answer.best.actions.iter().all(|action| action.as_slice() == [0.0, 0.0]));
        assert!(answer.best.total.is_sign_positive());
    }

    #[test]
    fn a_budget_ends_the_search_with_the_best_so_far() {
        let model = test_speed_model();
        let mut short = input(SolverKind::Cem);
        short.settings.budget = Some(Duration::from_millis(20));
        let mut planner = Planner::new(&model, short.clone()).unwrap();
        let first = planner.next_batch(&|| Duration::ZERO).unwrap().unwrap();
        assert_eq!((first.plans.len(), first.sees_occupancy), (1, true));
        let none_judged = Planner::new(&model, short.clone()).unwrap().finish();
        assert_eq!(none_judged.unsafe_reason, Some(UnsafeReason::NoTime));
        assert_eq!(none_judged.best.kind, CandidateKind::Stop);

        // Stopping took 5 ms, and 6 ms are over when the last predictions begin: 2 more fit.
        let context = context(&model);
        planner
            .record(predicted(&model, &context, first), Duration::from_millis(5))
            .unwrap();
        let last = planner.next_batch(&|| Duration::from_millis(6)).unwrap().unwrap();
        assert_eq!(last.plans.len(), 2);
        planner
            .record(predicted(&model, &context, last), Duration::from_millis(10))
            .unwrap();
        assert_eq!(planner.next_batch(&|| Duration::from_millis(16)).unwrap(), None);
        let choice = planner.finish();
        assert_eq!(
            (choice.predicted, choice.iterations, choice.unsafe_reason),
            (3, 4, None)
        );
    }

    #[test]
    fn a_goal_or_setting_that_does_not_fit_is_refused() {
        let model = test_speed_model();
        let refused = |change: fn(&mut PlannerInput)| {
            let mut wrong = input(SolverKind::Cem);
            change(&mut wrong);
            plan(&model, &context(&model), wrong).unwrap_err().to_string()
        };
        assert_eq!(
            refused(|wrong| wrong.goal = Goal::default()),
            "goal is empty; give position_m, heading_rad or image"
        );
        assert_eq!(
            refused(|wrong| wrong.goal.position_m = Some([f32::NAN, 0.0])),
            "goal.position_m[0] is NaN; it must be -1000 to 1000"
        );
        assert_eq!(
            refused(|wrong| wrong.settings.solver.samples = 0),
            "solver.samples is 0; it must be 1 to 4096"
        );
        assert_eq!(
            refused(|wrong| wrong.settings.costs = BTreeMap::from([(PlanCost::GoalImage, 1.0)])),
            "costs.goal_image cannot be computed: the goal has no image"
        );
        assert_eq!(
            refused(|wrong| wrong.settings.budget = Some(Duration::ZERO)),
            "budget_ms is 0; it must be 1 to 10000"
        );
        assert!(refused(|wrong| wrong.state = None).starts_with("state is missing"));
    }
}
