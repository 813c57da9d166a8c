//! Plans with the simulator itself as the model: it knows what will happen.

use rayon::prelude::*;

use super::situation::{LIMITS, MARGIN_M, Situation, in_room};
use foreframe_core::planning::{SearchSpace, SolverSettings};
use foreframe_sim::robot::wrap;

/// Plans of an iteration, and iterations.
const PLANS: [usize; 2] = [48, 2];
/// Actions of a plan: those of the shipped models.
const STEPS: usize = 5;
/// Weights per radian of the angle to the goal, and per metre of lacking clearance, as the planner's.
const HEADING_WEIGHT: f32 = 0.3;
const CLEARANCE_WEIGHT: f32 = 5.0;

/// The best commands from here on. `present`: those that were to follow, one after another; `seed`: of the search.
pub(super) fn best_commands(now: &Situation<'_>, present: &[f32], seed: u64) -> Vec<[f32; 2]> {
    let [samples, iterations] = PLANS;
    let settings = SolverSettings {
        samples,
        iterations,
        seed,
        ..SolverSettings::default()
    };
    let mut solver = settings.solver(SearchSpace::within(&LIMITS, STEPS, present, settings.seed()));
    let stop = vec![0.0; 2 * STEPS];
    let mut best = (stop.clone(), cost(now, &stop));
    for _ in 0..iterations {
        let plans = solver.propose(samples);
        let scored: Vec<(Vec<f32>, f32)> = plans
            .into_par_iter()
            .map(|plan| {
                let cost = cost(now, &plan);
                (plan, cost)
            })
            .collect();
        for (plan, cost) in &scored {
            if *cost < best.1 {
                best = (plan.clone(), *cost);
            }
        }
        solver.learn(&scored);
    }
    best.0.as_chunks::<2>().0.to_vec()
}

/// The cost of a plan by what really would happen: the costs and weights of the planner.
fn cost(now: &Situation<'_>, plan: &[f32]) -> f32 {
    let commands = plan.as_chunks::<2>().0;
    let steps = now.world.try_plan(commands);
    let start = now.world.observer_pose();
    let [ahead, left] = now.goal_m;
    let goal = in_room(start, now.goal_m);
    let Some(end) = steps.last().map(|step| step.pose) else {
        return f32::INFINITY;
    };
    let distance = (goal[0] - end.x_m).hypot(goal[1] - end.y_m);
    let aim = start.heading_rad + left.atan2(ahead);
    let heading = wrap(aim - end.heading_rad).abs();
    let narrowest = steps.iter().map(|step| step.gap_m).fold(f32::INFINITY, f32::min);
    let touch = if steps.iter().any(|step| step.touched) {
        1.0
    } else {
        0.0
    };
    distance + HEADING_WEIGHT * heading + CLEARANCE_WEIGHT * ((MARGIN_M - narrowest).max(0.0) + touch)
}
