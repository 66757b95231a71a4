//! Virtual links between the processes of a run and their router that can be cut or silenced.

use std::collections::BTreeSet;
use std::fs;
use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use bus::Endpoint;

/// Interval at which a silenced link checks whether it is silenced still.
const CHECK_PERIOD: Duration = Duration::from_millis(5);

/// Forwards data between processes and router.
pub(crate) struct Proxy {
    /// Endpoint for the processes.
    pub endpoint: Endpoint,
    port: u16,
    links: Arc<Mutex<Vec<VirtualLink>>>,
}

/// A connection of one process.
struct VirtualLink {
    /// The process's own port.
    port: u16,
    ends: [TcpStream; 2],
    is_silent: Arc<AtomicBool>,
}

impl Proxy {
    /// Listens at a free port, and forwards every connection to the router at `router_port` of this machine.
    ///
    /// # Panics
    /// When there is no free port.
    #[must_use]
    pub(crate) fn open(router_port: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let port = listener
            .local_addr()
            .expect("a bound socket has an address")
            .port();
        let links = Arc::<Mutex<Vec<VirtualLink>>>::default();
        let laid = Arc::clone(&links);
        thread::spawn(move || {
            for process in listener.incoming().flatten() {
                // Without a router the connection is closed; the process will try again.
                let Ok(router) = TcpStream::connect(("127.0.0.1", router_port)) else {
                    continue;
                };
                if let Some(link) = lay(process, router) {
                    let mut laid = laid.lock().unwrap_or_else(PoisonError::into_inner);
                    laid.push(link);
                }
            }
        });
        Self {
            endpoint: Endpoint::loopback(port),
            port,
            links,
        }
    }

    /// Cuts the links of a process; returns their number.
    pub(crate) fn cut(&self, pid: u32) -> usize {
        self.each(pid, |link| {
            link.ends
                .iter()
                .for_each(|end| drop(end.shutdown(Shutdown::Both)))
        })
    }

    /// Silences a process's links, or ends that; returns their number.
    pub(crate) fn silence(&self, pid: u32, is_silent: bool) -> usize {
        self.each(pid, |link| {
            link.is_silent.store(is_silent, Ordering::Relaxed)
        })
    }

    fn each(&self, pid: u32, act: impl Fn(&VirtualLink)) -> usize {
        let ports = ports_of(pid, self.port);
        let links = self.links.lock().unwrap_or_else(PoisonError::into_inner);
        links
            .iter()
            .filter(|link| ports.contains(&link.port))
            .map(act)
            .count()
    }
}

fn lay(process: TcpStream, router: TcpStream) -> Option<VirtualLink> {
    let port = process.peer_addr().ok()?.port();
    let is_silent = Arc::<AtomicBool>::default();
    for end in [&process, &router] {
        end.set_nodelay(true).ok()?;
    }
    let ways = [(&process, &router), (&router, &process)];
    for (from, to) in ways {
        let (from, to, is_silent) = (
            from.try_clone().ok()?,
            to.try_clone().ok()?,
            Arc::clone(&is_silent),
        );
        thread::spawn(move || pass_on(from, to, &is_silent));
    }
    Some(VirtualLink {
        port,
        ends: [process, router],
        is_silent,
    })
}

/// One direction, until either end is closed.
fn pass_on(mut from: TcpStream, mut to: TcpStream, is_silent: &AtomicBool) {
    let mut bytes = vec![0; 1 << 16];
    loop {
        let count = match from.read(&mut bytes) {
            Ok(0) | Err(_) => break,
            Ok(count) => count,
        };
        while is_silent.load(Ordering::Relaxed) {
            thread::sleep(CHECK_PERIOD);
        }
        if to.write_all(&bytes[..count]).is_err() {
            break;
        }
    }
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}

/// Own ports of a process's connections to `port` of this machine.
fn ports_of(pid: u32, port: u16) -> BTreeSet<u16> {
    let links = fs::read_dir(format!("/proc/{pid}/fd"))
        .into_iter()
        .flatten()
        .flatten();
    let sockets: BTreeSet<String> = links
        .filter_map(|entry| fs::read_link(entry.path()).ok())
        .filter_map(|link| {
            Some(
                link.to_str()?
                    .strip_prefix("socket:[")?
                    .strip_suffix(']')?
                    .to_owned(),
            )
        })
        .collect();
    let table = fs::read_to_string(format!("/proc/{pid}/net/tcp")).unwrap_or_default();
    let port_of = |address: &str| u16::from_str_radix(address.split_once(':')?.1, 16).ok();
    let own_port = |line: &str| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let is_his = sockets.contains(*fields.get(9)?) && port_of(fields[2])? == port;
        is_his.then(|| port_of(fields[1])).flatten()
    };
    table.lines().filter_map(own_port).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A router that echoes everything.
    fn echo() -> u16 {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        thread::spawn(move || {
            for mut stream in listener.incoming().flatten() {
                thread::spawn(move || {
                    let mut back = stream.try_clone().unwrap();
                    let _ = std::io::copy(&mut stream, &mut back);
                });
            }
        });
        port
    }

    #[test]
    fn virtual_links_forward_are_silenced_and_are_cut() {
        let proxy = Proxy::open(echo());
        let mut client = TcpStream::connect(("127.0.0.1", proxy.port)).unwrap();
        let mut answer = [0; 2];
        client.write_all(b"hi").unwrap();
        client.read_exact(&mut answer).unwrap();
        assert_eq!(&answer, b"hi");
        let own = std::process::id();
        assert_eq!((proxy.silence(own, true), proxy.silence(1, true)), (1, 0));
        client.write_all(b"ho").unwrap();
        client
            .set_read_timeout(Some(Duration::from_millis(100)))
            .unwrap();
        assert!(client.read_exact(&mut answer).is_err());
        proxy.silence(own, false);
        client
            .set_read_timeout(Some(Duration::from_secs(20)))
            .unwrap();
        client.read_exact(&mut answer).unwrap();
        assert_eq!(&answer, b"ho");
        assert_eq!(proxy.cut(own), 1);
        assert_eq!(client.read(&mut answer).unwrap_or(0), 0);
    }
}
