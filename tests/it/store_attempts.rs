//! How the store counts attempts without progress.

use foreframe_jobs::store::{JobId, JobOutcome, JobReport, NewJob, Store, StoreConfig};

async fn store(dir: &std::path::Path) -> Store {
    let config = StoreConfig {
        data_dir: dir.to_owned(),
        ..StoreConfig::default()
    };
    let store = Store::open(&config).await.unwrap();
    let new = NewJob {
        kind: "collect".to_owned(),
        exclusive_output: None,
        spec: "{}".to_owned(),
        progress: "{}".to_owned(),
        idempotency_key: None,
        submitter: String::new(),
        after: None,
        parts: Vec::new(),
    };
    store.enqueue(new, 10, 0.0).await.unwrap();
    store
}

fn saved(checkpoint: i64) -> JobReport {
    JobReport {
        progress: "{}".to_owned(),
        checkpoint,
        ..JobReport::default()
    }
}

fn released(crashed: bool) -> JobOutcome {
    JobOutcome {
        state: "queued",
        error: None,
        outcome: None,
        ended_s: None,
        published: None,
        measured: None,
        crashed,
    }
}

#[tokio::test]
async fn attempts_without_progress_are_counted_until_one_saves_more() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path()).await;
    // Each lease has expired when the next attempt starts: the process was killed.
    for stalled in 0..3 {
        let (row, _) = store.claim_at("me", f64::from(stalled), 0.0).await.unwrap().unwrap();
        assert_eq!(row.stalled_attempts, i64::from(stalled));
    }
    let (row, lease) = store.claim_at("me", 4.0, 0.0).await.unwrap().unwrap();
    assert_eq!(row.stalled_attempts, 3);
    store.renew_at(lease, 0.0, saved(7)).await.unwrap();
    let (row, lease) = store.claim_at("me", 5.0, 0.0).await.unwrap().unwrap();
    assert_eq!((row.stalled_attempts, row.checkpoint), (0, 7));
    store.end(lease, released(true), saved(0)).await.unwrap();
    let (row, lease) = store.claim_at("me", 6.0, 0.0).await.unwrap().unwrap();
    assert_eq!(row.stalled_attempts, 1);
    store.end(lease, released(true), saved(8)).await.unwrap();
    assert_eq!(store.job(JobId::new(1)).await.unwrap().unwrap().stalled_attempts, 0);
}

#[tokio::test]
async fn an_attempt_that_stops_with_its_server_is_not_counted() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path()).await;
    for _ in 0..3 {
        let (_, lease) = store.claim_at("me", 1.0, 0.0).await.unwrap().unwrap();
        store.excuse_attempt(lease).await.unwrap();
        let (row, lease) = store.claim_at("me", 2.0, 0.0).await.unwrap().unwrap();
        assert_eq!(row.stalled_attempts, 0);
        store.end(lease, released(false), saved(0)).await.unwrap();
        assert_eq!(store.job(JobId::new(1)).await.unwrap().unwrap().stalled_attempts, 0);
    }
}

#[tokio::test]
async fn leases_use_the_clock_of_the_database() {
    let dir = tempfile::tempdir().unwrap();
    let store = store(dir.path()).await;
    let (_, lease) = store.claim("one", 60.0).await.unwrap().unwrap();
    assert_eq!(store.claim("other", 60.0).await.unwrap(), None);
    store.renew(lease, -1.0, saved(0)).await.unwrap();
    assert!(store.claim("other", 60.0).await.unwrap().is_some());
}
