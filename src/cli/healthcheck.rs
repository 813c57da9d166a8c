//! `foreframe healthcheck`

use std::io::{Read, Write};
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream, ToSocketAddrs};
use std::time::Duration;

use super::error::CliError;
use super::process::print_line;
use super::settings::ServerArgs;
use crate::config::LoadedConfig;

/// Longer than a healthy server takes, even while it trains.
const TIMEOUT: Duration = Duration::from_secs(3);

/// Ask a running server whether it is ready: exit code 0 if it is, 1 if not.
///
/// For containers, which have no curl. Without --url it asks the address that `foreframe serve` would listen on with the same
/// settings: `admin_bind` if it is set or the server has TLS, else `bind`.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  foreframe healthcheck
  foreframe healthcheck --port 9000
  foreframe healthcheck --url http://127.0.0.1:8642/livez")]
pub(super) struct HealthcheckArgs {
    /// The URL to ask [default: /readyz at `admin_bind` or `bind`]
    #[arg(long, value_name = "URL")]
    url: Option<String>,
    #[command(flatten)]
    settings: ServerArgs,
}

pub(super) fn run(args: &HealthcheckArgs) -> Result<(), CliError> {
    let url = match &args.url {
        Some(url) => url.clone(),
        None => format!("http://{}/readyz", reachable(address(&args.settings.load()?))),
    };
    let answer = get(&url)?;
    let status = answer.lines().next().unwrap_or_default();
    if status.split(' ').nth(1) == Some("200") {
        return print_line(format!("{url}: ready"));
    }
    Err(CliError::Failed(format!("{url}: {status}")))
}

/// `admin_bind` if it was set, since the default may be in use by another server, or with TLS; else `bind`.
fn address(loaded: &LoadedConfig) -> SocketAddr {
    // With TLS, `bind` does not speak plain HTTP.
    let has_tls = loaded.config.server.tls_certificate.is_some();
    let admin = loaded
        .config
        .admin_bind
        .filter(|_| has_tls || !loaded.is_default("admin_bind"));
    admin.unwrap_or(loaded.config.bind)
}

/// The address under which this machine reaches a server that listens on `bind`.
fn reachable(bind: SocketAddr) -> SocketAddr {
    let host = match bind.ip() {
        IpAddr::V4(address) if address.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(address) if address.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        address => address,
    };
    SocketAddr::new(host, bind.port())
}

/// The first bytes of the answer.
fn get(url: &str) -> Result<String, CliError> {
    let (host, path) = url
        .strip_prefix("http://")
        .map(|rest| rest.split_once('/').unwrap_or((rest, "")))
        .ok_or_else(|| CliError::Usage(format!("--url {url} is not http://HOST:PORT/PATH")))?;
    let failed = |error: std::io::Error| CliError::Failed(format!("{url}: {error}"));
    let address = host
        .to_socket_addrs()
        .map_err(|error| CliError::Usage(format!("--url {url} is not http://HOST:PORT/PATH: {error}")))?
        .next()
        .ok_or_else(|| CliError::Failed(format!("{url}: {host} has no address")))?;
    let mut stream = TcpStream::connect_timeout(&address, TIMEOUT).map_err(failed)?;
    stream.set_read_timeout(Some(TIMEOUT)).map_err(failed)?;
    let request = format!("GET /{path} HTTP/1.1\r\nhost: {host}\r\nconnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).map_err(failed)?;
    let mut answer = vec![0; 256];
    let count = stream.read(&mut answer).map_err(failed)?;
    answer.truncate(count);
    Ok(String::from_utf8_lossy(&answer).into_owned())
}
