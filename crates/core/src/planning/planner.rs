//! The search for a plan, as a sequence of batches to predict. It has no clock: the caller says how much time is over.

use std::time::Duration;

use super::choice::{CandidateKind, PlanChoice, UnsafeReason};
use super::error::PlanError;
use super::judge::{Judge, PlannerInput, Tried};
use super::solver::{SearchSpace, Solver};
use crate::registry::Model;
use crate::registry::calibration::NOVELTY_LIMIT;
use crate::serving::{Prediction, Rollout};
use crate::types::Action;

/// Plans that are judged between two looks at the clock.
const JUDGED_TOGETHER: usize = 64;
/// Plans that are predicted together at most.
const PREDICTED_TOGETHER: usize = 32;
/// How much longer than so far a prediction may take before it breaks the budget.
const CAUTION: f64 = 1.3;
/// Two plans are different if their actions differ by this share of the ranges (root mean square).
const DISTINCT: f32 = 0.1;

/// Plans whose frames the search needs.
#[derive(Clone, Debug, PartialEq)]
pub struct PlanBatch {
    /// The plans.
    pub plans: Vec<Vec<Action>>,
    /// Whether it also needs to know what stands around the robot.
    pub sees_occupancy: bool,
}

enum Phase {
    /// Stopping and the present plan are predicted, and what stands in the way is looked at.
    First,
    Search,
    /// The best plans are predicted.
    Final,
}

/// Searches for the best plan.
pub struct Planner {
    judge: Judge,
    solver: Box<dyn Solver>,
    phase: Phase,
    /// Not judged yet.
    waiting: Vec<Tried>,
    /// Being predicted.
    asked: Vec<Tried>,
    /// Judged in this iteration.
    scored: Vec<(Vec<f32>, f32)>,
    /// Stopping and the present plan.
    fixed: Vec<Tried>,
    /// The best drawn plans, which differ, best first.
    drawn: Vec<Tried>,
    iterations: usize,
    samples: usize,
    predicted: usize,
    /// The longest time that the prediction of a plan took, in seconds.
    rollout_s: f64,
    /// When the search ends, so that there is time for the last predictions.
    search_end: Option<Duration>,
}

impl Planner {
    /// A search that has not begun. Errors: what of the goal, the settings or the limits is wrong, or does not fit the model.
    pub fn new(model: &Model, input: PlannerInput) -> Result<Self, PlanError> {
        let judge = Judge::new(model, input)?;
        let fixed = judge.fixed_plans();
        let start = fixed.last().filter(|tried| tried.kind == CandidateKind::Present);
        let start = start.map_or_else(
            || SearchSpace::middle(&judge.limits, judge.steps),
            |tried| tried.plan.clone(),
        );
        let settings = judge.input.settings.solver;
        let solver = settings.solver(SearchSpace {
            steps: judge.steps,
            limits: judge.limits.clone(),
            start,
            seed: settings.seed(),
            noise_color: settings.noise_color,
        });
        Ok(Self {
            judge,
            solver,
            phase: Phase::First,
            waiting: fixed,
            asked: Vec::new(),
            scored: Vec::new(),
            fixed: Vec::new(),
            drawn: Vec::new(),
            iterations: 0,
            samples: 0,
            predicted: 0,
            rollout_s: 0.0,
            search_end: None,
        })
    }

    /// Actions of a plan.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.judge.steps
    }

    /// The next plans to predict; `None` if the search has ended. `elapsed` tells how much time is over since it began.
    /// Errors: `Motion`.
    pub fn next_batch(&mut self, elapsed: &dyn Fn() -> Duration) -> Result<Option<PlanBatch>, PlanError> {
        if matches!(self.phase, Phase::First) {
            let mut first = std::mem::take(&mut self.waiting);
            if !self.predicts_plans() {
                // Only stopping, the first, is predicted.
                self.waiting = first.split_off(1);
            }
            self.phase = Phase::Search;
            return Ok(Some(self.ask(first, true)));
        }
        while matches!(self.phase, Phase::Search) {
            if let Some(batch) = self.search(elapsed)? {
                return Ok(Some(batch));
            }
        }
        let finalists = if self.predicts_plans() {
            self.judge.input.settings.finalists
        } else {
            0
        };
        let waiting = self.drawn.iter().take(finalists);
        let open = waiting.filter(|tried| tried.rollout.is_none()).count();
        let count = open.min(self.affordable(self.judge.input.settings.budget, elapsed()));
        let mut chosen = Vec::new();
        let mut index = 0;
        while chosen.len() < count {
            if self.drawn[index].rollout.is_none() {
                chosen.push(self.drawn.remove(index));
            } else {
                index += 1;
            }
        }
        Ok((!chosen.is_empty()).then(|| self.ask(chosen, false)))
    }

    /// Takes the prediction of the last batch, which took that long. Errors: `Motion`.
    pub fn record(&mut self, prediction: Prediction, took: Duration) -> Result<(), PlanError> {
        let asked = std::mem::take(&mut self.asked);
        self.predicted += asked.len();
        self.rollout_s = self.rollout_s.max(took.as_secs_f64() / asked.len().max(1) as f64);
        if let Some(occupancy) = &prediction.occupancy {
            self.judge.see(occupancy);
        }
        let with_rollout = |(mut tried, rollout): (Tried, Rollout)| {
            tried.rollout = Some(rollout);
            tried
        };
        let predicted = asked.into_iter().zip(prediction.rollouts).map(with_rollout);
        self.judge(predicted.collect())?;
        if !self.predicts_plans() {
            let present = std::mem::take(&mut self.waiting);
            self.judge(present)?;
        }
        Ok(())
    }

    /// Whether other plans than stopping are predicted.
    fn predicts_plans(&self) -> bool {
        self.judge.input.settings.predicts_plans || self.judge.needs_frames()
    }

    /// The best plan of those that were judged.
    #[must_use]
    pub fn finish(mut self) -> PlanChoice {
        // Plans whose prediction came too late were judged before without it; stopping is always an answer.
        let (late, unjudged): (Vec<Tried>, Vec<Tried>) =
            self.asked.drain(..).partition(|tried| !tried.values.is_empty());
        self.drawn.extend(late);
        let mut begun = self.fixed.iter().chain(&unjudged);
        let stop = begun.find(|tried| tried.kind == CandidateKind::Stop).cloned();
        let stop = stop.or_else(|| self.judge.fixed_plans().into_iter().next());
        let of_context = self.fixed.iter().find_map(Tried::novelty);
        let novelty = |tried: &Tried| self.judge.novelty(tried, of_context);
        let is_unknown = |tried: &Tried| novelty(tried).is_some_and(|novelty| novelty >= NOVELTY_LIMIT);
        let all: Vec<&Tried> = self.fixed.iter().chain(&self.drawn).collect();
        // Costs of predicted frames count only if all that are compared have them.
        let has_rollouts =
            self.predicts_plans() && (self.drawn.is_empty() || self.drawn.iter().any(|tried| tried.rollout.is_some()));
        let mut compared: Vec<&Tried> = all
            .into_iter()
            .filter(|tried| !has_rollouts || tried.rollout.is_some())
            .collect();
        let total = |tried: &Tried| self.judge.total(tried, has_rollouts);
        compared.sort_by(|one, two| {
            (one.touches, is_unknown(one), total(one))
                .partial_cmp(&(two.touches, is_unknown(two), total(two)))
                .unwrap_or(std::cmp::Ordering::Equal)
        });
        let unsafe_reason = if compared.is_empty() {
            Some(UnsafeReason::NoTime)
        } else if compared[0].touches {
            Some(UnsafeReason::NoFreeWay)
        } else if is_unknown(compared[0]) {
            Some(UnsafeReason::UnknownSurroundings)
        } else {
            None
        };
        let candidate = |tried: &Tried| self.judge.candidate(tried, has_rollouts, novelty(tried));
        let stop = stop.map(|tried| candidate(&tried));
        let best = match (unsafe_reason, compared.first(), stop) {
            (None, Some(best), _) | (_, Some(best), None) => candidate(best),
            (_, _, stop) => stop.expect("a search without stopping is a bug"),
        };
        let others = compared.iter().map(|tried| candidate(tried));
        let runners_up = others.filter(|other| other.actions != best.actions);
        PlanChoice {
            runners_up: runners_up.take(self.judge.input.settings.finalists).collect(),
            best,
            unsafe_reason,
            clearance_checked: self.judge.obstacles().is_some(),
            obstacles: self.judge.obstacles().cloned().unwrap_or_default(),
            samples: self.samples,
            predicted: self.predicted,
            iterations: self.iterations,
        }
    }

    /// One step of the search; a batch if frames are needed.
    fn search(&mut self, elapsed: &dyn Fn() -> Duration) -> Result<Option<PlanBatch>, PlanError> {
        let settings = &self.judge.input.settings;
        let (budget, solver, predicts_plans) = (settings.budget, settings.solver, self.predicts_plans());
        let search_end = *self.search_end.get_or_insert_with(|| {
            let budget = budget.unwrap_or(Duration::MAX);
            let left = budget.saturating_sub(elapsed());
            // Half of what is left is for the last predictions, if there will be any.
            elapsed().saturating_add(if predicts_plans { left / 2 } else { left })
        });
        if self.waiting.is_empty() {
            let is_begun = !self.scored.is_empty();
            if is_begun {
                let scored = std::mem::take(&mut self.scored);
                self.solver.learn(&scored);
                self.iterations += 1;
            }
            if self.iterations >= solver.iterations {
                self.phase = Phase::Final;
                return Ok(None);
            }
            let plans = self.solver.propose(solver.samples);
            self.waiting = plans
                .into_iter()
                .map(|plan| Tried::new(CandidateKind::Drawn, plan))
                .collect();
        }
        let by_frames = self.judge.needs_frames();
        let count = if by_frames {
            self.affordable(budget, elapsed()).min(PREDICTED_TOGETHER)
        } else if elapsed() < search_end {
            JUDGED_TOGETHER
        } else {
            0
        };
        if count == 0 {
            self.phase = Phase::Final;
            return Ok(None);
        }
        let now: Vec<Tried> = self.waiting.drain(..count.min(self.waiting.len())).collect();
        if by_frames {
            return Ok(Some(self.ask(now, false)));
        }
        self.judge(now)?;
        Ok(None)
    }

    /// How many more plans can be predicted in time.
    fn affordable(&self, budget: Option<Duration>, elapsed: Duration) -> usize {
        let Some(budget) = budget else { return usize::MAX };
        let left = budget.saturating_sub(elapsed).as_secs_f64();
        (left / (CAUTION * self.rollout_s).max(1e-9)) as usize
    }

    fn ask(&mut self, tried: Vec<Tried>, sees_occupancy: bool) -> PlanBatch {
        let plans = tried.iter().map(|tried| self.judge.actions(&tried.plan)).collect();
        self.asked = tried;
        PlanBatch { plans, sees_occupancy }
    }

    /// Judges plans, and keeps the good ones.
    fn judge(&mut self, mut tried: Vec<Tried>) -> Result<(), PlanError> {
        self.judge.judge(&mut tried)?;
        for tried in tried {
            if tried.kind != CandidateKind::Drawn {
                self.samples += 1;
                self.fixed.push(tried);
                continue;
            }
            if matches!(self.phase, Phase::Search) {
                self.samples += 1;
                self.scored.push((tried.plan.clone(), self.judge.total(&tried, true)));
            }
            self.keep(tried);
        }
        Ok(())
    }

    /// Keeps a drawn plan if it is good and differs from better ones.
    fn keep(&mut self, tried: Tried) {
        // Costs of predicted frames are left out, so that all plans can be compared, unless they steer the search.
        let all_predicted = self.judge.needs_frames();
        let total = |of: &Tried| self.judge.total(of, all_predicted);
        let place = self.drawn.partition_point(|other| total(other) <= total(&tried));
        let is_like = |other: &Tried| self.judge.difference(&tried.plan, &other.plan) < DISTINCT;
        if self.drawn[..place].iter().any(is_like) {
            return;
        }
        let like: Vec<bool> = self.drawn.iter().map(is_like).collect();
        let mut like = like.into_iter();
        self.drawn.retain(|_| !like.next().unwrap_or(false));
        self.drawn.insert(place, tried);
        self.drawn.truncate(self.judge.input.settings.finalists);
    }
}
