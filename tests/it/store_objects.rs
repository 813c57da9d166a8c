//! The object store that several machines share: in a directory, and in S3 if available.

use foreframe_jobs::store::{Store, StoreConfig};
use tempfile::TempDir;

/// Two data directories with one object store: a directory, and an S3 bucket if `FOREFRAME_TEST_S3` is set.
#[tokio::test]
async fn pushed_objects_are_visible_on_other_machines() {
    let shared = tempfile::tempdir().unwrap();
    let url = if cfg!(feature = "cloud") {
        std::env::var("FOREFRAME_TEST_S3").ok()
    } else {
        None
    };
    if url.is_none() {
        println!("skipped on S3: built without the feature cloud, or FOREFRAME_TEST_S3 holds no URL");
    }
    for url in std::iter::once(shared.path().display().to_string()).chain(url) {
        let (here, there) = (open_sharing(&url).await, open_sharing(&url).await);
        let write = |path: &str, text: &str| {
            let path = here.0.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        write("models/m/1/manifest.json", "last");
        write("models/m/1/deep/weights", "first");
        write("models/m/1/half.partial", "never");
        write("models/m/1/.cache/copy", "never");
        let (ours, theirs) = (here.1.objects(), there.1.objects());
        assert!(!theirs.pull("models/m/1", "manifest.json").await.unwrap());
        ours.push("models/m/1", "manifest.json").await.unwrap();
        assert_eq!(theirs.directories("models/m").await.unwrap(), ["1"]);
        assert!(theirs.pull("models/m/1", "manifest.json").await.unwrap());
        let read = |path: &str| std::fs::read_to_string(there.0.path().join(path)).ok();
        assert_eq!(read("models/m/1/deep/weights").as_deref(), Some("first"));
        assert_eq!(
            (
                read("models/m/1/manifest.json").as_deref(),
                read("models/m/1/half.partial")
            ),
            (Some("last"), None)
        );
        assert_eq!(read("models/m/1/.cache/copy"), None);
        write("models/m/1/manifest.json", "newer");
        ours.push("models/m/1", "manifest.json").await.unwrap();
        theirs.pull("models/m/1", "manifest.json").await.unwrap();
        assert_eq!(read("models/m/1/manifest.json").as_deref(), Some("newer"));
        theirs.delete("models/m/1").await.unwrap();
        assert!(!there.0.path().join("models/m/1").exists());
        assert_eq!(ours.directories("models/m").await.unwrap(), [""; 0]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn concurrent_pulls_get_a_complete_directory() {
    let shared = tempfile::tempdir().unwrap();
    let url = shared.path().display().to_string();
    let (here, there) = (open_sharing(&url).await, open_sharing(&url).await);
    let of_ours = here.0.path().join("datasets/d");
    std::fs::create_dir_all(&of_ours).unwrap();
    for file in 0..20 {
        std::fs::write(of_ours.join(file.to_string()), vec![file; 1 << 16]).unwrap();
    }
    std::fs::write(of_ours.join("last"), "done").unwrap();
    here.1.objects().push("datasets/d", "last").await.unwrap();
    let pulling = (0..8).map(|_| {
        let store = there.1.clone();
        tokio::spawn(async move { store.objects().pull("datasets/d", "last").await })
    });
    for pull in pulling.collect::<Vec<_>>() {
        assert!(pull.await.unwrap().unwrap());
    }
    for file in 0..20 {
        let path = there.0.path().join(format!("datasets/d/{file}"));
        assert_eq!(std::fs::read(path).unwrap(), vec![file; 1 << 16]);
    }
    let names = std::fs::read_dir(there.0.path().join("datasets/d")).unwrap();
    assert_eq!(names.count(), 21);
}

#[tokio::test]
async fn a_pull_skips_incomplete_directories_and_existing_files() {
    let shared = tempfile::tempdir().unwrap();
    let (dir, store) = open_sharing(&shared.path().display().to_string()).await;
    let (ours, kept) = (dir.path().join("reports/r"), shared.path().join("reports/r"));
    std::fs::create_dir_all(&kept).unwrap();
    std::fs::write(kept.join("a"), "there").unwrap();
    assert!(!store.objects().pull("reports/r", "last").await.unwrap());
    assert!(!ours.exists());
    std::fs::create_dir_all(&ours).unwrap();
    std::fs::write(ours.join("a"), "local").unwrap();
    std::fs::write(kept.join("b"), "longer").unwrap();
    std::fs::write(ours.join("b"), "short").unwrap();
    std::fs::write(kept.join("last"), "there").unwrap();
    std::fs::write(ours.join("last"), "local").unwrap();
    assert!(store.objects().pull("reports/r", "last").await.unwrap());
    let read = |name: &str| std::fs::read_to_string(ours.join(name)).unwrap();
    assert_eq!(
        (read("a"), read("b"), read("last")),
        ("local".into(), "longer".into(), "there".into())
    );
}

async fn open_sharing(objects: &str) -> (TempDir, Store) {
    let dir = tempfile::tempdir().unwrap();
    let config = StoreConfig {
        data_dir: dir.path().to_owned(),
        database: None,
        objects: Some(objects.to_owned()),
    };
    let store = Store::open(&config).await.unwrap();
    (dir, store)
}
