//! The store on SQLite, and on PostgreSQL if `FOREFRAME_TEST_POSTGRES` is the URL of a server to create databases on.

use std::collections::BTreeSet;

use crate::keys::create_key;
use crate::skip::skip_without;
use foreframe_core::types::ModelName;
use foreframe_jobs::store::{
    Author, EnqueueResult, JobId, JobOutcome, JobPage, JobReport, JobRow, KeyRow, KeyScope, Lease, LossRow, NewJob,
    PublishedVersion, Store, StoreConfig,
};
use sqlx::{AssertSqlSafe, Connection as _, Executor as _, PgConnection};
use tempfile::TempDir;

/// Configurations of an empty store of each kind. `name` is that of the test.
async fn configs(name: &str) -> Vec<(TempDir, StoreConfig)> {
    let mut configs = vec![config(None)];
    configs.extend(postgres(name).await.map(|url| config(Some(url))));
    configs
}

fn config(database: Option<String>) -> (TempDir, StoreConfig) {
    let dir = tempfile::tempdir().unwrap();
    let config = StoreConfig {
        data_dir: dir.path().to_owned(),
        database,
        objects: None,
    };
    (dir, config)
}

/// The URL of a new database beside the one that `FOREFRAME_TEST_POSTGRES` names.
pub(crate) async fn postgres(name: &str) -> Option<String> {
    let Ok(url) = std::env::var("FOREFRAME_TEST_POSTGRES") else {
        skip_without("FOREFRAME_TEST_POSTGRES holds no URL of a PostgreSQL server");
        return None;
    };
    let mut connection = PgConnection::connect(&url).await.unwrap();
    let database = format!("foreframe_{name}");
    for statement in [
        format!("DROP DATABASE IF EXISTS {database} WITH (FORCE)"),
        format!("CREATE DATABASE {database}"),
    ] {
        connection.execute(AssertSqlSafe(statement)).await.unwrap();
    }
    let (server, _) = url.rsplit_once('/').unwrap();
    Some(format!("{server}/{database}"))
}

pub(crate) async fn stores(name: &str) -> Vec<(TempDir, Store)> {
    let mut stores = Vec::new();
    for (dir, config) in configs(name).await {
        stores.push((dir, Store::open(&config).await.unwrap()));
    }
    stores
}

async fn find_key(store: &Store, id: &str) -> Option<KeyRow> {
    store.list_keys().await.unwrap().into_iter().find(|key| key.id == id)
}

pub(crate) fn job(makes: Option<&str>, key: Option<&str>) -> NewJob {
    NewJob {
        kind: "collect".to_owned(),
        exclusive_output: makes.map(str::to_owned),
        spec: "{}".to_owned(),
        progress: "{}".to_owned(),
        idempotency_key: key.map(str::to_owned),
        submitter: String::new(),
        after: None,
        parts: Vec::new(),
    }
}

async fn enqueued(store: &Store) -> JobRow {
    match store.enqueue(job(None, None), 100, 1.0).await.unwrap() {
        EnqueueResult::New(row) => row,
        other => panic!("{other:?}"),
    }
}

pub(crate) fn outcome(state: &'static str) -> JobOutcome {
    JobOutcome {
        state,
        error: None,
        outcome: Some("{}".to_owned()),
        ended_s: Some(9.0),
        published: None,
        measured: None,
        crashed: false,
    }
}

fn report(line: &str) -> JobReport {
    JobReport {
        progress: "{\"done\":1}".to_owned(),
        lines: vec![(2.0, line.to_owned())],
        losses: vec![LossRow {
            stage: "sequence".to_owned(),
            step: 4,
            train: Some(0.5),
            validation: None,
        }],
        max_lines: 3,
        checkpoint: 0,
    }
}

#[tokio::test]
async fn a_job_is_enqueued_claimed_reported_and_ended() {
    for (_dir, store) in stores("way").await {
        let row = enqueued(&store).await;
        assert_eq!(
            (row.id, row.state.as_str(), row.queued_s),
            (JobId::new(1), "queued", 1.0)
        );
        let (row, lease) = store.claim_at("me", 2.0, 10.0).await.unwrap().unwrap();
        assert_eq!(
            (row.state.as_str(), row.started_s, row.token),
            ("running", Some(2.0), 1)
        );
        assert_eq!(store.claim_at("me", 3.0, 10.0).await.unwrap(), None);
        for line in ["one", "two", "three", "four"] {
            assert_eq!(store.renew_at(lease, 20.0, report(line)).await.unwrap(), Some(false));
        }
        for _ in 0..2 {
            assert!(store.ask_to_cancel(JobId::new(1), &Author::CommandLine).await.unwrap());
        }
        let entries = store.audit(None, 10).await.unwrap();
        assert_eq!(entries.iter().filter(|entry| entry.action == "job.cancel").count(), 1);
        assert_eq!(
            store.renew_at(lease, 20.0, JobReport::default()).await.unwrap(),
            Some(true)
        );
        assert!(store.end(lease, outcome("cancelled"), report("five")).await.unwrap());
        let row = store.job(JobId::new(1)).await.unwrap().unwrap();
        assert_eq!(
            (row.state.as_str(), row.cancelling, row.ended_s),
            ("cancelled", false, Some(9.0))
        );
        assert_eq!(
            (row.progress.as_str(), row.outcome.as_deref()),
            ("{\"done\":1}", Some("{}"))
        );
        let lines = store.job_log(JobId::new(1), 3, 10).await.unwrap();
        let lines: Vec<_> = lines.iter().map(|row| (row.seq, row.line.as_str())).collect();
        assert_eq!(lines, [(4, "four"), (5, "five")]);
        assert_eq!(store.job_log(JobId::new(1), 0, 10).await.unwrap()[0].line, "three");
        assert_eq!(store.job_losses(JobId::new(1)).await.unwrap(), report("").losses);
        assert!(
            !store
                .end(lease, outcome("succeeded"), JobReport::default())
                .await
                .unwrap()
        );
    }
}

#[tokio::test]
async fn an_expired_lease_cannot_write() {
    for (_dir, store) in stores("fence").await {
        enqueued(&store).await;
        let (_, stale) = store.claim_at("slow", 0.0, 10.0).await.unwrap().unwrap();
        assert_eq!(store.claim_at("quick", 9.9, 30.0).await.unwrap(), None);
        let (row, fresh) = store.claim_at("quick", 10.1, 30.0).await.unwrap().unwrap();
        assert_eq!((row.token, row.started_s), (2, Some(0.0)));
        assert_eq!(
            store
                .renew_at(stale, 99.0, report("from an expired lease"))
                .await
                .unwrap(),
            None
        );
        assert!(
            !store
                .end(stale, outcome("failed"), report("from an expired lease"))
                .await
                .unwrap()
        );
        assert_eq!(store.reserve_version(stale, &model(), 0).await.unwrap(), None);
        assert_eq!(store.job_log(JobId::new(1), 0, 10).await.unwrap(), []);
        assert_eq!(
            store.renew_at(fresh, 40.0, JobReport::default()).await.unwrap(),
            Some(false)
        );
        assert_eq!(store.release_leases("slow").await.unwrap(), 0);
        assert_eq!(store.release_leases("quick").await.unwrap(), 1);
        assert_eq!(store.claim_at("next", 11.0, 30.0).await.unwrap().unwrap().0.token, 3);
    }
}

#[tokio::test]
async fn the_queue_limit_keys_and_names_are_enforced() {
    for (_dir, store) in stores("once").await {
        let enqueue = async |new: NewJob| store.enqueue(new, 2, 0.0).await.unwrap();
        assert!(matches!(
            enqueue(job(Some("data set a"), Some("k"))).await,
            EnqueueResult::New(_)
        ));
        assert!(
            matches!(enqueue(job(Some("data set b"), Some("k"))).await, EnqueueResult::Same(row) if row.id == JobId::new(1))
        );
        assert_eq!(enqueue(job(Some("data set a"), None)).await, EnqueueResult::Taken);
        assert!(matches!(enqueue(job(None, None)).await, EnqueueResult::New(_)));
        assert_eq!(enqueue(job(None, None)).await, EnqueueResult::Full);
        assert!(
            store
                .cancel_queued(JobId::new(1), 1.0, &Author::CommandLine)
                .await
                .unwrap()
                && !store
                    .cancel_queued(JobId::new(1), 1.0, &Author::CommandLine)
                    .await
                    .unwrap()
        );
        assert!(
            matches!(enqueue(job(Some("data set a"), None)).await, EnqueueResult::New(row) if row.id == JobId::new(3))
        );
        assert_eq!(
            store.requeue(JobId::new(1), 2, &Author::CommandLine).await.unwrap(),
            Some(EnqueueResult::Taken)
        );
        assert_eq!(
            store.requeue(JobId::new(2), 2, &Author::CommandLine).await.unwrap(),
            None
        );
        assert_eq!(store.job_of_key("k").await.unwrap().unwrap().id, JobId::new(1));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn concurrent_claims_never_get_the_same_job() {
    for (_dir, store) in stores("many").await {
        let enqueueing = (0..30).map(|_| {
            let store = store.clone();
            tokio::spawn(async move { store.enqueue(job(None, None), 20, 0.0).await.unwrap() })
        });
        let mut taken = 0;
        for task in enqueueing.collect::<Vec<_>>() {
            taken += usize::from(matches!(task.await.unwrap(), EnqueueResult::New(_)));
        }
        assert_eq!(taken, 20);
        let runners = (0..6).map(|runner| {
            let store = store.clone();
            tokio::spawn(async move {
                let mut claimed = Vec::new();
                while claimed.len() < 20 {
                    match store.claim_at(&runner.to_string(), 0.0, 10.0).await.unwrap() {
                        Some((row, _)) => claimed.push(row.id),
                        // A claim skips jobs that others are claiming.
                        None if store.jobs(queued()).await.unwrap().is_empty() => break,
                        None => tokio::task::yield_now().await,
                    }
                }
                claimed
            })
        });
        let mut claimed = Vec::new();
        for runner in runners.collect::<Vec<_>>() {
            claimed.extend(runner.await.unwrap());
        }
        claimed.sort_unstable();
        assert_eq!(claimed, (1..=20).map(JobId::new).collect::<Vec<_>>());
    }
}

fn queued() -> JobPage {
    JobPage {
        state: Some("queued".to_owned()),
        limit: 100,
        ..JobPage::default()
    }
}

#[tokio::test]
async fn jobs_are_listed_newest_first_and_old_ones_deleted() {
    for (_dir, store) in stores("list").await {
        for _ in 0..5 {
            enqueued(&store).await;
        }
        for number in 1..=3 {
            store
                .cancel_queued(JobId::new(number), number as f64, &Author::CommandLine)
                .await
                .unwrap();
        }
        let ids =
            async |page: JobPage| -> Vec<JobId> { store.jobs(page).await.unwrap().iter().map(|row| row.id).collect() };
        assert_eq!(ids(queued()).await, [5, 4].map(JobId::new));
        let page = JobPage {
            kind: Some("collect".to_owned()),
            before: Some(JobId::new(4)),
            limit: 2,
            state: None,
            part_of: None,
        };
        assert_eq!(ids(page).await, [3, 2].map(JobId::new));
        assert_eq!(
            store
                .forget_ended(1)
                .await
                .unwrap()
                .into_iter()
                .collect::<BTreeSet<_>>(),
            [1, 2].map(JobId::new).into()
        );
        assert_eq!(
            ids(JobPage {
                limit: 9,
                ..JobPage::default()
            })
            .await,
            [5, 4, 3].map(JobId::new)
        );
        enqueued(&store).await;
        assert_eq!(store.job(JobId::new(6)).await.unwrap().unwrap().id, JobId::new(6));
    }
}

#[tokio::test]
async fn a_job_is_known_while_one_that_waited_for_it_has_not_succeeded() {
    for (_dir, store) in stores("forgotten").await {
        let first = enqueued(&store).await.id;
        let waiting = NewJob {
            after: Some(first),
            ..job(None, None)
        };
        store.enqueue(waiting, 100, 1.0).await.unwrap();
        store.cancel_queued(first, 2.0, &Author::CommandLine).await.unwrap();
        assert_eq!(store.forget_ended(0).await.unwrap(), []);
        // It can be resumed, so it may ask again.
        let second = JobId::new(2);
        store.cancel_queued(second, 3.0, &Author::CommandLine).await.unwrap();
        assert_eq!(store.forget_ended(1).await.unwrap(), []);
        assert_eq!(store.forget_ended(0).await.unwrap(), [second]);
        assert_eq!(store.forget_ended(0).await.unwrap(), [first]);
    }
}

fn model() -> ModelName {
    "m".parse().unwrap()
}

/// Claims a new job and reserves a version of the model for it.
async fn reserve(store: &Store) -> (Lease, u32) {
    enqueued(store).await;
    let (_, lease) = store.claim_at("me", 0.0, 10.0).await.unwrap().unwrap();
    (lease, store.reserve_version(lease, &model(), 4).await.unwrap().unwrap())
}

#[tokio::test]
async fn versions_are_numbered_after_the_shipped_one() {
    for (_dir, store) in stores("versions").await {
        let (lease, version) = reserve(&store).await;
        assert_eq!(
            (version, store.reserve_version(lease, &model(), 4).await.unwrap()),
            (5, Some(5))
        );
        assert_eq!(store.published_versions().await.unwrap(), []);
        let published = |version, activates| JobOutcome {
            published: Some(PublishedVersion {
                model: model(),
                version,
                activates,
            }),
            ..outcome("succeeded")
        };
        assert!(
            store
                .end(lease, published(5, true), JobReport::default())
                .await
                .unwrap()
        );
        let (lease, version) = reserve(&store).await;
        assert_eq!(version, 6);
        assert!(
            store
                .end(lease, published(6, true), JobReport::default())
                .await
                .unwrap()
        );
        let listed = store.published_versions().await.unwrap();
        assert_eq!(listed, [(model(), 5), (model(), 6)]);
        let entries = store.audit(None, 10).await.unwrap();
        let published = entries.iter().filter(|entry| entry.action == "version.publish");
        assert_eq!(
            published.map(|entry| &*entry.target).collect::<Vec<_>>(),
            ["m@6", "m@5"]
        );
        // The first version stays active until another is activated.
        assert_eq!(store.active_versions().await.unwrap(), [(model(), 5)]);
        assert!(
            !store
                .delete_version(&model(), 5, 1.0, &Author::CommandLine)
                .await
                .unwrap()
        );
        for _ in 0..2 {
            store.set_active(&model(), 4, 1.0, &Author::CommandLine).await.unwrap();
        }
        let entries = store.audit(None, 10).await.unwrap();
        assert_eq!(
            entries
                .iter()
                .filter(|entry| entry.action == "version.activate")
                .count(),
            1
        );
        assert!(
            store
                .delete_version(&model(), 6, 1.0, &Author::CommandLine)
                .await
                .unwrap()
                && !store
                    .delete_version(&model(), 6, 1.0, &Author::CommandLine)
                    .await
                    .unwrap()
        );
        assert_eq!(reserve(&store).await.1, 7);
    }
}

#[tokio::test]
async fn keys_are_found_by_id_and_revoked_once() {
    for (_dir, store) in stores("keys").await {
        create_key(&store, "b", "robot", "hash-b", 2.0).await.unwrap();
        create_key(&store, "a", "room", "hash-a", 1.0).await.unwrap();
        assert!(create_key(&store, "a", "other", "hash", 3.0).await.is_err());
        let names: Vec<_> = store
            .list_keys()
            .await
            .unwrap()
            .into_iter()
            .map(|key| key.name)
            .collect();
        assert_eq!(names, ["room", "robot"]);
        assert!(
            store.revoke_key("b", 5.0, &Author::CommandLine).await.unwrap()
                && !store.revoke_key("b", 6.0, &Author::CommandLine).await.unwrap()
        );
        assert_eq!(find_key(&store, "b").await.unwrap().revoked_s, Some(5.0));
        assert_eq!(find_key(&store, "c").await, None);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_new_store_can_be_opened_concurrently() {
    for (_dir, config) in configs("open").await {
        let opening = (0..6).map(|_| {
            let config = config.clone();
            tokio::spawn(async move { Store::open(&config).await.unwrap() })
        });
        let mut stores = Vec::new();
        for task in opening.collect::<Vec<_>>() {
            stores.push(task.await.unwrap());
        }
        enqueued(&stores[0]).await;
        assert!(stores[5].job(JobId::new(1)).await.unwrap().is_some());
        stores[3].ping().await.unwrap();
    }
}

#[tokio::test]
async fn an_unknown_url_scheme_is_refused_without_the_password() {
    let dir = tempfile::tempdir().unwrap();
    let refused = async |database: Option<&str>, objects: Option<&str>| {
        let config = StoreConfig {
            data_dir: dir.path().to_owned(),
            database: database.map(str::to_owned),
            objects: objects.map(str::to_owned),
        };
        Store::open(&config).await.err().unwrap().to_string()
    };
    assert_eq!(
        refused(Some("mysql://me:secret@host/db"), None).await,
        "database starts with \"mysql\"; use sqlite:FILE or postgres://USER@HOST/NAME"
    );
    assert_eq!(
        refused(None, Some("gs://bucket")).await,
        "objects starts with \"gs\"; use a directory or s3://BUCKET/PREFIX"
    );
}

#[tokio::test]
async fn an_unreachable_postgresql_is_refused_with_the_reason() {
    let Some(url) = postgres("tls").await else { return };
    let refused = async |url: String| {
        let dir = tempfile::tempdir().unwrap();
        let config = StoreConfig {
            data_dir: dir.path().to_owned(),
            database: Some(url),
            objects: None,
        };
        Store::open(&config).await.err().unwrap().to_string()
    };
    // The test server has no TLS.
    let error = refused(format!("{url}?sslmode=require")).await;
    let reason = if cfg!(feature = "cloud") {
        "server does not support TLS"
    } else {
        "built without it; build it with --features cloud"
    };
    assert!(error.contains(reason), "{error}");
    let nobody = tokio::net::TcpListener::bind("127.0.0.1:0")
        .await
        .unwrap()
        .local_addr()
        .unwrap();
    let error = refused(format!("postgres://foreframe@{nobody}/postgres")).await;
    assert!(error.contains("Connection refused"), "{error}");
}

async fn enqueued_by(store: &Store, submitter: &str) -> EnqueueResult {
    let new = NewJob {
        submitter: submitter.to_owned(),
        ..job(None, None)
    };
    store.enqueue(new, 8, 1.0).await.unwrap()
}

#[tokio::test]
async fn submitters_take_turns() {
    for (_dir, store) in stores("turns").await {
        for submitter in ["a", "a", "a", "a", "b", "b", "c"] {
            assert!(matches!(enqueued_by(&store, submitter).await, EnqueueResult::New(_)));
        }
        let mut order = String::new();
        for time_s in 1..=7 {
            let time_s = f64::from(time_s);
            let (row, lease) = store.claim_at("me", time_s, 100.0).await.unwrap().unwrap();
            order += &row.submitter;
            assert!(store.end(lease, outcome("succeeded"), report("done")).await.unwrap());
        }
        assert_eq!(order, "abcabaa");
    }
}

#[tokio::test]
async fn a_submitter_without_running_jobs_is_first() {
    for (_dir, store) in stores("running").await {
        for submitter in ["a", "a", "b", "b"] {
            enqueued_by(&store, submitter).await;
        }
        let mut claimed = String::new();
        for time_s in [1.0, 2.0, 3.0] {
            // `b` was claimed later than `a`, but has ended.
            let (row, lease) = store.claim_at("me", time_s, 100.0).await.unwrap().unwrap();
            claimed += &row.submitter;
            if row.submitter == "b" {
                store.end(lease, outcome("succeeded"), report("done")).await.unwrap();
            }
        }
        assert_eq!(claimed, "abb");
    }
}

fn key(id: &str, scope: KeyScope) -> KeyRow {
    KeyRow {
        id: id.to_owned(),
        name: id.to_owned(),
        hash: id.to_owned(),
        created_s: 1.0,
        revoked_s: None,
        scope,
        expires_s: None,
        requests_per_s: None,
    }
}

#[tokio::test]
async fn of_servers_that_start_at_once_one_makes_the_first_key() {
    for (_dir, store) in stores("first_key").await {
        let add = async |id| {
            let added = store
                .add_first_key(key(id, KeyScope::Admin), &Author::CommandLine)
                .await;
            added.unwrap()
        };
        let added = futures_util::future::join3(add("a"), add("b"), add("c")).await;
        assert_eq!(
            [added.0, added.1, added.2].into_iter().filter(|&first| first).count(),
            1
        );
        let keys = store.list_keys().await.unwrap();
        assert_eq!(keys.len(), 1);
        store.revoke_key(&keys[0].id, 1.0, &Author::CommandLine).await.unwrap();
        assert!(!add("d").await);
    }
}

#[tokio::test]
async fn a_key_has_its_share_of_the_job_queue() {
    for (_dir, store) in stores("share").await {
        for (id, scope) in [
            ("a", KeyScope::Jobs),
            ("b", KeyScope::Admin),
            ("robot", KeyScope::Predict),
        ] {
            store.add_key(key(id, scope), &Author::CommandLine).await.unwrap();
        }
        for _ in 0..4 {
            assert!(matches!(enqueued_by(&store, "a").await, EnqueueResult::New(_)));
        }
        assert_eq!(enqueued_by(&store, "a").await, EnqueueResult::ShareFull(4));
        assert!(matches!(enqueued_by(&store, "b").await, EnqueueResult::New(_)));
        store.revoke_key("b", 1.0, &Author::CommandLine).await.unwrap();
        assert!(matches!(enqueued_by(&store, "a").await, EnqueueResult::New(_)));
        let stored = find_key(&store, "robot").await.unwrap();
        assert_eq!(stored, key("robot", KeyScope::Predict));
    }
}

#[tokio::test]
async fn the_audit_trail_is_kept_in_order() {
    for (_dir, store) in stores("audit").await {
        create_key(&store, "k", "robot", "hash", 1.0).await.unwrap();
        let (robot, nobody) = (Author::of_key("k"), Author::of_key(""));
        store
            .record_dataset_deletion(&"one".parse().unwrap(), &robot)
            .await
            .unwrap();
        store
            .record_dataset_deletion(&"two".parse().unwrap(), &nobody)
            .await
            .unwrap();
        let rows = store.audit(None, 10).await.unwrap();
        let seen: Vec<_> = rows
            .iter()
            .map(|row| (row.number, row.name.as_deref(), row.target.as_str()))
            .collect();
        assert_eq!(seen, [(3, None, "two"), (2, Some("robot"), "one"), (1, None, "k")]);
        assert_eq!(store.audit(Some(3), 10).await.unwrap(), rows[1..]);
    }
}
