//! Who joins the next batch: a pure function of what waits, the time and the limit.

use std::time::Instant;

/// What the policy knows of a waiting request.
#[derive(Clone, Copy, Debug)]
pub struct Candidate<'a> {
    /// The model it asks for.
    pub model: &'a str,
    /// Whether its client has gone.
    pub abandoned: bool,
    /// When its answer would be too late.
    pub deadline: Instant,
}

/// Positions in the queue, each in rising order and in at most one of the two.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Plan {
    /// Those whose answer nobody waits for any more.
    pub discard: Vec<usize>,
    /// Those to compute now, together.
    pub batch: Vec<usize>,
}

/// The oldest request that is still wanted chooses the model; those behind it for the same model join in order, up to
/// `limit`.
#[must_use]
pub fn plan(waiting: &[Candidate<'_>], now: Instant, limit: usize) -> Plan {
    let mut plan = Plan::default();
    let mut model = None;
    for (position, candidate) in waiting.iter().enumerate() {
        if candidate.abandoned || candidate.deadline <= now {
            plan.discard.push(position);
        } else if plan.batch.len() < limit && *model.get_or_insert(candidate.model) == candidate.model {
            plan.batch.push(position);
        }
    }
    plan
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use proptest::prelude::*;

    use super::*;

    fn candidates(kinds: &[(u8, bool, bool)], now: Instant) -> Vec<Candidate<'static>> {
        kinds
            .iter()
            .map(|&(model, abandoned, late)| Candidate {
                model: ["a", "b", "c"][usize::from(model % 3)],
                abandoned,
                deadline: if late { now } else { now + Duration::from_secs(1) },
            })
            .collect()
    }

    #[test]
    fn the_oldest_request_chooses_the_model_and_others_of_it_join() {
        let now = Instant::now();
        let waiting = candidates(
            &[
                (0, true, false),
                (1, false, false),
                (0, false, false),
                (1, false, false),
            ],
            now,
        );
        let plan = plan(&waiting, now, 8);
        assert_eq!(plan.discard, [0]);
        assert_eq!(plan.batch, [1, 3]);
    }

    #[test]
    fn a_request_past_its_deadline_is_not_computed() {
        let now = Instant::now();
        let waiting = candidates(&[(0, false, true)], now);
        assert_eq!(
            plan(&waiting, now, 8),
            Plan {
                discard: vec![0],
                batch: vec![]
            }
        );
    }

    proptest! {
        #[test]
        fn a_batch_is_of_one_model_in_order_within_the_limit_and_holds_the_oldest(
            kinds in proptest::collection::vec(any::<(u8, bool, bool)>(), 0..40),
            limit in 1usize..10,
        ) {
            let now = Instant::now();
            let waiting = candidates(&kinds, now);
            let plan = plan(&waiting, now, limit);
            prop_assert!(plan.batch.len() <= limit);
            prop_assert!(plan.batch.is_sorted());
            prop_assert!(plan.batch.iter().all(|&i| waiting[i].model == waiting[plan.batch[0]].model));
            let wanted = |c: &Candidate<'_>| !c.abandoned && c.deadline > now;
            prop_assert_eq!(plan.batch.first().copied(), waiting.iter().position(wanted));
            prop_assert!(plan.discard.iter().all(|&i| !wanted(&waiting[i])));
            prop_assert_eq!(plan.discard.len(), waiting.iter().filter(|c| !wanted(c)).count());
        }
    }
}
