//! A light HTTP/1.1 client: one kept-alive connection, and bodies with a content length.

use std::io::{self, ErrorKind};
use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use serde_json::Value;
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::{TcpSocket, TcpStream};
use tokio::time::timeout;

/// Time limit for an answer: longer than any deadline of the server.
pub(crate) const TIMEOUT: Duration = Duration::from_secs(40);

/// The bytes of a request.
#[derive(Clone)]
pub(crate) struct Request(Vec<u8>);

impl Request {
    fn new(line: &str, headers: &str, body: &[u8]) -> Self {
        let head = format!(
            "{line} HTTP/1.1\r\nhost: a\r\n{headers}content-length: {}\r\n\r\n",
            body.len()
        );
        Self([head.as_bytes(), body].concat())
    }

    pub(crate) fn get(path: &str) -> Self {
        Self::new(&format!("GET {path}"), "", &[])
    }

    pub(crate) fn delete(path: &str) -> Self {
        Self::new(&format!("DELETE {path}"), "", &[])
    }

    pub(crate) fn post(path: &str, content_type: &str, body: &[u8]) -> Self {
        Self::new(
            &format!("POST {path}"),
            &format!("content-type: {content_type}\r\n"),
            body,
        )
    }

    pub(crate) fn json(path: &str, body: &Value) -> Self {
        Self::post(path, "application/json", body.to_string().as_bytes())
    }

    /// The same request with one more header.
    pub(crate) fn with_header(mut self, name: &str, value: &str) -> Self {
        let line_end = self.0.windows(2).position(|pair| pair == b"\r\n").unwrap() + 2;
        self.0
            .splice(line_end..line_end, format!("{name}: {value}\r\n").into_bytes());
        self
    }

    /// The same request with an API key.
    pub(crate) fn with_key(self, key: &str) -> Self {
        self.with_header("authorization", &format!("Bearer {key}"))
    }
}

/// A response.
#[derive(Default)]
pub(crate) struct Response {
    pub(crate) status: u16,
    /// Whether it has a valid `Retry-After` header.
    pub(crate) retry_after: bool,
    pub(crate) body: Vec<u8>,
}

impl Response {
    pub(crate) fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    pub(crate) fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|error| panic!("{error}: {}", self.text()))
    }

    /// Whether it is a refusal that says when to try again.
    pub(crate) fn is_refusal(&self) -> bool {
        matches!(self.status, 429 | 503) && self.retry_after
    }
}

/// The server closes idle connections. One that was idle for this long is not used again.
const KEEP_ALIVE: Duration = Duration::from_secs(5);

/// One connection, opened on demand.
pub(crate) struct Http {
    address: SocketAddr,
    /// The address that it connects from.
    source: Option<IpAddr>,
    /// The connection, and when it was last used.
    kept: Option<(BufReader<TcpStream>, Instant)>,
}

impl Http {
    pub(crate) fn new(address: SocketAddr) -> Self {
        Self {
            address,
            source: None,
            kept: None,
        }
    }

    /// A client that connects from another loopback address.
    pub(crate) fn from_source(address: SocketAddr, source: IpAddr) -> Self {
        Self {
            source: Some(source),
            ..Self::new(address)
        }
    }

    /// Sends a request and returns the response. Errors: the connection ended, or the time limit passed.
    pub(crate) async fn ask(&mut self, request: &Request) -> io::Result<Response> {
        timeout(TIMEOUT, self.exchange(request))
            .await
            .unwrap_or_else(|_| Err(ErrorKind::TimedOut.into()))
    }

    /// Sends a request and returns the response, which must have this status.
    pub(crate) async fn expect(&mut self, status: u16, request: &Request) -> Response {
        let answer = self.ask(request).await.expect("the server answers");
        assert_eq!(answer.status, status, "{}", answer.text());
        answer
    }

    async fn exchange(&mut self, request: &Request) -> io::Result<Response> {
        let mut stream = match self.kept.take() {
            Some((stream, asked)) if asked.elapsed() < KEEP_ALIVE => stream,
            _ => BufReader::new(connect(self.address, self.source).await?),
        };
        stream.get_mut().write_all(&request.0).await?;
        let (answer, is_last) = read(&mut stream).await?;
        self.kept = (!is_last).then(|| (stream, Instant::now()));
        Ok(answer)
    }
}

/// Opens a connection, from `source` if there is one.
pub(crate) async fn connect(address: SocketAddr, source: Option<IpAddr>) -> io::Result<TcpStream> {
    let socket = TcpSocket::new_v4()?;
    if let Some(source) = source {
        socket.bind(SocketAddr::new(source, 0))?;
    }
    let stream = socket.connect(address).await?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Reads a response, and whether the connection ends after it.
async fn read(stream: &mut BufReader<TcpStream>) -> io::Result<(Response, bool)> {
    let (mut answer, mut length, mut is_last) = (Response::default(), None, false);
    let mut line = String::new();
    stream.read_line(&mut line).await?;
    let status = line.split(' ').nth(1).and_then(|status| status.parse().ok());
    answer.status = status.ok_or(ErrorKind::UnexpectedEof)?;
    loop {
        line.clear();
        if stream.read_line(&mut line).await? == 0 {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        let Some((name, value)) = line.trim_end().split_once(": ") else {
            break;
        };
        match name.to_ascii_lowercase().as_str() {
            "content-length" => length = value.parse().ok(),
            "retry-after" => answer.retry_after = value.parse::<u64>().is_ok(),
            "connection" => is_last = value == "close",
            _ => {}
        }
    }
    match length {
        Some(length) => {
            answer.body.resize(length, 0);
            stream.read_exact(&mut answer.body).await?;
        }
        None if is_last => drop(stream.read_to_end(&mut answer.body).await?),
        None => {}
    }
    Ok((answer, is_last))
}
