//! A small web server for what a process has to show: pages, numbers, streams. GET only, plain HTTP/1.1, a thread for each of
//! a few connections.
//!
//! It stands beside work that must not wait for it, and faces browsers that never read: nothing is kept for a reader, every
//! wait has a limit, and who exceeds it is dropped and counted. The frameworks for this bring an executor and some thirty
//! crates; what is needed here is less than their glue.

use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

/// Connections at once; more are refused.
const MAX_CONNECTIONS: usize = 24;
/// Bytes of a request's head.
const MAX_HEAD: u64 = 8 << 10;
/// How long a request may take to come.
const READ_LIMIT: Duration = Duration::from_secs(5);
/// How long a reader may take no byte.
const WRITE_LIMIT: Duration = Duration::from_secs(2);

/// What was asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Path, for example `/frame/3`.
    pub path: String,
    /// What stands behind the `?`, if anything.
    pub query: String,
}

/// Writes a stream to its reader until it has no more, or the reader is gone.
pub type Streaming = Box<dyn FnOnce(&mut dyn Write) -> io::Result<()> + Send>;

/// What is answered.
pub enum Answer {
    /// A whole document.
    Page {
        /// For example `text/html; charset=utf-8`.
        content_type: &'static str,
        /// Its bytes.
        body: Vec<u8>,
    },
    /// Bytes as they come, until the connection closes.
    Stream {
        /// For example `application/octet-stream`.
        content_type: &'static str,
        /// What writes them.
        write: Streaming,
    },
    /// There is no such thing, in words.
    NotFound(String),
}

type Handler = dyn Fn(&Request) -> Answer + Send + Sync;

/// Readers of a server, for those who count.
#[derive(Debug, Default)]
pub struct Readers {
    open: AtomicUsize,
    dropped: AtomicU64,
}

impl Readers {
    /// Connections right now.
    #[must_use]
    pub fn open(&self) -> usize {
        self.open.load(Ordering::Relaxed)
    }

    /// Readers that did not read, and connections beyond those there may be.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }
}

/// A server at work; ends when dropped.
pub struct WebServer {
    address: SocketAddr,
    readers: Arc<Readers>,
    ending: Arc<AtomicBool>,
}

impl WebServer {
    /// Serves what `handler` answers at `address`; port 0 takes any free one.
    ///
    /// # Errors
    /// When the address cannot be listened at.
    pub fn start(
        address: SocketAddr,
        handler: impl Fn(&Request) -> Answer + Send + Sync + 'static,
    ) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        let address = listener.local_addr()?;
        let (readers, ending) = (Arc::<Readers>::default(), Arc::<AtomicBool>::default());
        let server = Self { address, readers: Arc::clone(&readers), ending: Arc::clone(&ending) };
        let handler: Arc<Handler> = Arc::new(handler);
        thread::Builder::new().name("web".into()).spawn(move || {
            for connection in listener.incoming() {
                if ending.load(Ordering::Relaxed) {
                    return;
                }
                if let Ok(connection) = connection {
                    admit(connection, &handler, &readers);
                }
            }
        })?;
        Ok(server)
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
        self.ending.store(true, Ordering::Relaxed);
        // Wakes the thread that waits for connections; if it cannot be reached, the end of the process ends it.
        let _ = TcpStream::connect_timeout(&self.address, Duration::from_millis(100));
    }
}

/// Gives a connection a thread, where there are not too many.
fn admit(connection: TcpStream, handler: &Arc<Handler>, readers: &Arc<Readers>) {
    let (handler, counted) = (Arc::clone(handler), Arc::clone(readers));
    if counted.open.fetch_add(1, Ordering::Relaxed) >= MAX_CONNECTIONS {
        counted.open.fetch_sub(1, Ordering::Relaxed);
        counted.dropped.fetch_add(1, Ordering::Relaxed);
        return;
    }
    let serving = thread::Builder::new().name("reader".into()).spawn(move || {
        if let Err(error) = serve(&connection, &*handler)
            && matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut)
        {
            counted.dropped.fetch_add(1, Ordering::Relaxed);
            tracing::warn!("a reader that does not read is dropped");
        }
        counted.open.fetch_sub(1, Ordering::Relaxed);
    });
    if serving.is_err() {
        readers.open.fetch_sub(1, Ordering::Relaxed);
    }
}

fn serve(connection: &TcpStream, handler: &Handler) -> io::Result<()> {
    connection.set_read_timeout(Some(READ_LIMIT))?;
    connection.set_write_timeout(Some(WRITE_LIMIT))?;
    connection.set_nodelay(true)?;
    let mut out = connection;
    // A connection without a request is no reader: browsers open some to be quick later.
    let Ok(head) = read_head(connection) else { return Ok(()) };
    let Some(request) = parse(&head) else {
        return respond(&mut out, "405 Method Not Allowed", "text/plain", b"GET only");
    };
    match handler(&request) {
        Answer::Page { content_type, body } => respond(&mut out, "200 OK", content_type, &body),
        Answer::NotFound(words) => respond(&mut out, "404 Not Found", "text/plain; charset=utf-8", words.as_bytes()),
        Answer::Stream { content_type, write } => {
            out.write_all(head_of("200 OK", content_type, None).as_bytes())?;
            write(&mut out)
        }
    }
}

/// The first line of a request; the other lines are read and forgotten.
fn read_head(connection: &TcpStream) -> io::Result<String> {
    let mut lines = BufReader::new(connection.take(MAX_HEAD));
    let mut first = String::new();
    lines.read_line(&mut first)?;
    let mut line = String::new();
    while lines.read_line(&mut line)? > 0 && line.trim() != "" {
        line.clear();
    }
    if first.is_empty() { Err(io::ErrorKind::UnexpectedEof.into()) } else { Ok(first) }
}

fn parse(line: &str) -> Option<Request> {
    let mut words = line.split_ascii_whitespace();
    let (Some("GET"), Some(target)) = (words.next(), words.next()) else { return None };
    let (path, query) = target.split_once('?').unwrap_or((target, ""));
    path.starts_with('/').then(|| Request { path: path.into(), query: query.into() })
}

fn respond(out: &mut dyn Write, status: &str, content_type: &str, body: &[u8]) -> io::Result<()> {
    out.write_all(head_of(status, content_type, Some(body.len())).as_bytes())?;
    out.write_all(body)?;
    out.flush()
}

/// Nothing is cached, and a page may load nothing but what this server gives it.
fn head_of(status: &str, content_type: &str, len: Option<usize>) -> String {
    let len = len.map_or(String::new(), |len| format!("Content-Length: {len}\r\n"));
    format!(
        "HTTP/1.1 {status}\r\nContent-Type: {content_type}\r\n{len}Cache-Control: no-store\r\nConnection: close\r\n\
         X-Content-Type-Options: nosniff\r\n\
         Content-Security-Policy: default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'\r\n\r\n"
    )
}

/// Fetches a document, for tests and tools: status line and body.
///
/// # Errors
/// When the server cannot be reached or does not answer within 5 s.
pub fn fetch(address: SocketAddr, path: &str) -> io::Result<(String, Vec<u8>)> {
    let mut connection = TcpStream::connect(address)?;
    connection.set_read_timeout(Some(READ_LIMIT))?;
    write!(connection, "GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n")?;
    let mut answer = Vec::new();
    connection.read_to_end(&mut answer)?;
    let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").ok_or(io::ErrorKind::InvalidData)?;
    let status = String::from_utf8_lossy(&answer[..end]).lines().next().unwrap_or_default().to_owned();
    Ok((status, answer[end + 4..].to_vec()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

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
            "/a" => Answer::Page { content_type: "text/plain", body: request.query.clone().into_bytes() },
            other => Answer::NotFound(format!("no {other}")),
        });
        assert_eq!(fetch(server.address(), "/a?b=1").unwrap(), ("HTTP/1.1 200 OK".into(), b"b=1".to_vec()));
        let (status, body) = fetch(server.address(), "/../etc").unwrap();
        assert_eq!((status.as_str(), body.as_slice()), ("HTTP/1.1 404 Not Found", b"no /../etc".as_slice()));
    }

    #[test]
    fn anything_but_a_get_is_refused() {
        let server = server(|_| Answer::NotFound(String::new()));
        let mut connection = TcpStream::connect(server.address()).unwrap();
        connection.write_all(b"POST / HTTP/1.1\r\n\r\n").unwrap();
        let mut answer = String::new();
        connection.read_to_string(&mut answer).unwrap();
        assert!(answer.starts_with("HTTP/1.1 405"), "{answer}");
    }

    #[test]
    fn a_reader_that_never_reads_is_dropped_and_counted() {
        let server = server(|_| Answer::Stream {
            content_type: "application/octet-stream",
            write: Box::new(|out| {
                loop {
                    out.write_all(&[0; 1 << 16])?;
                }
            }),
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
        drop(crowd);
        wait_for("the others have gone", || server.readers().open() == 0);
        assert!(fetch(server.address(), "/").is_ok());
    }
}
