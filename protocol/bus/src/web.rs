//! Small web server of a process: pages, numbers, streams. GET and HEAD only, HTTP/1.1; over the loopback only under
//! the names of the loopback.
//!
//! It must not delay other work, and browsers may never read: it has a thread of its own, nothing is kept for a reader,
//! every wait has a limit, and a reader beyond the limits is disconnected and counted.

mod host;

use std::convert::Infallible;
use std::error::Error;
use std::io::{self, Read, Write};
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use bytes::Bytes;
use futures_util::StreamExt;
use futures_util::stream::BoxStream;
use http_body_util::combinators::UnsyncBoxBody;
use http_body_util::{BodyExt, Full, StreamBody};
use hyper::body::{Frame, Incoming};
use hyper::header::{
    ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderValue,
    X_CONTENT_TYPE_OPTIONS,
};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use rustix::net::sockopt::set_tcp_user_timeout;
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::{self, Runtime};
use tokio::sync::Semaphore;

/// Maximum number of connections; more are refused.
const MAX_CONNECTIONS: usize = 24;
/// Maximum number of documents generated at once.
const MAX_HANDLERS: usize = 4;
/// Maximum bytes of a request's head, and of an answer waiting for its reader, without the system's own buffers.
const MAX_WAITING: usize = 16 << 10;
/// Timeout for receiving a request.
const READ_LIMIT: Duration = Duration::from_secs(5);
/// Timeout for a reader that takes no byte, milliseconds.
const WRITE_LIMIT_MS: u32 = 5_000;
/// Pause when the system has no room for another connection.
const PAUSE: Duration = Duration::from_millis(100);

/// A page may load content of this server only.
const POLICY: &str = "default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'";
const TEXT: &str = "text/plain; charset=utf-8";

/// A request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Path, for example `/frame/3`.
    pub path: String,
    /// Part after the `?`, if any.
    pub query: String,
}

/// An answer.
pub enum Answer {
    /// A whole document.
    Page {
        /// For example `text/html; charset=utf-8`.
        content_type: &'static str,
        /// Content of the document.
        body: Bytes,
    },
    /// Bytes as they are generated, requested when the reader has taken the previous ones.
    Stream {
        /// For example `application/octet-stream`.
        content_type: &'static str,
        /// Source of the bytes.
        pieces: BoxStream<'static, Bytes>,
    },
    /// Not found, with a text.
    NotFound(String),
}

type Handler = dyn Fn(&Request) -> Answer + Send + Sync;
type WebBody = UnsyncBoxBody<Bytes, Infallible>;

/// Readers of a server, as counters.
#[derive(Debug)]
pub struct Readers {
    places: Arc<Semaphore>,
    dropped: AtomicU64,
}

impl Readers {
    /// Number of readers that did not read, and of connections beyond the maximum.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// A running server; ends when dropped, with all its connections.
pub struct WebServer {
    address: SocketAddr,
    readers: Arc<Readers>,
    runtime: Option<Runtime>,
}

impl WebServer {
    /// Serves the answers of `handler` at `address`; port 0: any free port. The handler may be slow: it has threads of
    /// its own.
    ///
    /// # Errors
    /// When the address cannot be bound, or the system cannot start a thread.
    pub fn start(
        address: SocketAddr,
        handler: impl Fn(&Request) -> Answer + Send + Sync + 'static,
    ) -> io::Result<Self> {
        let mut builder = runtime::Builder::new_multi_thread();
        let runtime = builder
            // One thread for all readers: the handlers run on blocking threads.
            .worker_threads(1)
            .max_blocking_threads(MAX_HANDLERS)
            .thread_name("web")
            .enable_all()
            .build()?;
        let listener = runtime.block_on(TcpListener::bind(address))?;
        let address = listener.local_addr()?;
        let places = Arc::new(Semaphore::new(MAX_CONNECTIONS));
        let dropped = AtomicU64::new(0);
        let readers = Arc::new(Readers { places, dropped });
        runtime.spawn(accept(listener, Arc::new(handler), Arc::clone(&readers)));
        Ok(Self {
            address,
            readers,
            runtime: Some(runtime),
        })
    }

    /// Address of the server.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Its readers.
    pub fn readers(&self) -> &Arc<Readers> {
        &self.readers
    }
}

impl Drop for WebServer {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // Waits neither for readers nor for a running handler.
            runtime.shutdown_background();
        }
    }
}

/// Starts a task for every connection, up to the maximum.
async fn accept(listener: TcpListener, handler: Arc<Handler>, readers: Arc<Readers>) {
    loop {
        let Ok((connection, _)) = listener.accept().await else {
            tokio::time::sleep(PAUSE).await;
            continue;
        };
        // Dropping the connection closes it: no answer has to wait for its reader.
        let Ok(place) = Arc::clone(&readers.places).try_acquire_owned() else {
            readers.dropped.fetch_add(1, Ordering::Relaxed);
            continue;
        };
        let (handler, readers) = (Arc::clone(&handler), Arc::clone(&readers));
        tokio::spawn(async move {
            if let Err(error) = serve(connection, handler).await
                && was_not_read(&error)
            {
                readers.dropped.fetch_add(1, Ordering::Relaxed);
                tracing::warn!("a reader that does not read is disconnected");
            }
            // The task owns the place: it is free only when the connection has ended.
            drop(place);
        });
    }
}

async fn serve(connection: TcpStream, handler: Arc<Handler>) -> hyper::Result<()> {
    // Without it the answer is late, but complete.
    let _ = connection.set_nodelay(true);
    let local = connection.local_addr();
    // The system closes the connection of a reader that takes nothing, with `TimedOut`; hyper limits requests only.
    if let Err(error) = set_tcp_user_timeout(&connection, WRITE_LIMIT_MS) {
        tracing::debug!("a reader that takes nothing is not noticed: {error}");
    }
    let service = service_fn(move |request| {
        answer(Arc::clone(&handler), local.as_ref().ok().copied(), request)
    });
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(READ_LIMIT)
        .max_buf_size(MAX_WAITING)
        // One request per connection: an idle browser holds no place.
        .keep_alive(false)
        .serve_connection(TokioIo::new(connection), service)
        .await
}

/// A missing request ends a connection too, but is not counted as a reader: browsers open spare connections.
fn was_not_read(error: &hyper::Error) -> bool {
    let cause = error
        .source()
        .and_then(|cause| cause.downcast_ref::<io::Error>());
    cause.is_some_and(|cause| cause.kind() == io::ErrorKind::TimedOut)
}

/// Answers a request at `local`, this end of the connection. The body of an answer to HEAD is omitted on sending.
async fn answer(
    handler: Arc<Handler>,
    local: Option<SocketAddr>,
    request: hyper::Request<Incoming>,
) -> Result<Response<WebBody>, Infallible> {
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        let mut refusal = refuse(StatusCode::METHOD_NOT_ALLOWED, "GET and HEAD only".into());
        refusal
            .headers_mut()
            .insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
        return Ok(refusal);
    }
    if let Some(local) = local
        && let Err(name) = host::check(local, request.uri(), request.headers())
    {
        let message = format!("this server is called localhost, not {name:?}");
        return Ok(refuse(StatusCode::FORBIDDEN, message));
    }
    let path = request.uri().path().to_owned();
    let query = request.uri().query().unwrap_or_default().to_owned();
    // A slow handler must not hold the only worker thread, which serves all other readers.
    let answer = tokio::task::spawn_blocking(move || handler(&Request { path, query })).await;
    Ok(match answer {
        Ok(Answer::Page { content_type, body }) => {
            respond(StatusCode::OK, content_type, whole(body))
        }
        Ok(Answer::Stream {
            content_type,
            pieces,
        }) => {
            let body = StreamBody::new(pieces.map(|piece| Ok(Frame::data(piece))));
            respond(StatusCode::OK, content_type, body.boxed_unsync())
        }
        Ok(Answer::NotFound(message)) => refuse(StatusCode::NOT_FOUND, message),
        Err(panicked) => refuse(StatusCode::INTERNAL_SERVER_ERROR, panicked.to_string()),
    })
}

fn refuse(status: StatusCode, message: String) -> Response<WebBody> {
    respond(status, TEXT, whole(message.into()))
}

fn whole(bytes: Bytes) -> WebBody {
    Full::new(bytes).boxed_unsync()
}

/// Nothing is cached.
fn respond(status: StatusCode, content_type: &'static str, body: WebBody) -> Response<WebBody> {
    let mut response = Response::new(body);
    *response.status_mut() = status;
    let headers = [
        (CONTENT_TYPE, content_type),
        (CACHE_CONTROL, "no-store"),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (CONTENT_SECURITY_POLICY, POLICY),
    ];
    response
        .headers_mut()
        .extend(headers.map(|(name, value)| (name, HeaderValue::from_static(value))));
    response
}

/// Fetches a document, for tests and tools: status line and body.
///
/// # Errors
/// When the server cannot be reached or does not answer within 5 s.
pub fn fetch(address: SocketAddr, path: &str) -> io::Result<(String, Vec<u8>)> {
    fetch_within(address, path, READ_LIMIT)
}

/// [`fetch`] with a limit of each wait.
pub(crate) fn fetch_within(
    address: SocketAddr,
    path: &str,
    limit: Duration,
) -> io::Result<(String, Vec<u8>)> {
    let mut connection = std::net::TcpStream::connect_timeout(&address, limit)?;
    connection.set_read_timeout(Some(limit))?;
    // HTTP/1.0 gives a body in one piece that ends with the connection.
    write!(connection, "GET {path} HTTP/1.0\r\n\r\n")?;
    let mut answer = Vec::new();
    connection.read_to_end(&mut answer)?;
    let mut windows = answer.windows(4);
    let end = windows.position(|bytes| bytes == b"\r\n\r\n");
    let end = end.ok_or(io::ErrorKind::InvalidData)?;
    let head = String::from_utf8_lossy(answer.get(..end).unwrap_or_default());
    let status = head.lines().next().unwrap_or_default().to_owned();
    Ok((status, answer.get(end + 4..).unwrap_or_default().to_vec()))
}

#[cfg(test)]
mod tests {
    use std::net::TcpStream;
    use std::thread;
    use std::time::Instant;

    use super::*;

    fn server(handler: impl Fn(&Request) -> Answer + Send + Sync + 'static) -> WebServer {
        WebServer::start("127.0.0.1:0".parse().unwrap(), handler).unwrap()
    }

    /// Number of open connections.
    fn open(server: &WebServer) -> usize {
        MAX_CONNECTIONS - server.readers.places.available_permits()
    }

    fn wait_for(what: &str, condition: impl Fn() -> bool) {
        let deadline = Instant::now() + Duration::from_secs(60);
        while !condition() {
            assert!(Instant::now() < deadline, "{what}");
            thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn a_document_is_what_the_handler_answers() {
        let server = server(|request| match request.path.as_str() {
            "/a" => Answer::Page {
                content_type: "text/plain",
                body: request.query.clone().into(),
            },
            other => Answer::NotFound(format!("no {other}")),
        });
        assert_eq!(
            fetch(server.address(), "/a?b=1").unwrap(),
            ("HTTP/1.0 200 OK".into(), b"b=1".to_vec())
        );
        let (status, body) = fetch(server.address(), "/../etc").unwrap();
        assert_eq!(
            (status.as_str(), body.as_slice()),
            ("HTTP/1.0 404 Not Found", b"no /../etc".as_slice())
        );
    }

    /// The answer to a request without a body.
    fn response_to(server: &WebServer, request: &str) -> String {
        let mut connection = TcpStream::connect(server.address()).unwrap();
        write!(connection, "{request}\r\n\r\n").unwrap();
        let mut answer = String::new();
        connection.read_to_string(&mut answer).unwrap();
        answer
    }

    #[test]
    fn anything_but_get_and_head_is_refused() {
        let server = server(|_| Answer::NotFound(String::new()));
        let answer = response_to(&server, "POST / HTTP/1.1\r\nHost: localhost");
        assert!(
            answer.starts_with("HTTP/1.1 405") && answer.contains("allow: GET, HEAD"),
            "{answer}"
        );
    }

    #[test]
    fn head_is_answered_as_get_without_the_body() {
        let server = server(|request| match request.path.as_str() {
            "/page" => Answer::Page {
                content_type: TEXT,
                body: "twelve bytes".into(),
            },
            "/stream" => {
                let pieces =
                    futures_util::stream::repeat(Bytes::from_static(&[0; 1 << 16])).boxed();
                Answer::Stream {
                    content_type: TEXT,
                    pieces,
                }
            }
            other => Answer::NotFound(other.to_owned()),
        });
        let head = response_to(&server, "HEAD /page HTTP/1.1\r\nHost: localhost");
        assert!(
            head.starts_with("HTTP/1.1 200") && head.contains("content-length: 12\r\n"),
            "{head}"
        );
        assert!(head.ends_with("\r\n\r\n"), "{head}");
        assert!(
            response_to(&server, "HEAD /stream HTTP/1.1\r\nHost: localhost").ends_with("\r\n\r\n")
        );
        assert!(
            response_to(&server, "HEAD /none HTTP/1.1\r\nHost: localhost")
                .starts_with("HTTP/1.1 404")
        );
    }

    #[test]
    fn a_request_under_another_name_is_rejected() {
        let server = server(|_| Answer::Page {
            content_type: TEXT,
            body: "secret".into(),
        });
        let answer = response_to(
            &server,
            &format!(
                "GET / HTTP/1.1\r\nHost: evil.example:{}",
                server.address().port()
            ),
        );
        assert!(
            answer.starts_with("HTTP/1.1 403") && !answer.contains("secret"),
            "{answer}"
        );
        assert!(answer.contains("evil.example"), "{answer}");
        let answer = response_to(
            &server,
            &format!("GET / HTTP/1.1\r\nHost: {}", server.address()),
        );
        assert!(
            answer.starts_with("HTTP/1.1 200") && answer.contains("secret"),
            "{answer}"
        );
    }

    #[test]
    fn a_reader_that_never_reads_is_dropped_and_counted() {
        let server = server(|_| Answer::Stream {
            content_type: "application/octet-stream",
            pieces: futures_util::stream::repeat(Bytes::from_static(&[0; 1 << 16])).boxed(),
        });
        let mut connection = TcpStream::connect(server.address()).unwrap();
        connection.write_all(b"GET / HTTP/1.1\r\n\r\n").unwrap();
        wait_for("the reader is dropped", || server.readers().dropped() == 1);
        wait_for("its thread has ended", || open(&server) == 0);
    }

    #[test]
    fn connections_beyond_the_maximum_are_refused() {
        let server = server(|_| Answer::NotFound(String::new()));
        let connections: Vec<_> = (0..MAX_CONNECTIONS + 3)
            .map(|_| TcpStream::connect(server.address()).unwrap())
            .collect();
        wait_for("three are refused", || server.readers().dropped() == 3);
        wait_for("idle connections are closed", || open(&server) == 0);
        assert_eq!(server.readers().dropped(), 3, "and are no readers");
        drop(connections);
        assert!(fetch(server.address(), "/").is_ok());
    }

    #[test]
    fn a_panicking_or_slow_handler_affects_no_other_request() {
        let server = server(|request| match request.path.as_str() {
            "/panic" => panic!("as it is meant to"),
            "/slow" => {
                thread::sleep(Duration::from_secs(600));
                Answer::NotFound(String::new())
            }
            _ => Answer::Page {
                content_type: TEXT,
                body: Bytes::new(),
            },
        });
        let address = server.address();
        assert!(fetch(address, "/panic").unwrap().0.contains("500"));
        let mut waiting = TcpStream::connect(address).unwrap();
        waiting.write_all(b"GET /slow HTTP/1.1\r\n\r\n").unwrap();
        wait_for("it is let in", || open(&server) == 1);
        assert!(fetch(address, "/").unwrap().0.contains("200"));
        let began = Instant::now();
        drop(server);
        // With an answer that never arrives, or with none.
        let _ = waiting.read_to_end(&mut Vec::new());
        assert!(
            began.elapsed() < Duration::from_secs(60),
            "the connection ends with the server"
        );
    }
}
