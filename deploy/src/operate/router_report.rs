//! Report of a router: its CPU time, memory and refused requests, in a file that it writes and its run reads.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::Path;

use bus::RouterRejection;
use protocol::ProcessUsage;
use serde::{Deserialize, Serialize};
use support::atomic_file;

/// Report of a router and of those that it has replaced.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct RouterReport {
    /// CPU time of all, seconds.
    pub cpu_s: f64,
    /// Largest resident memory of one, bytes.
    pub peak_resident_bytes: u64,
    /// Refused requests.
    pub refused: Vec<RefusalCount>,
}

/// Refused requests of one kind of one peer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusalCount {
    /// Peer, reason and request.
    #[serde(flatten)]
    pub rejection: RouterRejection,
    /// Number of refusals.
    pub count: u64,
}

impl RouterReport {
    /// The report in a file; an empty one where it is missing.
    ///
    /// # Errors
    /// The error of the system; [`io::ErrorKind::InvalidData`] for other content.
    pub fn read(file: &Path) -> io::Result<Self> {
        match fs::read(file) {
            Ok(bytes) => Ok(serde_json::from_slice(&bytes)?),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(error),
        }
    }

    /// The sum of this report and of what a router has used and refused since.
    pub(crate) fn plus(
        &self,
        usage: &ProcessUsage,
        refused: &BTreeMap<RouterRejection, u64>,
    ) -> Self {
        let mut sum = refused.clone();
        for refusal in &self.refused {
            *sum.entry(refusal.rejection.clone()).or_default() += refusal.count;
        }
        let refused = sum.into_iter();
        Self {
            cpu_s: self.cpu_s + usage.cpu_s,
            peak_resident_bytes: self.peak_resident_bytes.max(usage.peak_resident_bytes),
            refused: refused
                .map(|(rejection, count)| RefusalCount { rejection, count })
                .collect(),
        }
    }

    /// Writes the report.
    ///
    /// # Errors
    /// The error of the system.
    pub(crate) fn write(&self, file: &Path) -> io::Result<()> {
        atomic_file::write_volatile(file, serde_json::to_vec(self)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_replaced_router_stays_in_the_report() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("router.json");
        let before = RouterReport::read(&file).unwrap();
        assert_eq!(before, RouterReport::default());
        let put = RouterRejection {
            peer: "agent-1".into(),
            reason: "access-control".into(),
            message: "put".into(),
        };
        let usage = ProcessUsage {
            cpu_s: 1.5,
            resident_bytes: 1 << 20,
            peak_resident_bytes: 2 << 20,
            threads: vec![],
        };
        let counts = BTreeMap::from([(put.clone(), 3)]);
        before.plus(&usage, &counts).write(&file).unwrap();
        let report = RouterReport::read(&file).unwrap().plus(&usage, &counts);
        let sum = RefusalCount {
            rejection: put,
            count: 6,
        };
        assert_eq!((report.cpu_s, report.peak_resident_bytes), (3.0, 2 << 20));
        assert_eq!(report.refused, [sum]);
        fs::write(&file, "{").unwrap();
        assert!(RouterReport::read(&file).is_err());
    }
}
