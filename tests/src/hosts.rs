//! Hosts on one machine: network namespaces around a router's, a virtual link from it to each.

use std::io;
use std::net::Ipv4Addr;
use std::process::{Command, Stdio};

/// Namespaces and virtual links, removed when dropped.
pub struct Hosts {
    prefix: String,
    names: Vec<&'static str>,
}

impl Hosts {
    /// Lays a virtual link from the host `router` to each of `others`. The first has 10.78.1.1 at the router's end and
    /// 10.78.1.2 at its own, the second 10.78.2.1 and 10.78.2.2.
    ///
    /// # Errors
    /// The error of `ip` where this is not allowed.
    pub fn lay(others: &[&'static str]) -> io::Result<Self> {
        // Names with the id of this process: two tests at once have separate hosts. Names of interfaces have 15
        // characters at most.
        let prefix = format!("v{}", std::process::id());
        let mut hosts = Self {
            prefix,
            names: Vec::new(),
        };
        for name in ["router"].iter().chain(others) {
            ip(&format!("netns add {}", hosts.namespace(name)))?;
            hosts.names.push(name);
            ip(&format!("-n {} link set lo up", hosts.namespace(name)))?;
        }
        for (index, name) in others.iter().enumerate() {
            let (router, other) = (hosts.namespace("router"), hosts.namespace(name));
            let (near, far) = (
                format!("{}r{index}", hosts.prefix),
                format!("{}h{index}", hosts.prefix),
            );
            ip(&format!(
                "link add {near} netns {router} type veth peer name {far} netns {other}"
            ))?;
            for (host, end, address) in [
                (&router, &near, router_address(index)),
                (&other, &far, address(index)),
            ] {
                ip(&format!("-n {host} address add {address}/24 dev {end}"))?;
                ip(&format!("-n {host} link set {end} up"))?;
            }
        }
        Ok(hosts)
    }

    /// A command that runs on a host.
    #[must_use]
    pub fn command(&self, host: &str, program: &std::path::Path) -> Command {
        let mut command = Command::new("ip");
        command
            .args(["netns", "exec", &self.namespace(host)])
            .arg(program)
            .stdin(Stdio::null());
        command
    }

    /// Cuts the virtual link to the other host of this index: nothing crosses it, and neither end is told.
    ///
    /// # Errors
    /// The error of `ip`.
    pub fn cut(&self, index: usize) -> io::Result<()> {
        let host = self
            .names
            .get(index + 1)
            .map_or_else(String::new, |name| self.namespace(name));
        ip(&format!("-n {host} link set {}h{index} down", self.prefix))
    }

    fn namespace(&self, host: &str) -> String {
        format!("{}-{host}", self.prefix)
    }
}

/// The router's address on the virtual link to the other host of this index.
#[must_use]
pub fn router_address(index: usize) -> Ipv4Addr {
    Ipv4Addr::new(10, 78, index as u8 + 1, 1)
}

fn address(index: usize) -> Ipv4Addr {
    Ipv4Addr::new(10, 78, index as u8 + 1, 2)
}

impl Drop for Hosts {
    fn drop(&mut self) {
        for name in &self.names {
            let _ = Command::new("ip")
                .args(["netns", "del", &self.namespace(name)])
                .stderr(Stdio::null())
                .status();
        }
    }
}

fn ip(arguments: &str) -> io::Result<()> {
    let output = Command::new("ip").args(arguments.split(' ')).output()?;
    if output.status.success() {
        return Ok(());
    }
    Err(io::Error::other(format!(
        "ip {arguments}: {}",
        String::from_utf8_lossy(&output.stderr).trim()
    )))
}
