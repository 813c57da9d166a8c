//! Chooses the tasks of the next batch: a pure function of the waiting tasks, the time and the limits.

use std::time::Instant;

/// A waiting task, as far as batching needs to know it.
#[derive(Clone, Copy, Debug)]
pub struct Candidate {
    /// Identifies the model version: equal numbers mean the same version.
    pub model: usize,
    /// The session that it is a step of.
    pub session: Option<u64>,
    /// Number of rollouts that it asks for, at least 1.
    pub rows: usize,
    /// How many rollouts of its model are computed together at most.
    pub row_limit: usize,
    /// Whether nobody waits for its answer any more.
    pub abandoned: bool,
    /// After this time nobody needs the answer.
    pub deadline: Instant,
}

/// Positions in the queue, in rising order. No position is in both lists.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BatchChoice {
    /// Tasks whose answer nobody needs any more.
    pub discard: Vec<usize>,
    /// Tasks to compute now, together.
    pub batch: Vec<usize>,
}

/// The first live task chooses the model. Later tasks of the same model join in order while the rows stay within its
/// limit, at most one task of a session. The first task is always included, even if it alone exceeds the limit. They are taken
/// in the order of their arrival; if `steps_first`, tasks of a session with one rollout go before the others: robots wait for these.
#[must_use]
pub fn choose(waiting: &[Candidate], now: Instant, steps_first: bool) -> BatchChoice {
    let mut choice = BatchChoice::default();
    let (mut model, mut rows, mut sessions) = (None, 0, Vec::new());
    let mut order: Vec<(usize, &Candidate)> = waiting.iter().enumerate().collect();
    let is_step = |candidate: &Candidate| candidate.session.is_some() && candidate.rows == 1;
    order.sort_by_key(|(_, candidate)| steps_first && !is_step(candidate));
    for (position, candidate) in order {
        if candidate.abandoned || candidate.deadline <= now {
            choice.discard.push(position);
            continue;
        }
        let fits = choice.batch.is_empty() || rows + candidate.rows <= candidate.row_limit;
        let is_later_step = candidate.session.is_some_and(|session| sessions.contains(&session));
        sessions.extend(candidate.session);
        if fits && !is_later_step && *model.get_or_insert(candidate.model) == candidate.model {
            choice.batch.push(position);
            rows += candidate.rows;
        }
    }
    choice.batch.sort_unstable();
    choice.discard.sort_unstable();
    choice
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use proptest::prelude::*;

    use super::*;

    #[derive(Clone, Debug)]
    struct TaskKind {
        model: usize,
        session: Option<u64>,
        rows: usize,
        abandoned: bool,
        late: bool,
    }

    fn of(model: usize) -> TaskKind {
        TaskKind {
            model,
            session: None,
            rows: 1,
            abandoned: false,
            late: false,
        }
    }

    fn kinds() -> impl Strategy<Value = Vec<TaskKind>> {
        let kind = (
            0usize..3,
            proptest::option::of(0u64..4),
            1usize..6,
            any::<bool>(),
            any::<bool>(),
        );
        let kind = kind.prop_map(|(model, session, rows, abandoned, late)| TaskKind {
            model,
            session,
            rows,
            abandoned,
            late,
        });
        proptest::collection::vec(kind, 0..40)
    }

    fn candidates(kinds: &[TaskKind], now: Instant, row_limit: usize) -> Vec<Candidate> {
        kinds
            .iter()
            .map(|kind| Candidate {
                model: kind.model,
                session: kind.session,
                rows: kind.rows,
                row_limit,
                abandoned: kind.abandoned,
                deadline: if kind.late { now } else { now + Duration::from_secs(1) },
            })
            .collect()
    }

    fn chosen(kinds: &[TaskKind], limit: usize) -> BatchChoice {
        let now = Instant::now();
        choose(&candidates(kinds, now, limit), now, false)
    }

    #[test]
    fn the_oldest_task_chooses_the_model_and_others_of_it_join() {
        let abandoned = TaskKind {
            abandoned: true,
            ..of(0)
        };
        let choice = chosen(&[abandoned, of(1), of(0), of(1)], 8);
        assert_eq!((choice.discard, choice.batch), (vec![0], vec![1, 3]));
    }

    #[test]
    fn a_task_past_its_deadline_is_not_computed() {
        let choice = chosen(&[TaskKind { late: true, ..of(0) }], 8);
        assert_eq!((choice.discard, choice.batch), (vec![0], vec![]));
    }

    #[test]
    fn a_second_step_of_a_session_waits_for_the_next_batch() {
        let step = |session| TaskKind {
            session: Some(session),
            ..of(0)
        };
        assert_eq!(chosen(&[step(1), step(1), step(2)], 8).batch, [0, 2]);
    }

    #[test]
    fn a_large_task_runs_alone_and_small_tasks_pass_it() {
        let rows = |rows| TaskKind { rows, ..of(0) };
        assert_eq!(chosen(&[rows(100), of(0)], 8).batch, [0]);
        assert_eq!(chosen(&[of(0), rows(100), of(0)], 8).batch, [0, 2]);
    }

    #[test]
    fn steps_of_sessions_pass_older_tasks() {
        let now = Instant::now();
        let step = |session| TaskKind {
            session: Some(session),
            ..of(1)
        };
        let many = TaskKind {
            rows: 4,
            session: Some(3),
            ..of(0)
        };
        let waiting = candidates(&[many, of(1), step(1), step(2)], now, 3);
        assert_eq!(choose(&waiting, now, true).batch, [1, 2, 3]);
        assert_eq!(choose(&waiting, now, false).batch, [0]);
        let waiting = candidates(&[of(1), of(1), step(1), step(2)], now, 2);
        assert_eq!(choose(&waiting, now, true).batch, [2, 3]);
    }

    proptest! {
        #[test]
        fn a_batch_holds_the_oldest_task_and_others_of_its_model(kinds in kinds(), limit in 1usize..10) {
            let now = Instant::now();
            let waiting = candidates(&kinds, now, limit);
            let choice = choose(&waiting, now, false);
            let rows: usize = choice.batch.iter().map(|&i| waiting[i].rows).sum();
            prop_assert!(rows <= limit || choice.batch.len() == 1);
            prop_assert!(choice.batch.is_sorted());
            prop_assert!(choice.batch.iter().all(|&i| waiting[i].model == waiting[choice.batch[0]].model));
            let wanted = |c: &Candidate| !c.abandoned && c.deadline > now;
            prop_assert_eq!(choice.batch.first().copied(), waiting.iter().position(wanted));
            prop_assert!(choice.discard.iter().all(|&i| !wanted(&waiting[i])));
            prop_assert_eq!(choice.discard.len(), waiting.iter().filter(|c| !wanted(c)).count());
        }

        #[test]
        fn a_batch_holds_only_the_oldest_step_of_a_session(kinds in kinds(), limit in 1usize..10) {
            let now = Instant::now();
            let waiting = candidates(&kinds, now, limit);
            for &position in &choose(&waiting, now, false).batch {
                let earlier = waiting[..position].iter().filter(|c| !c.abandoned && c.deadline > now);
                let session = waiting[position].session;
                prop_assert!(session.is_none() || earlier.clone().all(|c| c.session != session));
            }
        }
    }
}
