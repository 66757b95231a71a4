//! Who speaks plain TCP where a router takes QUIC alone: without a word of ours it would meet a closed port.

use std::net::{Shutdown, TcpListener};

use super::endpoint::Endpoint;

/// Turned away in one go, so that a flood of them keeps nobody from his work; the system keeps no more waiting.
const MOST_AT_ONCE: usize = 1024;

/// Turns away everyone who comes over TCP to the port at which a router listens over UDP, and counts them.
#[derive(Debug)]
pub(super) struct PlainTcp {
    listener: TcpListener,
    turned_away: u64,
}

impl PlainTcp {
    /// Listens where `router` takes QUIC; nowhere where it takes TCP itself, or another program does.
    pub(super) fn beside(router: &Endpoint) -> Option<Self> {
        if !router.is_secured() {
            return None;
        }
        let bound = TcpListener::bind(router.address());
        let listener = bound.and_then(|listener| listener.set_nonblocking(true).map(|()| listener));
        match listener {
            Ok(listener) => Some(Self { listener, turned_away: 0 }),
            Err(error) => {
                tracing::info!("who comes to {router} over plain TCP is not counted: {error}");
                None
            }
        }
    }

    /// Turns away those who wait, without reading a byte of theirs. How many it were so far.
    pub(super) fn reject(&mut self) -> u64 {
        for _ in 0..MOST_AT_ONCE {
            // Whatever the error, the others can wait until the next time.
            let Ok((stranger, _)) = self.listener.accept() else { break };
            let _ = stranger.shutdown(Shutdown::Both);
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
    fn who_comes_over_tcp_is_turned_away_and_counted() {
        let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
        let router = Endpoint::loopback(free.port());
        assert!(PlainTcp::beside(&router).is_none(), "it takes TCP itself");
        let mut door = PlainTcp::beside(&router.secured()).unwrap();
        assert_eq!(door.reject(), 0);
        let mut strangers = [(); 3].map(|()| TcpStream::connect(free).unwrap());
        assert_eq!(door.reject(), 3);
        for stranger in &mut strangers {
            assert_eq!(stranger.read(&mut [0; 1]).unwrap(), 0, "nothing is said");
        }
        assert!(PlainTcp::beside(&router.secured()).is_none(), "the port is taken");
    }
}
