//! The page at `/` in a real Chromium, over its `DevTools` protocol. Skips with a message where there is none.

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Instant;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use foreframe::server::{App, ServerConfig};
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value, json};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{MaybeTlsStream, WebSocketStream};

use crate::service::{PATIENCE, post, run};

const PROGRAMS: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];

fn chromium() -> Option<PathBuf> {
    let directories: Vec<PathBuf> = std::env::split_paths(&std::env::var_os("PATH")?).collect();
    let mut paths = PROGRAMS
        .iter()
        .flat_map(|name| directories.iter().map(move |dir| dir.join(name)));
    paths.find(|path| path.is_file())
}

/// A page in a browser.
struct Page {
    socket: WebSocketStream<MaybeTlsStream<TcpStream>>,
    session: String,
    calls: u64,
    _browser: Browser,
}

/// A browser that ends with the test.
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
            let line = lines.next().expect("Chromium ended at its start").unwrap();
            if let Some(endpoint) = line.strip_prefix("DevTools listening on ") {
                break endpoint.to_owned();
            }
        };
        // A full pipe would hold the browser up.
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
            let answer = tokio::time::timeout(PATIENCE, self.socket.next()).await;
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

    /// Asks the page until the expression is true.
    async fn until(&mut self, expression: &str) {
        let started = Instant::now();
        while self.value(expression).await != json!(true) {
            let page = self.value("document.body.innerText").await;
            assert!(started.elapsed() < PATIENCE, "never true: {expression}\n{page}");
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    }

    async fn screenshot(&mut self, path: &Path) {
        let picture = self.call("Page.captureScreenshot", json!({"format": "png"})).await;
        std::fs::write(path, STANDARD.decode(picture["data"].as_str().unwrap()).unwrap()).unwrap();
    }
}

#[tokio::test]
async fn the_page_drives_a_simulated_robot_and_shows_what_the_model_foresaw() {
    let Some(program) = chromium() else {
        eprintln!("skipped: there is no Chromium in PATH; install it to have the page tested");
        return;
    };
    let dir = tempfile::tempdir().unwrap();
    let app = App::open(ServerConfig {
        data_dir: dir.path().to_owned(),
        ..ServerConfig::default()
    })
    .await
    .unwrap();
    let server = run(app.clone()).await;
    let job = json!({"kind": "collect", "name": "seen", "scenario": "crowded", "trials": 3, "seed": 1});
    post(&app, "/v1/jobs", &job).await;
    let profile = dir.path().join("profile");
    let mut page = Page::open(&program, &profile, &format!("http://{}/", server.address)).await;
    page.until("document.querySelectorAll('#film #error td').length === 5")
        .await;
    page.until("[...document.querySelectorAll('#film #error td')].every(cell => / %$/.test(cell.textContent))")
        .await;
    assert_eq!(page.value("document.getElementById('model').value").await, "moving");
    page.until("[...document.querySelectorAll('#film img')].every(image => image.naturalWidth === 64)")
        .await;
    let key = |kind: &str| json!({"type": kind, "key": "w", "code": "KeyW", "windowsVirtualKeyCode": 87});
    page.call("Input.dispatchKeyEvent", key("keyDown")).await;
    page.until("document.getElementById('status').textContent.includes('your keys: 0.35 m/s, 0.00 rad/s')")
        .await;
    page.until("/collect seen/.test(document.getElementById('jobs').textContent)")
        .await;
    let picture = Path::new(env!("CARGO_TARGET_TMPDIR")).join("page.png");
    page.screenshot(&picture).await;
    eprintln!("the page: {}", picture.display());
    page.call("Input.dispatchKeyEvent", key("keyUp")).await;
    page.until("document.getElementById('status').textContent.includes('its own driver')")
        .await;
    server.stop().await;
}
