//! Names that could leave the data directory, in every place that takes a name.

use std::fs;
use std::path::Path;

use axum::body::Body;
use axum::http::Request;
use foreframe::server::ServerConfig;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;

use crate::healthy_robot::ServerWithRobot;
use crate::service::{get, post, send};

const NAMES: [&str; 8] = [
    "..",
    "%2e%2e",
    "%2e%2e%2f",
    "%2e%2e%2fmodels",
    "..%5cmodels",
    "%2fetc%2fpasswd",
    "%00",
    "datasets%2f..%2f..%2fmodels",
];

const PATHS: [(&str, &str); 21] = [
    ("GET", "/v1/models/NAME"),
    ("POST", "/v1/models/NAME/predict"),
    ("GET", "/v1/models/NAME/preview.png"),
    ("POST", "/v1/models/NAME/versions/1/activate"),
    ("POST", "/v1/models/plain/versions/NAME/activate"),
    ("DELETE", "/v1/models/NAME/versions/1"),
    ("DELETE", "/v1/models/plain/versions/NAME"),
    ("GET", "/v1/sessions/NAME"),
    ("GET", "/v1/sessions/NAME/state?token=NAME"),
    ("DELETE", "/v1/sessions/NAME?token=NAME"),
    ("GET", "/v1/jobs/NAME"),
    ("GET", "/v1/jobs/job-1/files/NAME"),
    ("GET", "/v1/jobs/NAME/files/report.md"),
    ("GET", "/v1/jobs?before=NAME"),
    ("GET", "/v1/jobs?kind=NAME"),
    ("GET", "/v1/datasets/NAME"),
    ("DELETE", "/v1/datasets/NAME"),
    ("GET", "/v1/datasets/NAME/episodes/0/preview.png"),
    ("GET", "/v1/datasets/NAME/episodes/0"),
    ("GET", "/v1/datasets/NAME/inspection"),
    ("DELETE", "/v1/environments/NAME"),
];

/// Every file below a directory with its length, without the store's own files, which grow.
fn files(dir: &Path) -> Vec<(String, u64)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).unwrap().flatten() {
        let (path, meta) = (entry.path(), entry.metadata().unwrap());
        if meta.is_dir() {
            found.extend(files(&path));
        } else if !path.to_string_lossy().contains("foreframe.db") {
            found.push((path.to_string_lossy().into_owned(), meta.len()));
        }
    }
    found.sort();
    found
}

#[tokio::test]
async fn names_in_paths_cannot_leave_the_data_directory() {
    let mut setup = ServerWithRobot::open(ServerConfig::default()).await;
    let (app, before) = (setup.app.clone(), files(setup.dir.path()));
    let asking = async {
        for (method, path) in PATHS {
            for name in NAMES {
                let path = path.replace("NAME", name);
                let mut request = Request::builder().method(method).uri(&path);
                if method == "POST" {
                    request = request.header("content-type", "application/json");
                }
                let answer = send(&app, request.body(Body::from("{}")).unwrap()).await;
                let status = answer.status.as_u16();
                assert!([400, 404, 405, 422].contains(&status), "{method} {path}: {status}");
                assert!(!answer.detail(status).contains("root:"), "{path}");
            }
        }
    };
    setup.while_robot_streams(asking).await;
    assert_eq!(files(setup.dir.path()), before);
    setup.close().await;
}

#[tokio::test]
async fn dots_in_paths_are_not_resolved() {
    let mut setup = ServerWithRobot::open(ServerConfig::default()).await;
    let address = setup.address();
    for path in [
        "/../../etc/passwd",
        "/v1/../livez",
        "/docs/../../Cargo.toml",
        "/docs/%2e%2e/%2e%2e/Cargo.toml",
    ] {
        let asking = async {
            let mut client = TcpStream::connect(address).await.unwrap();
            let request = format!("GET {path} HTTP/1.1\r\nhost: a\r\nconnection: close\r\n\r\n");
            client.write_all(request.as_bytes()).await.unwrap();
            let mut answer = String::new();
            client.read_to_string(&mut answer).await.unwrap();
            answer
        };
        let answer = setup.while_robot_streams(asking).await;
        assert!(answer.starts_with("HTTP/1.1 404"), "{path}: {answer}");
    }
    setup.close().await;
}

#[tokio::test]
async fn names_in_jobs_cannot_leave_the_data_directory() {
    let config = ServerConfig {
        import_dir: Some(env!("CARGO_MANIFEST_DIR").into()),
        run_jobs: false,
        ..ServerConfig::default()
    };
    let mut setup = ServerWithRobot::open(config).await;
    let (app, before) = (setup.app.clone(), files(setup.dir.path()));
    let collect = json!({"kind": "collect", "name": "a", "scenario": "crowded", "trials": 1});
    let train = json!({"kind": "train", "name": "a", "preset": "paper", "dataset": "a"});
    let evaluate = json!({"kind": "evaluate", "model": "plain", "dataset": "a", "twin": "plain"});
    let import = json!({"kind": "import", "name": "a", "source": "a"});
    let asking = async {
        for (job, fields) in [
            (&collect, &["name", "scenario"][..]),
            (&train, &["name", "preset", "dataset"]),
            (&evaluate, &["dataset"]),
            (&import, &["name", "source"]),
        ] {
            for field in fields {
                for name in ["..", "../a", "a/../b", "/etc", "%2e%2e%2fa", "a\0", "a\\b", ""] {
                    let mut job = job.clone();
                    job[*field] = json!(name);
                    let detail = post(&app, "/v1/jobs", &job).await.detail(422);
                    assert!(detail.starts_with(field), "{field} {name:?}: {detail}");
                }
            }
        }
        let with_key = async |key: &str| {
            let request = Request::post("/v1/jobs").header("content-type", "application/json");
            let request = request.header("idempotency-key", key);
            send(&app, request.body(Body::from(collect.to_string())).unwrap()).await
        };
        let first: Value = with_key("../../a").await.json();
        assert_eq!(with_key("../../a").await.json()["id"], first["id"]);
        for key in ["a b", &"a".repeat(129), ""] {
            assert!(with_key(key).await.detail(422).starts_with("Idempotency-Key"), "{key}");
        }
        get(&app, "/v1/jobs/job-1/files/..%2fforeframe.db").await.detail(404);
    };
    setup.while_robot_streams(asking).await;
    assert_eq!(files(setup.dir.path()), before);
    setup.close().await;
}
