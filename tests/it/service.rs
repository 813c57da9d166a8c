//! Shared by the tests of the service: small models with random weights, requests, and a running server.

use std::path::Path;
use std::sync::LazyLock;
use std::time::{Duration, Instant};

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, Method, Request, StatusCode, header};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::{self, App, ServerConfig};
use foreframe_core::frame::{Frame, codec};
use foreframe_core::nn::{Architecture, ChannelScale, Conditioning, DenseSpec, ModelSpec};
use foreframe_core::registry::{DatasetStamp, Model};
use foreframe_core::types::Seed;
use foreframe_jobs::store::{Store, StoreConfig};
use serde_json::Value;
use tokio::runtime::Runtime;
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tower::ServiceExt as _;

use crate::fixtures;

pub(crate) const WIDTH: u32 = 16;
pub(crate) const HEIGHT: u32 = 12;
pub(crate) const CONTEXT: usize = 3;
pub(crate) const HORIZON: usize = 2;
/// Time limit of every wait: longer than any step of a test takes.
pub(crate) const TIMEOUT: Duration = Duration::from_mins(3);

pub(crate) fn spec(conditioning: Conditioning) -> ModelSpec {
    let channel = |name: &str, unit: &str| ChannelScale {
        name: name.to_owned(),
        unit: unit.to_owned(),
        mean: 0.0,
        std: 1.0,
    };
    ModelSpec {
        frame_width_px: WIDTH,
        frame_height_px: HEIGHT,
        context: CONTEXT,
        horizon: HORIZON,
        architecture: Architecture::Dense(DenseSpec {
            features: 8,
            hidden: 8,
            ..DenseSpec::default()
        }),
        conditioning,
        actions: vec![channel("linear", "m/s"), channel("angular", "rad/s")],
        states: vec![channel("x", "m")],
        ..ModelSpec::default()
    }
}

/// A model so slow that requests queue behind one prediction.
pub(crate) fn slow_spec() -> ModelSpec {
    ModelSpec {
        architecture: Architecture::Dense(DenseSpec {
            features: 64,
            hidden: 1024,
            ..DenseSpec::default()
        }),
        ..spec(Conditioning::None)
    }
}

/// Publishes a model with random weights below `dir` and loads it.
pub(crate) fn model(dir: &Path, name: &str, spec: ModelSpec) -> Model {
    let trained_on = DatasetStamp {
        parts: Vec::new(),
        name: "none".to_owned(),
        content_hash: String::new(),
        scenario: None,
        windows: 1,
        split_seed: Seed(0),
        frame_marks: Vec::new(),
    };
    fixtures::model(&dir.join(name), name, spec, trained_on)
}

/// An unconditioned model `plain` and a conditioned one `moving`.
pub(crate) fn app(dir: &Path, config: ServerConfig) -> App {
    let models = vec![
        model(&dir.join("models"), "plain", spec(Conditioning::None)),
        model(&dir.join("models"), "moving", spec(Conditioning::StateAction)),
    ];
    start(with_data(dir, config), models)
}

/// Starts the service with a store in the data directory.
pub(crate) fn start(config: ServerConfig, models: Vec<Model>) -> App {
    let store = store(&config.data_dir);
    App::start(config, models, store).unwrap()
}

/// The store of a data directory. It is opened on a separate runtime, because this function is not async.
pub(crate) fn store(dir: &Path) -> Store {
    static RUNTIME: LazyLock<Runtime> = LazyLock::new(|| Runtime::new().unwrap());
    let config = StoreConfig {
        data_dir: dir.to_owned(),
        ..StoreConfig::default()
    };
    let open = || RUNTIME.block_on(Store::open(&config));
    std::thread::scope(|scope| scope.spawn(open).join()).unwrap().unwrap()
}

pub(crate) fn with_data(dir: &Path, config: ServerConfig) -> ServerConfig {
    ServerConfig {
        data_dir: dir.to_owned(),
        models_dir: dir.join("models"),
        ..config
    }
}

pub(crate) fn frame(value: u8) -> Frame {
    let pixels = (0..WIDTH * HEIGHT).map(|i| value.wrapping_add((i * 3) as u8)).collect();
    Frame::new(WIDTH, HEIGHT, pixels).unwrap()
}

pub(crate) fn png(frame: &Frame) -> String {
    STANDARD.encode(codec::encode_png(frame).unwrap())
}

pub(crate) fn context() -> Vec<String> {
    (0..CONTEXT as u8).map(|i| png(&frame(i * 10))).collect()
}

pub(crate) struct Answer {
    pub(crate) status: StatusCode,
    pub(crate) headers: HeaderMap,
    pub(crate) body: Vec<u8>,
}

impl Answer {
    pub(crate) fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&self.body)))
    }

    /// Checks the shape of a problem response and returns its detail.
    pub(crate) fn detail(&self, status: u16) -> String {
        assert_eq!(self.status, status, "{}", String::from_utf8_lossy(&self.body));
        assert_eq!(self.headers[header::CONTENT_TYPE], "application/problem+json");
        let problem = self.json();
        assert_eq!(problem["status"], status);
        assert_eq!(problem["instance"], self.headers["x-request-id"].to_str().unwrap());
        for field in ["type", "title", "detail"] {
            assert!(problem[field].as_str().is_some_and(|text| !text.is_empty()), "{field}");
        }
        problem["detail"].as_str().unwrap().to_owned()
    }
}

pub(crate) async fn send(app: &App, mut request: Request<Body>) -> Answer {
    // A client's library adds it.
    let host = HeaderValue::from_static("localhost");
    request.headers_mut().entry(header::HOST).or_insert(host);
    let response = server::router(app.clone()).oneshot(request).await.unwrap();
    let (status, headers) = (response.status(), response.headers().clone());
    let body = axum::body::to_bytes(response.into_body(), 1 << 24)
        .await
        .unwrap()
        .to_vec();
    Answer { status, headers, body }
}

pub(crate) async fn get(app: &App, path: &str) -> Answer {
    send(app, Request::get(path).body(Body::empty()).unwrap()).await
}

pub(crate) async fn post(app: &App, path: &str, body: &Value) -> Answer {
    post_text(app, path, body.to_string(), "*/*").await
}

pub(crate) async fn post_text(app: &App, path: &str, body: String, accept: &str) -> Answer {
    let request = Request::builder()
        .method(Method::POST)
        .uri(path)
        .header(header::CONTENT_TYPE, "application/json")
        .header(header::ACCEPT, accept)
        .body(Body::from(body))
        .unwrap();
    send(app, request).await
}

/// A server in this process, on a free port.
pub(crate) struct InProcessServer {
    pub(crate) address: std::net::SocketAddr,
    pub(crate) shutdown: oneshot::Sender<()>,
    pub(crate) task: JoinHandle<()>,
}

pub(crate) async fn run(app: App) -> InProcessServer {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let (shutdown, requested) = oneshot::channel();
    let task = tokio::spawn(server::serve(listener, app, async move {
        let _ = requested.await;
    }));
    InProcessServer {
        address,
        shutdown,
        task,
    }
}

impl InProcessServer {
    pub(crate) async fn stop(self) {
        let _ = self.shutdown.send(());
        tokio::time::timeout(TIMEOUT, self.task).await.unwrap().unwrap();
    }
}

/// Calls `ask` repeatedly until it returns `Some`.
pub(crate) async fn poll_until<T>(mut ask: impl AsyncFnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + TIMEOUT;
    loop {
        if let Some(answer) = ask().await {
            return answer;
        }
        assert!(Instant::now() < deadline, "no result within {TIMEOUT:?}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// Waits until something has come true of a job. Panics if the job fails.
pub(crate) async fn job_becomes(app: &App, id: &str, has_come: impl Fn(&Value) -> bool) -> Value {
    poll_until(async || {
        let job = get(app, &format!("/v1/jobs/{id}")).await.json();
        assert!(job["state"] != "failed", "{job}");
        has_come(&job).then_some(job)
    })
    .await
}
