//! Versions whose deletion or publication was interrupted.

use std::fs::{self, File};
use std::path::Path;

use foreframe_core::nn::Conditioning;
use foreframe_jobs::store::{Author, Store, unix_s};
use foreframe_jobs::versions::Versions;

use crate::service::{model, spec, store};

#[tokio::test]
async fn a_start_finishes_interrupted_deletions() {
    let dir = tempfile::tempdir().unwrap();
    let trained = tempfile::tempdir().unwrap();
    model(trained.path(), "mine", spec(Conditioning::None));
    let (store, none) = (store(dir.path()), dir.path().join("none"));
    std::fs::create_dir(&none).unwrap();
    let versions = Versions::new(store.clone(), &none);
    for _ in 0..3 {
        versions
            .publish(&"mine".parse().unwrap(), &trained.path().join("mine"), true)
            .await
            .unwrap();
    }
    let files = |version: &str| dir.path().join("models/mine").join(version);
    // Killed after the row was written, and while the files were being deleted.
    for version in [1, 2] {
        assert!(
            store
                .delete_version(&"mine".parse().unwrap(), version, unix_s(), &Author::CommandLine)
                .await
                .unwrap()
        );
    }
    std::fs::rename(files("2"), files(".deleting-0123")).unwrap();
    let loaded = versions.load_serving().await.unwrap();
    assert_eq!((loaded.len(), loaded[0].manifest.version), (1, 3));
    let left: Vec<_> = std::fs::read_dir(dir.path().join("models/mine"))
        .unwrap()
        .map(|entry| entry.unwrap().file_name())
        .collect();
    assert_eq!(left, ["3"]);
}

/// A version as a publication leaves it that is killed before its end.
async fn half_published(store: &Store, data: &Path, trained: &Path) -> u32 {
    let version = store.reserve_next_version(&"mine".parse().unwrap(), 0).await.unwrap();
    let dir = data.join("models/mine").join(version.to_string());
    fs::create_dir_all(&dir).unwrap();
    fs::copy(trained.join("mine/model.safetensors"), dir.join("model.safetensors")).unwrap();
    version
}

#[tokio::test]
async fn killed_publications_are_deleted_at_a_start_and_by_a_publication() {
    let dir = tempfile::tempdir().unwrap();
    let trained = tempfile::tempdir().unwrap();
    model(trained.path(), "mine", spec(Conditioning::None));
    let (store, none) = (store(dir.path()), dir.path().join("none"));
    fs::create_dir(&none).unwrap();
    let versions = Versions::new(store.clone(), &none);
    let publish = async || {
        let (name, trained) = ("mine".parse().unwrap(), trained.path().join("mine"));
        versions.publish(&name, &trained, true).await.unwrap()
    };
    let left = || {
        let entries = fs::read_dir(dir.path().join("models/mine")).unwrap();
        let mut names: Vec<String> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    };
    assert_eq!(publish().await, 1);
    assert_eq!(half_published(&store, dir.path(), trained.path()).await, 2);
    // Another process publishes now: perhaps that version.
    let publishing = File::open(dir.path().join("publish.lock")).unwrap();
    publishing.lock_shared().unwrap();
    versions.load_serving().await.unwrap();
    assert_eq!(left(), ["1", "2"]);
    drop(publishing);
    let loaded = versions.load_serving().await.unwrap();
    assert_eq!((loaded[0].manifest.version, left()), (1, vec!["1".to_owned()]));
    assert_eq!(half_published(&store, dir.path(), trained.path()).await, 3);
    assert_eq!((publish().await, left()), (4, vec!["1".to_owned(), "4".to_owned()]));
}
