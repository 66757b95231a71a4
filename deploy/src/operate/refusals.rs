//! Refusals file: the requests that a router refused, which it writes and its run reads.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;

use bus::RouterRejection;
use serde::{Deserialize, Serialize};
use support::atomic_file;

/// Refused requests of one kind of one peer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusalCount {
    /// Peer, reason and request.
    #[serde(flatten)]
    pub rejection: RouterRejection,
    /// Number of refusals.
    pub count: u64,
}

/// Writes the counts of a router, and those of `before`, of the router that it replaces.
///
/// # Errors
/// The error of the system.
pub(crate) fn write(
    file: &Path,
    before: &[RefusalCount],
    counts: &BTreeMap<RouterRejection, u64>,
) -> io::Result<()> {
    let mut sum = counts.clone();
    for refusal in before {
        *sum.entry(refusal.rejection.clone()).or_default() += refusal.count;
    }
    let refusals = sum.into_iter();
    let refusals = refusals.map(|(rejection, count)| RefusalCount { rejection, count });
    let text = serde_json::to_vec(&refusals.collect::<Vec<_>>())?;
    atomic_file::write_volatile(file, text)
}

/// The refusals in a file; none where it is missing.
///
/// # Errors
/// The error of the system; [`io::ErrorKind::InvalidData`] for other content.
pub fn read(file: &Path) -> io::Result<Vec<RefusalCount>> {
    match fs::read(file) {
        Ok(bytes) => Ok(serde_json::from_slice(&bytes)?),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Vec::new()),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_of_a_replaced_router_are_added() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("refusals.json");
        assert_eq!(read(&file).unwrap(), []);
        let put = RouterRejection {
            peer: "agent-1".into(),
            reason: "access-control".into(),
            message: "put".into(),
        };
        let counts = BTreeMap::from([(put.clone(), 3)]);
        write(&file, &[], &counts).unwrap();
        let before = read(&file).unwrap();
        write(&file, &before, &counts).unwrap();
        let sum = RefusalCount {
            rejection: put,
            count: 6,
        };
        assert_eq!(read(&file).unwrap(), [sum]);
        fs::write(&file, "[{").unwrap();
        assert!(read(&file).is_err());
    }
}
