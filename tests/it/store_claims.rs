//! Many workers at one database.

use std::collections::BTreeSet;
use std::time::Instant;

use foreframe_jobs::store::{EnqueueResult, JobId, JobReport, NewJob, Store};

use crate::store::{job, outcome, stores};

/// Enqueues `jobs` jobs with `parts` parts each. Then `workers` claim and end them, one after another. Returns the ids in the
/// order in which they were claimed, and the claims per second.
async fn work(store: &Store, jobs: usize, parts: usize, workers: usize) -> (Vec<JobId>, f64) {
    for _ in 0..jobs {
        let new = NewJob {
            parts: vec!["{}".to_owned(); parts],
            ..job(None, None)
        };
        let enqueued = store.enqueue(new, 1000, 1.0).await.unwrap();
        assert!(matches!(enqueued, EnqueueResult::New(_)));
    }
    let began = Instant::now();
    let workers: Vec<_> = (0..workers)
        .map(|worker| {
            let store = store.clone();
            tokio::spawn(async move {
                let mut ended = Vec::new();
                loop {
                    let claimed = store.claim(&format!("worker-{worker}"), 60.0).await.unwrap();
                    if let Some((row, lease)) = claimed {
                        let claimed_at = Instant::now();
                        assert!(
                            store
                                .end(lease, outcome("succeeded"), JobReport::default())
                                .await
                                .unwrap()
                        );
                        ended.push((claimed_at, row.id));
                    } else if store.open_jobs().await.unwrap().is_empty() {
                        return ended;
                    }
                }
            })
        })
        .collect();
    let mut ended = Vec::new();
    for worker in workers {
        ended.extend(worker.await.unwrap());
    }
    ended.sort();
    let rate = ended.len() as f64 / began.elapsed().as_secs_f64();
    (ended.into_iter().map(|(_, id)| id).collect(), rate)
}

#[tokio::test]
async fn many_workers_do_each_part_once_and_the_job_last() {
    for (_dir, store) in stores("claims").await {
        let (ended, _) = work(&store, 1, 40, 4).await;
        assert_eq!(ended.len(), 41);
        assert_eq!(ended.iter().collect::<BTreeSet<_>>().len(), 41);
        assert_eq!(ended.last(), Some(&JobId::new(1)));
    }
}

/// Prints how many claims with their ends a database does in a second: `cargo test --release --test it -- --ignored --nocapture
/// claims_per_second`.
#[tokio::test]
#[ignore = "measures"]
async fn claims_per_second() {
    for (jobs, parts) in [(1, 60), (10, 60)] {
        for (_dir, store) in stores(&format!("claims_{jobs}")).await {
            let (ended, rate) = work(&store, jobs, parts, 8).await;
            println!("{} jobs and parts: {rate:.0} claims/s", ended.len());
        }
    }
}
