//! A small web server for what a process has to show: pages, numbers, streams. GET and HEAD only, HTTP/1.1; over the loopback
//! under the names of the loopback alone.
//!
//! It stands beside work that must not wait for it, and faces browsers that never read: it has a thread of its own, nothing
//! is kept for a reader, every wait has a limit, and who exceeds it is dropped and counted.

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
use hyper::header::{ALLOW, CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderValue, X_CONTENT_TYPE_OPTIONS};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Response, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::{self, Runtime};
use tokio::sync::Semaphore;
use tokio_io_timeout::TimeoutStream;

/// Connections at once; more are refused.
const MAX_CONNECTIONS: usize = 24;
/// Documents that are put together at once.
const MAX_HANDLERS: usize = 4;
/// Bytes of a request's head, and of an answer that wait for its reader beside the system's own.
const MAX_WAITING: usize = 16 << 10;
/// How long a request may take to come.
const READ_LIMIT: Duration = Duration::from_secs(5);
/// How long a reader may take no byte.
const WRITE_LIMIT: Duration = Duration::from_secs(2);
/// How long to wait when the system has no room for another connection.
const PAUSE: Duration = Duration::from_millis(100);

/// A page may load nothing but what this server gives it.
const POLICY: &str = "default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'";
const TEXT: &str = "text/plain; charset=utf-8";

/// What was asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Path, for example `/frame/3`.
    pub path: String,
    /// What stands behind the `?`, if anything.
    pub query: String,
}

/// What is answered.
pub enum Answer {
    /// A whole document.
    Page {
        /// For example `text/html; charset=utf-8`.
        content_type: &'static str,
        /// Its bytes.
        body: Bytes,
    },
    /// Bytes as they come, asked for when the reader has taken those before.
    Stream {
        /// For example `application/octet-stream`.
        content_type: &'static str,
        /// Where they come from.
        pieces: BoxStream<'static, Bytes>,
    },
    /// There is no such thing, in words.
    NotFound(String),
}

type Handler = dyn Fn(&Request) -> Answer + Send + Sync;
type Body = UnsyncBoxBody<Bytes, Infallible>;

/// Readers of a server, for those who count.
#[derive(Debug)]
pub struct Readers {
    places: Arc<Semaphore>,
    dropped: AtomicU64,
}

impl Readers {
    /// Connections right now.
    #[must_use]
    pub fn open(&self) -> usize {
        MAX_CONNECTIONS - self.places.available_permits()
    }

    /// Readers that did not read, and connections beyond those there may be.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// A server at work; ends when dropped, and all its connections with it.
pub struct WebServer {
    address: SocketAddr,
    readers: Arc<Readers>,
    runtime: Option<Runtime>,
}

impl WebServer {
    /// Serves what `handler` answers at `address`; port 0 takes any free one. The handler may take its time: it has threads
    /// of its own.
    ///
    /// # Errors
    /// When the address cannot be listened at, or the system gives no thread.
    pub fn start(
        address: SocketAddr,
        handler: impl Fn(&Request) -> Answer + Send + Sync + 'static,
    ) -> io::Result<Self> {
        let mut builder = runtime::Builder::new_multi_thread();
        let runtime =
            builder.worker_threads(1).max_blocking_threads(MAX_HANDLERS).thread_name("web").enable_all().build()?;
        let listener = runtime.block_on(TcpListener::bind(address))?;
        let address = listener.local_addr()?;
        let readers =
            Arc::new(Readers { places: Arc::new(Semaphore::new(MAX_CONNECTIONS)), dropped: AtomicU64::new(0) });
        runtime.spawn(accept(listener, Arc::new(handler), Arc::clone(&readers)));
        Ok(Self { address, readers, runtime: Some(runtime) })
    }

    /// Where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Its readers.
    #[must_use]
    pub fn readers(&self) -> &Arc<Readers> {
        &self.readers
    }
}

impl Drop for WebServer {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            // Waits for nobody: neither for readers nor for a handler at work.
            runtime.shutdown_background();
        }
    }
}

/// Gives every connection a task, where there are not too many.
async fn accept(listener: TcpListener, handler: Arc<Handler>, readers: Arc<Readers>) {
    loop {
        let Ok((connection, _)) = listener.accept().await else {
            tokio::time::sleep(PAUSE).await;
            continue;
        };
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
                tracing::warn!("a reader that does not read is dropped");
            }
            drop(place);
        });
    }
}

async fn serve(connection: TcpStream, handler: Arc<Handler>) -> hyper::Result<()> {
    // What is late for want of it is late, and no more.
    let _ = connection.set_nodelay(true);
    let local = connection.local_addr();
    let mut connection = TimeoutStream::new(connection);
    connection.set_write_timeout(Some(WRITE_LIMIT));
    let service = service_fn(move |request| answer(Arc::clone(&handler), local.as_ref().ok().copied(), request));
    http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(READ_LIMIT)
        .max_buf_size(MAX_WAITING)
        .keep_alive(false)
        .serve_connection(TokioIo::new(Box::pin(connection)), service)
        .await
}

/// A request that does not come ends a connection too, but is no reader: browsers open some to be quick later.
fn was_not_read(error: &hyper::Error) -> bool {
    let cause = error.source().and_then(|cause| cause.downcast_ref::<io::Error>());
    cause.is_some_and(|cause| cause.kind() == io::ErrorKind::TimedOut)
}

/// What is answered at `local`, this end of the connection. The body of an answer to HEAD is left out on its way.
async fn answer(
    handler: Arc<Handler>,
    local: Option<SocketAddr>,
    request: hyper::Request<Incoming>,
) -> Result<Response<Body>, Infallible> {
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        let mut refusal = respond(StatusCode::METHOD_NOT_ALLOWED, TEXT, whole("GET and HEAD only".into()));
        refusal.headers_mut().insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
        return Ok(refusal);
    }
    if let Some(local) = local
        && let Err(name) = host::check(local, request.uri(), request.headers())
    {
        let words = format!("this server is called localhost, not {name:?}");
        return Ok(respond(StatusCode::FORBIDDEN, TEXT, whole(words.into())));
    }
    let (path, query) = (request.uri().path().to_owned(), request.uri().query().unwrap_or_default().to_owned());
    let answer = tokio::task::spawn_blocking(move || handler(&Request { path, query })).await;
    Ok(match answer {
        Ok(Answer::Page { content_type, body }) => respond(StatusCode::OK, content_type, whole(body)),
        Ok(Answer::Stream { content_type, pieces }) => {
            let body = StreamBody::new(pieces.map(|piece| Ok(Frame::data(piece))));
            respond(StatusCode::OK, content_type, body.boxed_unsync())
        }
        Ok(Answer::NotFound(words)) => respond(StatusCode::NOT_FOUND, TEXT, whole(words.into())),
        Err(panicked) => respond(StatusCode::INTERNAL_SERVER_ERROR, TEXT, whole(panicked.to_string().into())),
    })
}

fn whole(bytes: Bytes) -> Body {
    Full::new(bytes).boxed_unsync()
}

/// Nothing is cached.
fn respond(status: StatusCode, content_type: &'static str, body: Body) -> Response<Body> {
    let mut response = Response::new(body);
    *response.status_mut() = status;
    let headers = [
        (CONTENT_TYPE, content_type),
        (CACHE_CONTROL, "no-store"),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (CONTENT_SECURITY_POLICY, POLICY),
    ];
    response.headers_mut().extend(headers.map(|(name, value)| (name, HeaderValue::from_static(value))));
    response
}

/// Fetches a document, for tests and tools: status line and body.
///
/// # Errors
/// When the server cannot be reached or does not answer within 5 s.
pub fn fetch(address: SocketAddr, path: &str) -> io::Result<(String, Vec<u8>)> {
    let mut connection = std::net::TcpStream::connect(address)?;
    connection.set_read_timeout(Some(READ_LIMIT))?;
    // Version 1.0 asks for a body in one piece that ends with the connection.
    write!(connection, "GET {path} HTTP/1.0\r\n\r\n")?;
    let mut answer = Vec::new();
    connection.read_to_end(&mut answer)?;
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").ok_or(io::ErrorKind::InvalidData)?;
    let status = String::from_utf8_lossy(&answer[..end]).lines().next().unwrap_or_default().to_owned();
    Ok((status, answer[end + 4..].to_vec()))
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
            "/a" => Answer::Page { content_type: "text/plain", body: request.query.clone().into() },
            other => Answer::NotFound(format!("no {other}")),
        });
        assert_eq!(fetch(server.address(), "/a?b=1").unwrap(), ("HTTP/1.0 200 OK".into(), b"b=1".to_vec()));
        let (status, body) = fetch(server.address(), "/../etc").unwrap();
        assert_eq!((status.as_str(), body.as_slice()), ("HTTP/1.0 404 Not Found", b"no /../etc".as_slice()));
    }

    /// What is answered to a request without a body.
    fn asked(server: &WebServer, request: &str) -> String {
        let mut connection = TcpStream::connect(server.address()).unwrap();
        write!(connection, "{request}\r\n\r\n").unwrap();
        let mut answer = String::new();
        connection.read_to_string(&mut answer).unwrap();
        answer
    }

    #[test]
    fn anything_but_get_and_head_is_refused() {
        let server = server(|_| Answer::NotFound(String::new()));
        let answer = asked(&server, "POST / HTTP/1.1\r\nHost: localhost");
        assert!(answer.starts_with("HTTP/1.1 405") && answer.contains("allow: GET, HEAD"), "{answer}");
    }

    #[test]
    fn head_is_answered_as_get_without_the_body() {
        let server = server(|request| match request.path.as_str() {
            "/page" => Answer::Page { content_type: TEXT, body: "twelve bytes".into() },
            "/stream" => {
                let pieces = futures_util::stream::repeat(Bytes::from_static(&[0; 1 << 16])).boxed();
                Answer::Stream { content_type: TEXT, pieces }
            }
            other => Answer::NotFound(other.to_owned()),
        });
        let head = asked(&server, "HEAD /page HTTP/1.1\r\nHost: localhost");
        assert!(head.starts_with("HTTP/1.1 200") && head.contains("content-length: 12\r\n"), "{head}");
        assert!(head.ends_with("\r\n\r\n"), "{head}");
        assert!(asked(&server, "HEAD /stream HTTP/1.1\r\nHost: localhost").ends_with("\r\n\r\n"));
        assert!(asked(&server, "HEAD /none HTTP/1.1\r\nHost: localhost").starts_with("HTTP/1.1 404"));
    }

    #[test]
    fn a_page_of_another_name_is_told_nothing() {
        let server = server(|_| Answer::Page { content_type: TEXT, body: "secret".into() });
        let answer = asked(&server, &format!("GET / HTTP/1.1\r\nHost: evil.example:{}", server.address().port()));
        assert!(answer.starts_with("HTTP/1.1 403") && !answer.contains("secret"), "{answer}");
        assert!(answer.contains("evil.example"), "{answer}");
        let answer = asked(&server, &format!("GET / HTTP/1.1\r\nHost: {}", server.address()));
        assert!(answer.starts_with("HTTP/1.1 200") && answer.contains("secret"), "{answer}");
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
        wait_for("its thread has ended", || server.readers().open() == 0);
    }

    #[test]
    fn a_crowd_is_not_let_in() {
        let server = server(|_| Answer::NotFound(String::new()));
        let crowd: Vec<_> = (0..MAX_CONNECTIONS + 3).map(|_| TcpStream::connect(server.address()).unwrap()).collect();
        wait_for("three are refused", || server.readers().dropped() == 3);
        wait_for("those who ask for nothing have to go", || server.readers().open() == 0);
        assert_eq!(server.readers().dropped(), 3, "and are no readers");
        drop(crowd);
        assert!(fetch(server.address(), "/").is_ok());
    }

    #[test]
    fn a_handler_that_panics_and_one_that_takes_its_time_harm_nobody() {
        let server = server(|request| match request.path.as_str() {
            "/panic" => panic!("as it is meant to"),
            "/slow" => {
                thread::sleep(Duration::from_secs(600));
                Answer::NotFound(String::new())
            }
            _ => Answer::Page { content_type: TEXT, body: Bytes::new() },
        });
        let address = server.address();
        assert!(fetch(address, "/panic").unwrap().0.contains("500"));
        let mut waiting = TcpStream::connect(address).unwrap();
        waiting.write_all(b"GET /slow HTTP/1.1\r\n\r\n").unwrap();
        wait_for("it is let in", || server.readers().open() == 1);
        assert!(fetch(address, "/").unwrap().0.contains("200"));
        let began = Instant::now();
        drop(server);
        // With an answer that nobody will give, or with none.
        let _ = waiting.read_to_end(&mut Vec::new());
        assert!(began.elapsed() < Duration::from_secs(60), "the connection ends with the server");
    }
}
