//! A service in this process, and the checks of its responses.

use std::sync::LazyLock;

use axum::body::Body;
use axum::http::{Request, header};
use foreframe::server::{App, ServerConfig};
use tempfile::TempDir;
use tokio::runtime::Runtime;

use crate::service::{Answer, app, send};
use crate::within_memory;

/// Limit of memory: this many bytes per byte of the body, plus `BASE_BYTES` for the service's own work, the router of each request of
/// the test (5 MB with its contract), and for the longest job request, which may need more per byte.
const BYTES_PER_BYTE: usize = 32;
const BASE_BYTES: usize = 20 << 20;

/// The documented statuses.
const STATUSES: [u16; 11] = [200, 201, 202, 400, 404, 406, 409, 413, 415, 422, 503];

pub(crate) struct TestService {
    runtime: Runtime,
    pub(crate) app: App,
    _dir: TempDir,
}

/// One service for all tests of this binary. It accepts jobs and never runs them.
pub(crate) static SERVICE: LazyLock<TestService> = LazyLock::new(|| {
    let dir = tempfile::tempdir().unwrap();
    let runtime = Runtime::new().unwrap();
    let config = ServerConfig {
        run_jobs: false,
        max_queued_jobs: 10_000,
        session_grace_ms: 1000,
        max_sessions: 100_000,
        ..ServerConfig::default()
    };
    let app = runtime.block_on(async { app(dir.path(), config) });
    TestService {
        runtime,
        app,
        _dir: dir,
    }
});

impl TestService {
    /// Sends a body; checks the status, the detail of a refusal, and the memory limit.
    pub(crate) fn post(&self, name: &str, path: &str, media_type: &str, body: Vec<u8>) -> Answer {
        let limit = BASE_BYTES + BYTES_PER_BYTE * body.len();
        let request = Request::post(path)
            .header(header::CONTENT_TYPE, media_type)
            .body(Body::from(body));
        let answer = within_memory(limit, name, || self.send(request.unwrap()));
        let status = answer.status.as_u16();
        let text = String::from_utf8_lossy(&answer.body);
        assert!(STATUSES.contains(&status), "{name}: {status} {text}");
        if status >= 400 {
            let detail = answer.detail(status);
            assert!(detail.len() < 1100 && names_a_place(&detail), "{name}: {detail}");
        }
        answer
    }

    pub(crate) fn json(&self, name: &str, path: &str, body: Vec<u8>) -> Answer {
        self.post(name, path, "application/json", body)
    }

    pub(crate) fn send(&self, request: Request<Body>) -> Answer {
        self.runtime.block_on(send(&self.app, request))
    }

    pub(crate) fn delete(&self, path: &str) {
        let request = Request::delete(path).body(Body::empty()).unwrap();
        assert_eq!(self.send(request).status, 204, "{path}");
    }
}

/// Whether a detail names the cause: a field, a position in the body, or what is too long.
fn names_a_place(detail: &str) -> bool {
    let words = ["line ", "field `", "body", "model", "request", "name", "kind"];
    let is_field = |word: &str| word.contains(['_', '[', '.', ':']) || FIELDS.contains(&word);
    words.iter().any(|word| detail.contains(word)) || detail.split_whitespace().any(is_field)
}

const FIELDS: [&str; 8] = [
    "frames", "actions", "state", "states", "plans", "action", "plan", "episode",
];
