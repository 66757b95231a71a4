//! Plain-TCP clients of a QUIC-only router: closes their connections and counts them.

use std::net::{Shutdown, TcpListener};

use super::endpoint::Endpoint;

/// Maximum number of connections closed in one call, so that a flood does not block the caller; the system's backlog is
/// no larger.
const MAX_PER_CALL: usize = 1024;

/// Closes every TCP connection to the port at which a router listens over UDP, and counts them.
#[derive(Debug)]
pub(super) struct PlainTcp {
    listener: TcpListener,
    turned_away: u64,
}

impl PlainTcp {
    /// Listens at the address of a QUIC `router`; `None` if the router itself or another program uses TCP there.
    pub(super) fn beside(router: &Endpoint) -> Option<Self> {
        if !router.is_secured() {
            return None;
        }
        let bound = TcpListener::bind(router.address());
        let listener = bound.and_then(|listener| listener.set_nonblocking(true).map(|()| listener));
        match listener {
            Ok(listener) => Some(Self {
                listener,
                turned_away: 0,
            }),
            Err(error) => {
                tracing::info!("plain-TCP clients of {router} are not counted: {error}");
                None
            }
        }
    }

    /// Closes waiting connections without reading a byte. Returns their total number so far.
    pub(super) fn reject(&mut self) -> u64 {
        // Whatever the error, the other connections can wait until the next call.
        let waiting = (0..MAX_PER_CALL).map_while(|_| self.listener.accept().ok());
        for (client, _) in waiting {
            let _ = client.shutdown(Shutdown::Both);
            self.turned_away += 1;
        }
        self.turned_away
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;
    use std::net::TcpStream;

    use super::*;

    #[test]
    fn tcp_clients_are_disconnected_and_counted() {
        let free = TcpListener::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap();
        let router = Endpoint::loopback(free.port());
        assert!(PlainTcp::beside(&router).is_none(), "it takes TCP itself");
        let mut listener = PlainTcp::beside(&router.secured()).unwrap();
        assert_eq!(listener.reject(), 0);
        let mut clients = [(); 3].map(|()| TcpStream::connect(free).unwrap());
        assert_eq!(listener.reject(), 3);
        for client in &mut clients {
            assert_eq!(client.read(&mut [0; 1]).unwrap(), 0, "nothing is sent");
        }
        assert!(
            PlainTcp::beside(&router.secured()).is_none(),
            "the port is taken"
        );
    }
}
