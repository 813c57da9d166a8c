//! A store whose disk is full, whose file was copied, damaged or replaced, or whose lock file is a link.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use crate::keys::create_key;
use foreframe_jobs::store::{EnqueueResult, JobPage, NewJob, Store, StoreConfig, StoreError};

async fn open(dir: &Path) -> Result<Store, StoreError> {
    let config = StoreConfig {
        data_dir: dir.to_owned(),
        ..StoreConfig::default()
    };
    Store::open(&config).await
}

async fn enqueue(store: &Store) -> Result<EnqueueResult, StoreError> {
    let new = NewJob {
        kind: "collect".to_owned(),
        exclusive_output: None,
        spec: "x".repeat(4096),
        progress: "{}".to_owned(),
        idempotency_key: None,
        submitter: String::new(),
        after: None,
        parts: Vec::new(),
    };
    store.enqueue(new, 1_000_000, 0.0).await
}

/// A mounted file system of a few MiB.
struct SmallDisk(PathBuf);

impl SmallDisk {
    /// None where this process cannot mount one.
    fn mount(dir: &Path) -> Option<Self> {
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=4m", "foreframe-test"])
            .arg(dir)
            .output();
        mounted
            .is_ok_and(|output| output.status.success())
            .then(|| Self(dir.to_owned()))
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

#[tokio::test]
async fn writes_work_again_after_a_full_disk() {
    let dir = tempfile::tempdir().unwrap();
    let Some(disk) = SmallDisk::mount(dir.path()) else {
        println!("skipped: this process cannot mount a file system");
        return;
    };
    let store = open(&disk.0).await.unwrap();
    enqueue(&store).await.unwrap();
    store.check_writable().await.unwrap();
    let filler = disk.0.join("filler");
    // Fails when the disk is full.
    let _ = std::fs::write(&filler, vec![0; 8 << 20]);
    let mut errors = Vec::new();
    for _ in 0..300 {
        errors.extend(enqueue(&store).await.err());
    }
    assert!(
        !errors.is_empty() && errors.iter().all(StoreError::is_unavailable),
        "{errors:?}"
    );
    // A successful check is valid for a second.
    tokio::time::sleep(Duration::from_millis(1100)).await;
    assert!(store.check_writable().await.unwrap_err().is_unavailable());
    std::fs::remove_file(filler).unwrap();
    let deadline = Instant::now() + Duration::from_secs(5);
    while let Err(error) = enqueue(&store).await {
        assert!(Instant::now() < deadline, "{error}");
    }
    for _ in 0..50 {
        enqueue(&store).await.unwrap();
    }
    store.check_writable().await.unwrap();
    store.close().await.unwrap();
}

#[tokio::test]
async fn the_database_file_alone_is_complete_after_a_close() {
    let (dir, copy) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let store = open(dir.path()).await.unwrap();
    let other = open(dir.path()).await.unwrap();
    create_key(&store, "a", "robot", "hash", 1.0).await.unwrap();
    assert_eq!(other.list_keys().await.unwrap().len(), 1);
    store.close().await.unwrap();
    std::fs::copy(dir.path().join("foreframe.db"), copy.path().join("foreframe.db")).unwrap();
    assert_eq!(open(copy.path()).await.unwrap().list_keys().await.unwrap().len(), 1);
}

#[tokio::test]
async fn a_damaged_database_is_refused_in_one_sentence() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("foreframe.db");
    let store = open(dir.path()).await.unwrap();
    for _ in 0..50 {
        enqueue(&store).await.unwrap();
    }
    store.close().await.unwrap();
    let whole = std::fs::read(&path).unwrap();
    for from in [0, 4096] {
        let mut damaged = whole.clone();
        damaged[from..].iter_mut().for_each(|byte| *byte ^= 0x55);
        std::fs::write(&path, damaged).unwrap();
        let error = open(dir.path()).await.err().unwrap();
        assert!(matches!(error, StoreError::Damaged { .. }), "{error:?}");
        let sentence = error.to_string();
        assert!(
            sentence.contains("foreframe.db is damaged (") && !sentence.contains('\n'),
            "{sentence}"
        );
    }
    std::fs::write(&path, whole).unwrap();
    open(dir.path()).await.unwrap();
}

/// The database of a store that is in use: the file and its write-ahead log.
struct LiveCopy {
    database: Vec<u8>,
    log: Vec<u8>,
}

impl LiveCopy {
    async fn with_jobs(jobs: usize) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let store = open(dir.path()).await.unwrap();
        for _ in 0..jobs {
            enqueue(&store).await.unwrap();
        }
        let read = |name: &str| std::fs::read(dir.path().join(name)).unwrap();
        Self {
            database: read("foreframe.db"),
            log: read("foreframe.db-wal"),
        }
    }

    /// Opens a store with this database and another log.
    async fn open_with(&self, log: &[u8]) -> Result<usize, StoreError> {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("foreframe.db"), &self.database).unwrap();
        std::fs::write(dir.path().join("foreframe.db-wal"), log).unwrap();
        let store = open(dir.path()).await?;
        let page = JobPage {
            limit: 1000,
            ..JobPage::default()
        };
        Ok(store.jobs(page).await.unwrap().len())
    }
}

#[tokio::test]
async fn a_damaged_write_ahead_log_is_refused_in_one_sentence() {
    let copy = LiveCopy::with_jobs(20).await;
    assert_eq!(copy.open_with(&copy.log).await.unwrap(), 20);
    let half = copy.log.len() / 2;
    for (at, part) in [
        (0, "the header"),
        (17, "the header"),
        (40, "frame 1"),
        (100, "frame 1"),
        (half, "frame "),
    ] {
        let mut damaged = copy.log.clone();
        damaged[at] ^= 0x55;
        let error = copy.open_with(&damaged).await.unwrap_err();
        assert!(matches!(error, StoreError::Damaged { .. }), "{at}: {error:?}");
        let sentence = error.to_string();
        assert!(
            sentence.contains("foreframe.db-wal is damaged (") && sentence.contains(part) && !sentence.contains('\n'),
            "{at}: {sentence}"
        );
    }
}

#[tokio::test]
async fn a_log_that_ends_in_the_middle_loses_only_its_end() {
    let copy = LiveCopy::with_jobs(20).await;
    for end in (0..copy.log.len()).step_by(copy.log.len() / 30) {
        let jobs = copy.open_with(&copy.log[..end]).await.unwrap();
        assert!(jobs < 20, "{end}: {jobs}");
    }
    // What a power failure can leave: a last transaction that is only partly there.
    let mut torn = copy.log.clone();
    *torn.last_mut().unwrap() ^= 0x55;
    assert_eq!(copy.open_with(&torn).await.unwrap(), 19);
}

#[tokio::test]
async fn a_lost_database_does_not_forget_that_keys_exist() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(dir.path()).await.unwrap();
    assert!(!store.keys_were_created());
    create_key(&store, "a", "robot", "hash", 1.0).await.unwrap();
    store.close().await.unwrap();
    for file in ["foreframe.db", "foreframe.db-wal", "foreframe.db-shm"] {
        let _ = std::fs::remove_file(dir.path().join(file));
    }
    let store = open(dir.path()).await.unwrap();
    assert!(store.list_keys().await.unwrap().is_empty() && store.keys_were_created());
    let keys = foreframe::server::keys::Keys::open(store, false).await.unwrap();
    assert!(keys.are_required() && keys.count() == 0);
}

#[cfg(unix)]
#[tokio::test]
async fn a_symbolic_link_as_lock_file_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let target = dir.path().join("precious");
    std::fs::write(&target, "text").unwrap();
    std::os::unix::fs::symlink(&target, dir.path().join("foreframe.lock")).unwrap();
    let error = open(dir.path()).await.err().unwrap().to_string();
    assert!(error.contains("the lock file is a symbolic link"), "{error}");
    assert_eq!(std::fs::read_to_string(target).unwrap(), "text");
}
