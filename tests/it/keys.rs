//! API keys: when a key is required, and what happens after it is revoked.

use axum::body::Body;
use axum::http::{Request, header};
use foreframe::server::keys::{Keys, NewKey};
use foreframe::server::{App, ServerConfig};
use foreframe::store::{Store, StoreConfig};
use tokio_tungstenite::tungstenite::Error;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;

use crate::service::{Answer, app, get, run, send};

async fn app_with_keys(is_required: bool) -> (tempfile::TempDir, Store, Keys, App) {
    let dir = tempfile::tempdir().unwrap();
    let config = StoreConfig {
        data_dir: dir.path().to_owned(),
        ..StoreConfig::default()
    };
    let store = Store::open(&config).await.unwrap();
    let keys = Keys::open(store.clone(), is_required).await.unwrap();
    let app = app(dir.path(), ServerConfig::default()).with_keys(keys.clone());
    (dir, store, keys, app)
}

pub(crate) async fn new_key(store: &Store, keys: &Keys) -> NewKey {
    let key = NewKey::generate().unwrap();
    store.create_key(&key.id, "robot", &key.hash, 1.0).await.unwrap();
    keys.refresh().await.unwrap();
    key
}

async fn models_with(app: &App, authorization: &str) -> Answer {
    let request = Request::get("/v1/models")
        .header(header::AUTHORIZATION, authorization)
        .body(Body::empty())
        .unwrap();
    send(app, request).await
}

#[tokio::test]
async fn authentication_starts_with_the_first_key() {
    let (_dir, store, keys, app) = app_with_keys(false).await;
    assert_eq!(get(&app, "/v1/models").await.status, 200);
    let key = new_key(&store, &keys).await;
    assert_eq!(get(&app, "/v1/models").await.status, 401);
    assert!(store.revoke_key(&key.id, 2.0).await.unwrap());
    keys.refresh().await.unwrap();
    // Revoking the last key does not switch authentication off.
    assert_eq!(get(&app, "/v1/models").await.status, 401);
    let (_dir, _store, _keys, app) = app_with_keys(true).await;
    assert_eq!(get(&app, "/v1/models").await.status, 401);
}

#[tokio::test]
async fn the_api_requires_a_valid_key() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let (key, other) = (new_key(&store, &keys).await, NewKey::generate().unwrap());
    let refused = get(&app, "/v1/models").await;
    assert!(refused.detail(401).contains("Authorization: Bearer KEY"));
    assert_eq!(refused.headers[header::WWW_AUTHENTICATE], "Bearer realm=\"foreframe\"");
    let secret_of_another = format!("ffk_{}_{}", key.id, other.text.rsplit('_').next().unwrap());
    for wrong in [&other.text, &secret_of_another, "nonsense", ""] {
        let refused = models_with(&app, &format!("Bearer {wrong}")).await;
        assert!(!refused.detail(401).contains("ffk_"), "{wrong}");
    }
    for _ in 0..2 {
        assert_eq!(models_with(&app, &format!("Bearer {}", key.text)).await.status, 200);
    }
    for path in ["/", "/livez", "/metrics", "/openapi.json", "/docs/"] {
        assert_eq!(get(&app, path).await.status, 200, "{path}");
    }
    assert!(store.revoke_key(&key.id, 2.0).await.unwrap());
    keys.refresh().await.unwrap();
    assert_eq!(models_with(&app, &format!("Bearer {}", key.text)).await.status, 401);
}

#[tokio::test]
async fn a_websocket_can_send_its_key_as_a_subprotocol() {
    let (_dir, store, keys, app) = app_with_keys(true).await;
    let key = new_key(&store, &keys).await;
    let server = run(app).await;
    let connect = async |protocols: String| {
        let url = format!("ws://{}/v1/models/plain/stream", server.address);
        let mut request = url.into_client_request().unwrap();
        request
            .headers_mut()
            .insert("sec-websocket-protocol", protocols.parse().unwrap());
        tokio_tungstenite::connect_async(request).await
    };
    let refused = connect("foreframe.v1.json".to_owned()).await.unwrap_err();
    assert!(matches!(refused, Error::Http(answer) if answer.status() == 401));
    let (_socket, answer) = connect(format!("foreframe.v1.json, foreframe.key.{}", key.text))
        .await
        .unwrap();
    assert_eq!(answer.headers()["sec-websocket-protocol"], "foreframe.v1.json");
    server.stop().await;
}
