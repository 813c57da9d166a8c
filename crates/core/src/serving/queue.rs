//! The bounded queue between the handles and the inference thread.

use std::collections::VecDeque;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use tokio::sync::oneshot;

use super::batch::{self, Candidate};
use super::error::ServingError;
use super::meter;
use super::prediction::Prediction;
use super::task::Task;
use crate::registry::Model;

/// A full queue of the reference model's predictions is computed well within this time.
const RETRY_AFTER_S: u64 = 1;

/// A waiting task.
pub(super) struct QueuedTask {
    pub(super) model: Arc<Model>,
    pub(super) task: Task,
    /// The session that it is a step of.
    pub(super) session: Option<u64>,
    pub(super) accepted: Instant,
    pub(super) deadline: Instant,
    pub(super) reply: oneshot::Sender<Result<Prediction, ServingError>>,
}

impl QueuedTask {
    /// Counts a task that is not computed. Who waits gives up at the deadline too, and before it only if the client is gone.
    fn record_refusal(&self, now: Instant) {
        meter::record_refusal(if self.deadline <= now { "deadline" } else { "abandoned" });
    }
}

/// A model to load.
pub(super) struct ModelLoad {
    pub(super) model: Model,
    pub(super) reply: SyncSender<Result<(), ServingError>>,
}

/// What the inference thread does next.
pub(super) enum WorkItem {
    ModelLoad(Box<ModelLoad>),
    Batch(Vec<QueuedTask>),
    Stop,
}

#[derive(Default)]
struct QueueState {
    waiting: VecDeque<QueuedTask>,
    loads: VecDeque<ModelLoad>,
    /// Whether the last batch passed an older task. Then the oldest is next, so that steps of sessions never keep others waiting for long.
    has_passed: bool,
    closed: bool,
}

pub(super) struct Queue {
    state: Mutex<QueueState>,
    arrived: Condvar,
    capacity: usize,
    batch_limit: usize,
}

impl Queue {
    pub(super) fn new(capacity: usize, batch_limit: usize) -> Self {
        Self {
            state: Mutex::default(),
            arrived: Condvar::new(),
            capacity,
            batch_limit,
        }
    }

    pub(super) fn push(&self, request: QueuedTask) -> Result<(), ServingError> {
        let mut state = self.state();
        if state.closed {
            return Err(ServingError::Stopped);
        }
        if state.waiting.len() >= self.capacity {
            // Disconnected clients do not occupy the queue.
            let now = Instant::now();
            state.waiting.retain(|waiting| {
                let is_wanted = !waiting.reply.is_closed();
                if !is_wanted {
                    waiting.record_refusal(now);
                }
                is_wanted
            });
        }
        if state.waiting.len() >= self.capacity {
            meter::record_refusal("full");
            return Err(ServingError::QueueFull {
                capacity: self.capacity,
                retry_after_s: RETRY_AFTER_S,
            });
        }
        state.waiting.push_back(request);
        let count = state.waiting.len();
        // The woken thread needs the lock.
        drop(state);
        self.arrived.notify_one();
        meter::set_waiting(count);
        Ok(())
    }

    pub(super) fn load(&self, load: ModelLoad) -> Result<(), ServingError> {
        let mut state = self.state();
        if state.closed {
            return Err(ServingError::Stopped);
        }
        state.loads.push_back(load);
        self.arrived.notify_one();
        Ok(())
    }

    /// Refuses new tasks; the waiting ones are still computed.
    pub(super) fn close(&self) {
        self.state().closed = true;
        self.arrived.notify_all();
    }

    pub(super) fn is_closed(&self) -> bool {
        self.state().closed
    }

    /// Blocks until there is something to do.
    pub(super) fn next_work(&self) -> WorkItem {
        let mut state = self.state();
        loop {
            if let Some(load) = state.loads.pop_front() {
                return WorkItem::ModelLoad(Box::new(load));
            }
            let batch = state.next_batch(Instant::now(), self.batch_limit);
            if !batch.is_empty() {
                return WorkItem::Batch(batch);
            }
            if state.closed {
                return WorkItem::Stop;
            }
            state = self.arrived.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn state(&self) -> MutexGuard<'_, QueueState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl QueueState {
    fn next_batch(&mut self, now: Instant, batch_limit: usize) -> Vec<QueuedTask> {
        // Where a batch saves nothing, one rollout for each core: all would else be answered when the last one is computed.
        let of_cores = batch_limit.min(rayon::current_num_threads());
        let candidates: Vec<Candidate> = self
            .waiting
            .iter()
            .map(|waiting| Candidate {
                model: Arc::as_ptr(&waiting.model).addr(),
                session: waiting.session,
                rows: waiting.task.conditioning_inputs.len().max(1),
                row_limit: if waiting.model.network.gains_from_batches() {
                    batch_limit
                } else {
                    of_cores
                },
                abandoned: waiting.reply.is_closed(),
                deadline: waiting.deadline,
            })
            .collect();
        let choice = batch::choose(&candidates, now, !self.has_passed);
        let oldest_left = (0..candidates.len()).find(|place| choice.discard.binary_search(place).is_err());
        self.has_passed = oldest_left.is_some_and(|oldest| choice.batch.binary_search(&oldest).is_err());
        let mut batch = Vec::with_capacity(choice.batch.len());
        let mut remaining = VecDeque::with_capacity(self.waiting.len());
        for (position, waiting) in self.waiting.drain(..).enumerate() {
            if choice.batch.binary_search(&position).is_ok() {
                batch.push(waiting);
            } else if choice.discard.binary_search(&position).is_ok() {
                waiting.record_refusal(now);
            } else {
                remaining.push_back(waiting);
            }
        }
        self.waiting = remaining;
        meter::set_waiting(self.waiting.len());
        batch
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::serving::{test_flow_model, test_model};

    type Answer = oneshot::Receiver<Result<Prediction, ServingError>>;

    fn request(model: &Arc<Model>) -> (QueuedTask, Answer) {
        let (reply, answer) = oneshot::channel();
        let accepted = Instant::now();
        let waiting = QueuedTask {
            model: Arc::clone(model),
            task: Task::default(),
            session: None,
            accepted,
            deadline: accepted + Duration::from_mins(1),
            reply,
        };
        (waiting, answer)
    }

    #[test]
    fn a_full_queue_refuses_and_names_its_capacity() {
        let (queue, model) = (Queue::new(2, 8), Arc::new(test_model()));
        let (requests, _answers): (Vec<_>, Vec<_>) = (0..3).map(|_| request(&model)).unzip();
        let results: Vec<_> = requests.into_iter().map(|request| queue.push(request)).collect();
        assert!(results[0].is_ok() && results[1].is_ok());
        assert!(matches!(results[2], Err(ServingError::QueueFull { capacity: 2, .. })));
    }

    #[test]
    fn an_abandoned_request_is_removed_and_never_computed() {
        let (queue, one, other) = (Queue::new(1, 8), Arc::new(test_model()), Arc::new(test_model()));
        let (first, answer) = request(&one);
        queue.push(first).unwrap();
        drop(answer);
        let (second, _answer) = request(&other);
        queue.push(second).unwrap();
        let WorkItem::Batch(batch) = queue.next_work() else {
            panic!()
        };
        assert_eq!(batch.len(), 1);
        assert!(Arc::ptr_eq(&batch[0].model, &other));
    }

    #[test]
    fn two_versions_of_a_model_are_never_computed_together() {
        let (queue, old, new) = (Queue::new(4, 8), Arc::new(test_model()), Arc::new(test_model()));
        let (requests, _answers): (Vec<_>, Vec<_>) = [&old, &new, &old].into_iter().map(request).unzip();
        for request in requests {
            queue.push(request).unwrap();
        }
        assert!(matches!(queue.next_work(), WorkItem::Batch(batch) if batch.len() == 2));
        assert!(matches!(queue.next_work(), WorkItem::Batch(batch) if batch.len() == 1));
    }

    #[test]
    fn steps_of_sessions_and_older_requests_take_turns() {
        let (queue, model) = (Queue::new(8, 1), Arc::new(test_model()));
        let (mut requests, _answers): (Vec<_>, Vec<_>) = (0..4).map(|_| request(&model)).unzip();
        for (session, request) in (1..).zip(&mut requests[2..]) {
            request.session = Some(session);
        }
        for request in requests {
            queue.push(request).unwrap();
        }
        let sessions = [(); 4].map(|()| match queue.next_work() {
            WorkItem::Batch(batch) => batch[0].session,
            _ => panic!(),
        });
        assert_eq!(sessions, [Some(1), None, Some(2), None]);
    }

    #[test]
    fn windows_of_a_flow_network_are_computed_one_for_each_core() {
        let (queue, model) = (Queue::new(8, 8), Arc::new(test_flow_model()));
        let (requests, _answers): (Vec<_>, Vec<_>) = (0..5).map(|_| request(&model)).unzip();
        for request in requests {
            queue.push(request).unwrap();
        }
        let on_cores = |cores| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(cores).build().unwrap();
            let WorkItem::Batch(batch) = pool.install(|| queue.next_work()) else {
                panic!()
            };
            batch.len()
        };
        assert_eq!([1, 3, 3].map(on_cores), [1, 3, 1]);
        let narrow = Queue::new(8, 2);
        let (requests, _answers): (Vec<_>, Vec<_>) = (0..3).map(|_| request(&model)).unzip();
        for request in requests {
            narrow.push(request).unwrap();
        }
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        assert!(matches!(pool.install(|| narrow.next_work()), WorkItem::Batch(batch) if batch.len() == 2));
    }

    #[test]
    fn a_closed_queue_is_emptied_and_then_stops() {
        let (queue, model) = (Queue::new(4, 1), Arc::new(test_model()));
        let (first, _answer) = request(&model);
        queue.push(first).unwrap();
        queue.close();
        assert!(matches!(queue.push(request(&model).0), Err(ServingError::Stopped)));
        assert!(matches!(queue.next_work(), WorkItem::Batch(batch) if batch.len() == 1));
        assert!(matches!(queue.next_work(), WorkItem::Stop));
    }
}
