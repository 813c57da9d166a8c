//! Files that are uploaded for imports: bounded, imported, and deleted when the import has ended.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use axum::body::{Body, Bytes};
use axum::http::{Request, StatusCode, header};
use foreframe::server::keys::Keys;
use foreframe::server::{App, ServerConfig};
use futures_util::stream;
use serde_json::{Value, json};

use crate::import::folder;
use crate::keys::new_key;
use crate::service::{Answer, app, get, poll_until, post, send, store};
use crate::shared_datasets::machine;

async fn upload(app: &App, name: &str, body: impl Into<Body>) -> Answer {
    let request = Request::post(format!("/v1/uploads?name={name}"));
    let request = request.header(header::CONTENT_TYPE, "application/octet-stream");
    send(app, request.body(body.into()).unwrap()).await
}

/// A zip archive of a recording with 12 frames.
fn recording(dir: &Path) -> Vec<u8> {
    let source = folder(dir);
    let mut archive = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for entry in fs::read_dir(source).unwrap().flatten() {
        let name = entry.file_name().into_string().unwrap();
        archive
            .start_file(name, zip::write::SimpleFileOptions::default())
            .unwrap();
        archive.write_all(&fs::read(entry.path()).unwrap()).unwrap();
    }
    archive.finish().unwrap().into_inner()
}

fn is_empty(dir: &Path) -> bool {
    fs::read_dir(dir).map_or(true, |mut entries| entries.next().is_none())
}

async fn ended(app: &App, created: &Answer) -> Value {
    let path = format!("/v1/jobs/{}", created.json()["id"].as_str().unwrap());
    poll_until(async || {
        let job = get(app, &path).await.json();
        ["succeeded", "failed"]
            .contains(&job["state"].as_str().unwrap())
            .then_some(job)
    })
    .await
}

#[tokio::test]
async fn an_uploaded_archive_becomes_a_data_set_and_is_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let (data, uploads) = (dir.path().join("data"), dir.path().join("data/uploads"));
    let app = app(&data, ServerConfig::default());
    for (name, body, state) in [
        ("walk", recording(dir.path()), "succeeded"),
        ("bad", vec![7; 99], "failed"),
    ] {
        let received = upload(&app, "My%20walk.zip", body.clone()).await;
        assert_eq!(received.status, 201, "{}", received.json());
        let received = received.json();
        assert_eq!(received["bytes"], body.len());
        let job = json!({"kind": "import", "name": name, "source": received["source"], "size": "16x12"});
        let created = post(&app, "/v1/jobs", &job).await;
        assert_eq!(created.status, 202, "{}", created.json());
        let job = ended(&app, &created).await;
        assert_eq!(job["state"], state, "{job}");
        if state == "succeeded" {
            poll_until(async || is_empty(&uploads).then_some(())).await;
        }
    }
    // What failed can be imported with other options.
    assert!(!is_empty(&uploads));
    let form = Request::post("/v1/uploads?name=a.zip").header("content-type", "multipart/form-data; boundary=x");
    let refused = send(&app, form.body(Body::from("--x--")).unwrap()).await;
    assert_eq!(refused.status, 415, "{}", refused.json());
    let set = get(&app, "/v1/datasets/walk").await.json();
    assert_eq!((&set["frames"], &set["title"]), (&json!(12), &json!("walk")));
    assert!(!data.join("datasets/walk/.unpacked").exists());
}

#[tokio::test]
async fn a_source_without_its_upload_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let id = "0".repeat(32);
    for (source, csv, expected) in [
        (format!("upload:{id}/walk.zip"), None, "source: there is no \"upload:0"),
        (
            format!("upload:{id}/../../foreframe.db"),
            None,
            "source: \"../../foreframe.db\" is not a file's name",
        ),
        (
            "upload:../walk.zip".to_owned(),
            None,
            "source: \"..\" is not the id of an upload",
        ),
        (
            format!("upload:{id}/walk.zip"),
            Some("a.csv"),
            "csv: an uploaded recording brings its own",
        ),
    ] {
        let job = json!({"kind": "import", "name": "walk", "source": source, "csv": csv});
        let detail = post(&app, "/v1/jobs", &job).await.detail(422);
        assert!(detail.starts_with(expected), "{detail}");
    }
}

#[tokio::test]
async fn an_import_whose_upload_is_gone_is_not_resumed() {
    let dir = tempfile::tempdir().unwrap();
    let app = app(dir.path(), ServerConfig::default());
    let received = upload(&app, "walk.zip", vec![7; 99]).await.json();
    let job = json!({"kind": "import", "name": "walk", "source": received["source"]});
    let failed = ended(&app, &post(&app, "/v1/jobs", &job).await).await;
    assert_eq!(failed["state"], "failed", "{failed}");
    let resume = format!("/v1/jobs/{}/resume", failed["id"].as_str().unwrap());
    fs::remove_dir_all(dir.path().join("uploads")).unwrap();
    let detail = post(&app, &resume, &Value::Null).await.detail(422);
    assert!(
        detail.starts_with("source: there is no \"upload:") && detail.ends_with("send the file again"),
        "{detail}"
    );
}

#[tokio::test]
async fn uploads_are_bounded_in_size_and_number() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_upload_mib: 1,
        max_uploads: 2,
        // What is written to the disk is not counted.
        max_body_bytes: 1024,
        max_total_body_bytes: 1024,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let uploads = dir.path().join("uploads");
    let endless = stream::repeat_with(|| Ok::<_, std::io::Error>(Bytes::from_static(&[7; 1 << 13])));
    let detail = upload(&app, "a.zip", Body::from_stream(endless)).await.detail(413);
    assert!(
        detail.contains("more than 1 MiB") && detail.contains("max_upload_mib"),
        "{detail}"
    );
    let broken = stream::iter([Ok(Bytes::from_static(b"beginning")), Err(std::io::Error::other("away"))]);
    upload(&app, "a.zip", Body::from_stream(broken)).await.detail(400);
    upload(&app, "a.zip", Vec::new()).await.detail(422);
    for name in ["a.exe", "..%2fa.zip", "%2fetc%2fa.zip", ".zip", "a%00.zip"] {
        upload(&app, name, b"x".to_vec()).await.detail(422);
    }
    assert!(is_empty(&uploads), "what was refused leaves nothing");
    for _ in 0..2 {
        assert_eq!(upload(&app, "a.npy", vec![7; 1 << 20]).await.status, 201);
    }
    let detail = upload(&app, "a.npy", vec![7]).await.detail(503);
    assert!(detail.contains("2 uploads wait"), "{detail}");
}

#[tokio::test]
async fn a_key_gets_its_share_of_the_places_for_uploads() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        max_uploads: 3,
        max_uploads_per_key: 2,
        ..ServerConfig::default()
    };
    let store = store(dir.path());
    let keys = Keys::open(store.clone(), true).await.unwrap();
    let app = app(dir.path(), config).with_keys(keys.clone());
    let (first, second) = (new_key(&store, &keys).await.text, new_key(&store, &keys).await.text);
    let with = async |key: &str, method: &str, path: &str| {
        let request = Request::builder().method(method).uri(path);
        let request = request.header(header::AUTHORIZATION, format!("Bearer {key}"));
        send(&app, request.body(Body::from("x")).unwrap()).await
    };
    let upload = async |key: &str| with(key, "POST", "/v1/uploads?name=a.npy").await;
    let sent = upload(&first).await;
    assert_eq!(
        (sent.status, upload(&first).await.status),
        (StatusCode::CREATED, StatusCode::CREATED)
    );
    let refused = upload(&first).await;
    let detail = refused.detail(429);
    assert!(
        detail.contains("2 uploads of this API key wait") && detail.contains("max_uploads_per_key"),
        "{detail}"
    );
    assert!(refused.headers.contains_key(header::RETRY_AFTER));
    assert_eq!(upload(&second).await.status, 201);
    upload(&second).await.detail(503);
    // A place that is free again counts no more.
    let deleted = format!("/v1/uploads/{}", sent.json()["id"].as_str().unwrap());
    assert_eq!(with(&first, "DELETE", &deleted).await.status, 204);
    assert_eq!(upload(&first).await.status, 201);
}

#[tokio::test]
async fn an_upload_can_be_deleted_unless_a_job_imports_it() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        run_jobs: false,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    let kept = upload(&app, "a.npy", vec![7]).await.json();
    let dropped = upload(&app, "a.npy", vec![7]).await.json();
    let job = post(
        &app,
        "/v1/jobs",
        &json!({"kind": "import", "name": "a", "source": kept["source"], "rate": 5}),
    )
    .await;
    assert_eq!(job.status, 202);
    let delete = async |id: &str| {
        let request = Request::delete(format!("/v1/uploads/{id}")).body(Body::empty());
        send(&app, request.unwrap()).await
    };
    let detail = delete(kept["id"].as_str().unwrap()).await.detail(409);
    assert!(detail.contains("job-1 imports it"), "{detail}");
    let id = dropped["id"].as_str().unwrap();
    assert_eq!(delete(id).await.status, 204);
    assert!(!dir.path().join("uploads").join(id).exists());
    for unknown in [id, "..", "%2e%2e"] {
        delete(unknown).await.detail(404);
    }
}

#[tokio::test]
async fn an_upload_that_was_deleted_through_another_server_is_not_imported() {
    let objects = tempfile::tempdir().unwrap();
    let (here, one) = machine(objects.path()).await;
    let (_there, other) = machine(objects.path()).await;
    let sent = upload(&one, "a.npy", vec![7]).await.json();
    let id = sent["id"].as_str().unwrap();
    let request = Request::delete(format!("/v1/uploads/{id}")).body(Body::empty());
    assert_eq!(send(&other, request.unwrap()).await.status, 204);
    let job = json!({"kind": "import", "name": "a", "source": sent["source"], "rate": 5});
    let detail = post(&one, "/v1/jobs", &job).await.detail(422);
    assert!(detail.contains("there is no"), "{detail}");
    assert!(!here.path().join("uploads").join(id).exists());
}

#[tokio::test]
async fn an_upload_that_nobody_imports_is_deleted() {
    let dir = tempfile::tempdir().unwrap();
    let config = ServerConfig {
        upload_idle_ms: 1,
        ..ServerConfig::default()
    };
    let app = app(dir.path(), config);
    assert_eq!(upload(&app, "a.npy", vec![7]).await.status, 201);
    poll_until(async || is_empty(&dir.path().join("uploads")).then_some(())).await;
}

#[tokio::test]
async fn uploads_can_be_off_and_have_a_deadline() {
    let dir = tempfile::tempdir().unwrap();
    let off = ServerConfig {
        max_upload_mib: 0,
        ..ServerConfig::default()
    };
    let detail = upload(&app(&dir.path().join("off"), off), "a.npy", vec![7])
        .await
        .detail(413);
    assert!(detail.contains("takes no uploads"), "{detail}");
    let hasty = ServerConfig {
        upload_deadline_ms: 50,
        ..ServerConfig::default()
    };
    let app = app(&dir.path().join("hasty"), hasty);
    let never = Body::from_stream(stream::pending::<Result<Bytes, std::io::Error>>());
    upload(&app, "a.npy", never).await.detail(408);
    assert!(is_empty(&dir.path().join("hasty/uploads")));
}
