//! Versions whose deletion was interrupted.

use foreframe_core::nn::Conditioning;
use foreframe_jobs::store::{Author, unix_s};
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
