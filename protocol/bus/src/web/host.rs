//! Host-name check of a server on the loopback, against DNS rebinding.
//!
//! A page on the Internet may map its own name to the address 127.0.0.1 and make the browser read the content of this
//! server (DNS rebinding). The browser then requests that name.

use std::net::{IpAddr, SocketAddr};

use hyper::Uri;
use hyper::header::{HOST, HeaderMap};
use hyper::http::uri::Authority;

/// Checks the host names of a request at `local`, this end of the connection. Over the loopback the allowed names are
/// `localhost`, a loopback address or that of `local`, with any port, as tunnels have their own. Other addresses are
/// not checked: their names are unknown here.
///
/// # Errors
/// The name that is not allowed.
pub(super) fn check(local: SocketAddr, uri: &Uri, headers: &HeaderMap) -> Result<(), String> {
    if !local.ip().is_loopback() {
        return Ok(());
    }
    let named = headers
        .get_all(HOST)
        .iter()
        .map(|host| String::from_utf8_lossy(host.as_bytes()).into_owned());
    let authority = uri.authority().map(ToString::to_string);
    let mut requested = authority.into_iter().chain(named);
    requested
        .find(|name| !is_here(name, local.ip()))
        .map_or(Ok(()), Err)
}

fn is_here(name: &str, local: IpAddr) -> bool {
    let Ok(authority) = name.parse::<Authority>() else {
        return false;
    };
    let host = authority.host();
    let address = host
        .strip_prefix('[')
        .and_then(|host| host.strip_suffix(']'))
        .unwrap_or(host);
    let is_address = address
        .parse()
        .is_ok_and(|address: IpAddr| address.is_loopback() || address == local);
    is_address || host.eq_ignore_ascii_case("localhost")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn is_served(local: &str, uri: &str, host: &str) -> bool {
        let headers = HeaderMap::from_iter([(HOST, host.parse().unwrap())]);
        check(local.parse().unwrap(), &uri.parse().unwrap(), &headers).is_ok()
    }

    #[test]
    fn over_the_loopback_only_names_of_the_loopback_are_served() {
        for host in [
            "localhost:8088",
            "LOCALHOST",
            "127.0.0.1:8088",
            "[::1]:8088",
            "127.0.0.1:9000",
        ] {
            assert!(
                is_served("127.0.0.1:8088", "/", host) && is_served("[::1]:8088", "/", host),
                "{host}"
            );
        }
        for host in [
            "evil.example:8088",
            "evil.example",
            "localhost.evil.example",
            "10.0.0.1:8088",
            "",
            "[::1",
        ] {
            assert!(!is_served("127.0.0.1:8088", "/", host), "{host}");
            assert!(is_served("10.0.0.1:8088", "/", host), "{host}");
        }
        assert!(!is_served(
            "127.0.0.1:8088",
            "http://evil.example/",
            "localhost"
        ));
    }

    #[test]
    fn all_names_are_checked_and_none_is_allowed() {
        let local = "127.0.0.1:8088".parse().unwrap();
        let mut headers = HeaderMap::new();
        // HTTP/1.0 has none, and no browser uses it.
        assert_eq!(check(local, &Uri::from_static("/"), &headers), Ok(()));
        headers.append(HOST, "localhost".parse().unwrap());
        headers.append(HOST, "evil.example".parse().unwrap());
        assert_eq!(
            check(local, &Uri::from_static("/"), &headers),
            Err("evil.example".to_owned())
        );
    }
}
