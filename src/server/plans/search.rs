//! A search on this server: plans are judged on a blocking thread, and predicted by the inference thread beside other requests.

use std::sync::Arc;
use std::time::{Duration, Instant};

use metrics::{counter, histogram};

use crate::server::blocking::BlockingWork;
use crate::server::http::problem::ApiError;
use foreframe_core::metric_names;
use foreframe_core::planning::{PlanBatch, PlanChoice, PlanError, Planner, PlannerInput};
use foreframe_core::registry::Model;
use foreframe_core::serving::{ConditioningInput, Prediction, Predictor, Task};

/// A search that has not run.
pub(in crate::server) struct PlanTask {
    pub(in crate::server) model: Arc<Model>,
    pub(in crate::server) context: Task,
    /// The session's number in the predictor.
    pub(in crate::server) session: Option<u64>,
    pub(in crate::server) begun: Instant,
}

/// The answer of a search, with the model that made it.
pub(in crate::server) struct ChosenPlan {
    pub(in crate::server) model: Arc<Model>,
    pub(in crate::server) choice: PlanChoice,
}

impl PlanTask {
    /// Errors: what of the input does not fit the model, and why it could not be computed.
    pub(in crate::server) async fn run(
        self,
        predictor: &Predictor,
        blocking: &BlockingWork,
        input: PlannerInput,
    ) -> Result<ChosenPlan, ApiError> {
        let (state, budget, begun) = (input.state.clone(), input.settings.budget, self.begun);
        let model = Arc::clone(&self.model);
        let mut planner = blocking.run(move || Planner::new(&model, input)).await??;
        let steps = planner.steps();
        let mut predicted: Option<(Prediction, Duration)> = None;
        loop {
            let next = move || -> Result<(Planner, Option<PlanBatch>), PlanError> {
                if let Some((prediction, took)) = predicted {
                    planner.record(prediction, took)?;
                }
                let batch = planner.next_batch(&|| begun.elapsed())?;
                Ok((planner, batch))
            };
            let batch;
            (planner, batch) = blocking.run(next).await??;
            let Some(batch) = batch else { break };
            let asked = Instant::now();
            let inputs = ConditioningInput::of_plans(batch.plans, state.clone(), Some(steps), &self.model.manifest)?;
            let task = self.context.with_rollouts(inputs, batch.sees_occupancy);
            let Some(prediction) = self.predict(predictor, task, budget).await? else {
                break;
            };
            predicted = Some((prediction, asked.elapsed()));
        }
        let choice = blocking.run(move || planner.finish()).await?;
        self.count(&choice);
        Ok(ChosenPlan {
            model: self.model,
            choice,
        })
    }

    /// The prediction of a batch of plans; `None` if the budget was over before it came.
    async fn predict(
        &self,
        predictor: &Predictor,
        task: Task,
        budget: Option<Duration>,
    ) -> Result<Option<Prediction>, ApiError> {
        let computed = predictor.compute(&self.model, task, self.session);
        let Some(budget) = budget else {
            return Ok(Some(computed.await?));
        };
        match tokio::time::timeout_at((self.begun + budget).into(), computed).await {
            Ok(prediction) => Ok(Some(prediction?)),
            Err(_) => Ok(None),
        }
    }

    fn count(&self, choice: &PlanChoice) {
        let model = self.model.manifest.name.to_string();
        let outcome = match choice.unsafe_reason {
            None => "safe",
            Some(_) => "stop",
        };
        counter!(metric_names::PLANS, "model" => model.clone(), "outcome" => outcome).increment(1);
        histogram!(metric_names::PLAN_SECONDS, "model" => model).record(self.begun.elapsed());
    }
}

impl From<PlanError> for ApiError {
    fn from(error: PlanError) -> Self {
        match error {
            PlanError::Prediction(error) => error.into(),
            _ => Self::of(&error),
        }
    }
}
