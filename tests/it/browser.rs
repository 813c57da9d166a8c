//! The page at `/` in a real Chromium, over its `DevTools` protocol: its API key, its environments and `/docs`. Skips with a
//! message where there is none. `tests/python/page.py` tests the views.

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::keys::Keys;
use foreframe::server::{App, ServerConfig};
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

use crate::keys::new_key;
use crate::service::{InProcessServer, TIMEOUT, run};
use crate::skip::skip_without;

const PROGRAMS: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];

fn chromium() -> Option<PathBuf> {
    let directories: Vec<PathBuf> = std::env::split_paths(&std::env::var_os("PATH")?).collect();
    let mut paths = PROGRAMS
        .iter()
        .flat_map(|name| directories.iter().map(move |dir| dir.join(name)));
    paths.find(|path| path.is_file())
}

/// A page in a headless browser.
struct Page {
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
    session: String,
    calls: u64,
    _browser: Browser,
}

/// A browser process. Dropping it kills the process.
struct Browser(Child);

impl Drop for Browser {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Page {
    async fn open(program: &Path, profile: &Path, address: &str) -> Self {
        let mut browser = Command::new(program)
            .args([
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--no-first-run",
                "--disable-sync",
            ])
            .args([
                "--disable-background-networking",
                "--disable-component-update",
                "--disable-quic",
            ])
            .args(["--remote-debugging-port=0", "--window-size=1100,1000"])
            .arg(format!("--user-data-dir={}", profile.display()))
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(browser.stderr.take().unwrap()).lines();
        let browser = Browser(browser);
        let endpoint = loop {
            let line = lines.next().expect("Chromium starts").unwrap();
            if let Some(endpoint) = line.strip_prefix("DevTools listening on ") {
                break endpoint.to_owned();
            }
        };
        // A full pipe would block the browser.
        std::thread::spawn(move || lines.for_each(drop));
        let (socket, _) = tokio_tungstenite::connect_async(endpoint).await.unwrap();
        let mut page = Self {
            socket,
            session: String::new(),
            calls: 0,
            _browser: browser,
        };
        let target = page.call("Target.createTarget", json!({"url": address})).await;
        let attached = json!({"targetId": target["targetId"], "flatten": true});
        let session = page.call("Target.attachToTarget", attached).await;
        session["sessionId"].as_str().unwrap().clone_into(&mut page.session);
        page
    }

    async fn call(&mut self, method: &str, params: Value) -> Value {
        self.calls += 1;
        let id = self.calls;
        let mut message = json!({"id": id, "method": method, "params": params});
        if !self.session.is_empty() {
            message["sessionId"] = json!(self.session);
        }
        self.socket.send(Message::text(message.to_string())).await.unwrap();
        loop {
            let answer = tokio::time::timeout(TIMEOUT, self.socket.next()).await;
            let Message::Text(text) = answer.unwrap().unwrap().unwrap() else {
                continue;
            };
            let mut answer: Value = serde_json::from_str(&text).unwrap();
            if answer["id"] == id {
                assert!(answer.get("error").is_none(), "{method}: {answer}");
                return answer["result"].take();
            }
        }
    }

    async fn value(&mut self, expression: &str) -> Value {
        let params = json!({"expression": expression, "returnByValue": true});
        self.call("Runtime.evaluate", params).await["result"]["value"].take()
    }

    /// Evaluates the expression repeatedly until it is true.
    async fn wait_until(&mut self, expression: &str) {
        let started = Instant::now();
        while self.value(expression).await != json!(true) {
            let page = self.value("document.body.innerText").await;
            assert!(started.elapsed() < TIMEOUT, "never true: {expression}\n{page}");
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    }

    /// Saves a screenshot of the whole page and checks that the page is not wider than the screen.
    async fn screenshot(&mut self, name: &str, width_px: u32, colors: &str) {
        let screen = json!({"width": width_px, "height": 900, "deviceScaleFactor": 1, "mobile": width_px < 600});
        self.call("Emulation.setDeviceMetricsOverride", screen).await;
        let scheme = json!({"features": [{"name": "prefers-color-scheme", "value": colors}]});
        self.call("Emulation.setEmulatedMedia", scheme).await;
        let params = json!({"format": "png", "captureBeyondViewport": true});
        let picture = self.call("Page.captureScreenshot", params).await;
        let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("{name}-{width_px}-{colors}.png"));
        std::fs::write(&path, STANDARD.decode(picture["data"].as_str().unwrap()).unwrap()).unwrap();
        eprintln!("the page: {}", path.display());
        let overhang_px = "document.documentElement.scrollWidth - innerWidth";
        assert!(
            self.value(overhang_px).await.as_i64().unwrap() <= 0,
            "{name} at {width_px} px"
        );
    }

    /// Types an API key into the form and submits it.
    async fn unlock(&mut self, key: &str) {
        let focus = "document.getElementById('key').focus(); document.getElementById('key').select()";
        self.value(focus).await;
        self.call("Input.insertText", json!({"text": key})).await;
        for kind in ["keyDown", "keyUp"] {
            let enter =
                json!({"type": kind, "key": "Enter", "code": "Enter", "windowsVirtualKeyCode": 13, "text": "\r"});
            self.call("Input.dispatchKeyEvent", enter).await;
        }
    }
}

/// True if a prediction has come true, so that all pictures are there.
const IS_COMPLETE: &str =
    "/Error .* % of the best simple guess|Nothing moves/.test(document.querySelector('.verdict')?.textContent)
    && document.querySelectorAll('.play .picture.dim').length === 0";

async fn serve(data_dir: &Path) -> (App, Keys, InProcessServer) {
    serve_with(data_dir, ServerConfig::default().max_environments).await
}

async fn serve_with(data_dir: &Path, max_environments: usize) -> (App, Keys, InProcessServer) {
    let app = App::open(ServerConfig {
        data_dir: data_dir.to_owned(),
        max_environments,
        ..ServerConfig::default()
    })
    .await
    .unwrap();
    let keys = Keys::open(app.store().clone(), false).await.unwrap();
    let app = app.with_keys(keys.clone());
    (app.clone(), keys, run(app).await)
}

#[tokio::test]
async fn the_page_asks_for_an_api_key_and_hides_it() {
    let Some(program) = chromium() else {
        skip_without("there is no Chromium in PATH; install it to have the page tested");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let (app, keys, server) = serve(dir.path()).await;
    let [key, other] = [new_key(app.store(), &keys).await, new_key(app.store(), &keys).await];
    let profile = dir.path().join("profile");
    let mut page = Page::open(&program, &profile, &format!("http://{}/", server.address)).await;
    let says = |text: &str| format!("document.querySelector('.unlock .wrong').textContent.includes('{text}')");
    page.wait_until("document.querySelector('.unlock') !== null && document.querySelector('.play') === null")
        .await;
    assert_eq!(
        page.value("document.querySelector('.unlock .wrong').textContent").await,
        ""
    );
    page.unlock("let me in").await;
    page.wait_until(&says("This is not a key")).await;
    page.unlock(&format!("{}x", key.text)).await;
    page.wait_until(&says("This key is unknown or was revoked")).await;
    for width_px in [1280, 400] {
        page.screenshot("locked", width_px, "light").await;
    }
    page.unlock(&key.text).await;
    page.wait_until(IS_COMPLETE).await;
    let addresses = "[location.href, ...performance.getEntriesByType('resource').map(entry => entry.name)].join(' ')";
    let addresses = page.value(addresses).await;
    assert!(
        addresses.as_str().unwrap().contains("/v1/models") && !addresses.as_str().unwrap().contains("ffk_"),
        "{addresses}"
    );
    // The tab keeps the key.
    page.call("Page.reload", json!({})).await;
    page.wait_until(&format!("performance.now() < 20000 && {IS_COMPLETE}"))
        .await;
    assert_eq!(page.value("document.querySelector('.unlock')").await, Value::Null);
    app.store()
        .revoke_key(&key.id, 2.0, &foreframe_jobs::store::Author::CommandLine)
        .await
        .unwrap();
    keys.refresh().await.unwrap();
    page.wait_until(&says("This key is unknown or was revoked")).await;
    page.unlock(&other.text).await;
    page.wait_until(IS_COMPLETE).await;
    server.stop().await;
}

#[tokio::test]
async fn the_documentation_is_shown_under_its_security_policy() {
    let Some(program) = chromium() else {
        skip_without("there is no Chromium in PATH; install it to have the page tested");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let server = run(crate::service::app(dir.path(), ServerConfig::default())).await;
    let profile = dir.path().join("profile");
    let mut page = Page::open(&program, &profile, &format!("http://{}/docs/", server.address)).await;
    page.wait_until("document.querySelectorAll('.opblock').length > 20")
        .await;
    // An operation opens and shows its form.
    page.value("document.querySelector('.opblock-summary-control').click()")
        .await;
    page.wait_until("document.querySelector('.opblock-body') !== null")
        .await;
    page.screenshot("docs", 1280, "light").await;
    server.stop().await;
}

#[tokio::test]
async fn page_deletes_its_environment_when_it_closes() {
    let Some(program) = chromium() else {
        skip_without("there is no Chromium in PATH; install it to have the page tested");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let (_app, _, server) = serve_with(dir.path(), 2).await;
    let profile = dir.path().join("profile");
    let mut page = Page::open(&program, &profile, &format!("http://{}/", server.address)).await;
    for _ in 0..5 {
        page.wait_until(IS_COMPLETE).await;
        page.call("Page.reload", json!({})).await;
        page.wait_until(&format!("performance.now() < 20000 && {IS_COMPLETE}"))
            .await;
    }
    server.stop().await;
}

#[tokio::test]
async fn page_says_what_to_do_without_models() {
    let Some(program) = chromium() else {
        skip_without("there is no Chromium in PATH; install it to have the page tested");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let config = crate::service::with_data(dir.path(), ServerConfig::default());
    let app = crate::service::start(config, Vec::new());
    let server = run(app).await;
    let profile = dir.path().join("profile");
    let mut page = Page::open(&program, &profile, &format!("http://{}/", server.address)).await;
    page.wait_until("document.querySelector('.empty h1')?.textContent === 'No model is loaded'")
        .await;
    server.stop().await;
}
