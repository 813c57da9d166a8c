//! Jobs with parts in the store.

use foreframe_jobs::store::{Author, EnqueueResult, JobId, JobPage, JobReport, NewJob, PartCounts, Store};

use crate::store::{job, outcome, stores};

const PARENT: JobId = JobId::new(1);

/// Enqueues job 1 with parts 2, 3 and 4.
async fn enqueue_parts(store: &Store) {
    let new = NewJob {
        parts: vec!["{}".to_owned(); 3],
        ..job(None, None)
    };
    let enqueued = store.enqueue(new, 100, 1.0).await.unwrap();
    assert!(matches!(enqueued, EnqueueResult::New(row) if row.id == PARENT));
}

async fn counts(store: &Store) -> PartCounts {
    store.job(PARENT).await.unwrap().unwrap().parts
}

async fn ids(store: &Store, part_of: Option<JobId>) -> Vec<JobId> {
    let page = JobPage {
        part_of,
        limit: 9,
        ..JobPage::default()
    };
    store.jobs(page).await.unwrap().iter().map(|row| row.id).collect()
}

async fn end(store: &Store, state: &'static str) -> JobId {
    let (row, lease) = store.claim_at("worker", 2.0, 9.0).await.unwrap().unwrap();
    assert!(store.end(lease, outcome(state), JobReport::default()).await.unwrap());
    row.id
}

#[tokio::test]
async fn a_job_waits_until_its_parts_have_ended() {
    for (_dir, store) in stores("parts_wait").await {
        enqueue_parts(&store).await;
        assert_eq!(ids(&store, None).await, [PARENT]);
        assert_eq!(ids(&store, Some(PARENT)).await, [4, 3, 2].map(JobId::new));
        assert_eq!(end(&store, "succeeded").await, JobId::new(2));
        assert_eq!(end(&store, "failed").await, JobId::new(3));
        let (row, slow) = store.claim_at("slow", 2.0, 3.0).await.unwrap().unwrap();
        assert_eq!((row.id, row.parent), (JobId::new(4), Some(1)));
        assert_eq!(store.claim_at("other", 2.5, 9.0).await.unwrap(), None);
        let expected = PartCounts {
            total: 3,
            done: 1,
            running: 1,
            failed: 1,
        };
        assert_eq!(counts(&store).await, expected);
        // Another worker takes the part of a worker that is silent, whose end then counts no more.
        let (row, fresh) = store.claim_at("other", 4.0, 9.0).await.unwrap().unwrap();
        assert_eq!((row.id, row.token), (JobId::new(4), 2));
        let late = store.end(slow, outcome("failed"), JobReport::default()).await.unwrap();
        assert!(!late);
        assert_eq!(store.claim_at("third", 5.0, 9.0).await.unwrap(), None);
        assert!(
            store
                .end(fresh, outcome("succeeded"), JobReport::default())
                .await
                .unwrap()
        );
        assert_eq!(end(&store, "failed").await, PARENT);

        // What failed is done again, and only that.
        store.requeue(PARENT, 100, &Author::CommandLine).await.unwrap().unwrap();
        assert_eq!(end(&store, "succeeded").await, JobId::new(3));
        assert_eq!(end(&store, "succeeded").await, PARENT);
        assert_eq!(counts(&store).await.done, 3);
        assert_eq!(store.forget_ended(1).await.unwrap(), []);
        let mut forgotten = store.forget_ended(0).await.unwrap();
        forgotten.sort();
        assert_eq!(forgotten, [1, 2, 3, 4].map(JobId::new));
    }
}

#[tokio::test]
async fn a_cancelled_job_cancels_its_parts() {
    for (_dir, store) in stores("parts_cancel").await {
        enqueue_parts(&store).await;
        let (_, lease) = store.claim_at("worker", 2.0, 9.0).await.unwrap().unwrap();
        assert!(store.cancel_queued(PARENT, 3.0, &Author::CommandLine).await.unwrap());
        let renewed = store.renew_at(lease, 9.0, JobReport::default()).await.unwrap();
        assert_eq!(renewed, Some(true));
        assert_eq!(store.claim_at("other", 3.0, 9.0).await.unwrap(), None);
        // Its files are in use until the part that ran has stopped.
        assert_eq!(store.forget_ended(0).await.unwrap(), []);
        assert_eq!(store.open_jobs().await.unwrap().len(), 1);
        // Resumed now, that part would stay cancelled.
        let resumed = store.requeue(PARENT, 9, &Author::CommandLine).await.unwrap();
        assert!(matches!(resumed, Some(EnqueueResult::PartsStopping)), "{resumed:?}");
        assert!(
            store
                .end(lease, outcome("cancelled"), JobReport::default())
                .await
                .unwrap()
        );
        assert_eq!(counts(&store).await.failed, 3);
        assert_eq!(store.forget_ended(0).await.unwrap().len(), 4);
    }
}

#[tokio::test]
async fn a_job_with_parts_is_one_job_of_the_queue() {
    for (_dir, store) in stores("parts_queue").await {
        enqueue_parts(&store).await;
        let second = store.enqueue(job(None, None), 2, 1.0).await.unwrap();
        assert!(matches!(second, EnqueueResult::New(row) if row.id == JobId::new(5)));
        let third = store.enqueue(job(None, None), 2, 1.0).await.unwrap();
        assert_eq!(third, EnqueueResult::Full);
    }
}
