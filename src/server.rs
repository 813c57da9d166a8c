//! The service over HTTP and WebSocket: `serve` answers requests until it is asked to stop. `App` is what the
//! handlers share, [`protocol`] the messages of a stream.
//!
//! The rooms in the order in which they may use each other; each uses only those before it:
//! `config`, `msgpack`, `http` (connections, limits, keys, problem details), `blocking`, `render_cache`, `shared_reading`, `images`, `request_inputs`, `plans`, `stream` (a session and its
//! WebSocket), `environments`, `uploads`, `inference_statistics`, `state` ([`App`]), `routes` (one resource a file), `openapi`, `router`, `admin` (health checks and metrics on their own
//! address), `serve`.

mod admin;
mod blocking;
mod bounded_list;
mod config;
mod environments;
mod http;
mod images;
mod inference_statistics;
mod msgpack;
mod nested_numbers;
mod openapi;
mod openpi;
mod plans;
mod render_cache;
mod request_inputs;
mod router;
mod routes;
mod serve;
mod shared_reading;
mod state;
mod stream;
mod token;
mod uploads;
mod world_session;

pub use admin::serve_worker_health;
pub use config::{ServerConfig, SettingError};
pub(crate) use http::origin::is_origin;
pub use http::problem::Problem;
pub use http::tls::{ServerTls, TlsError};
pub use http::{keys, shutdown};
pub use images::{ImageBytes, ImageFormat};
#[doc(hidden)]
pub use plans::request::SessionPlanRequest;
#[doc(hidden)]
pub use plans::response::PlanResponse;
pub use router::{openapi_document, router};
pub use serve::{ServerListeners, serve};
pub use state::{App, AppParts, start_jobs};
pub use stream::protocol;
