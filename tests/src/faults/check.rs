//! Requirements on a fleet under faults, checked on its results.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use serde_json::Value;

/// Fields of an ego's result that the checks need.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Result {
    /// Epoch of the ego's instance.
    pub epoch: u64,
    /// Time of publication, milliseconds on the Unix clock.
    pub published_ms: u64,
    /// Vehicles whose data are in it.
    pub fused: Vec<String>,
}

/// Results of a run, read while they are written.
#[derive(Debug)]
pub struct Results {
    file: PathBuf,
    /// Bytes of complete lines that were read.
    read: u64,
    all: Vec<Result>,
}

impl Results {
    /// Of the run in `folder`.
    #[must_use]
    pub fn of(folder: &Path) -> Self {
        Self {
            file: folder.join("detections.jsonl"),
            read: 0,
            all: Vec::new(),
        }
    }

    /// All results so far.
    pub fn update(&mut self) -> &[Result] {
        let mut text = Vec::new();
        if let Ok(mut file) = File::open(&self.file) {
            // An incomplete line is read again next time.
            let _ = file
                .seek(SeekFrom::Start(self.read))
                .and_then(|_| file.read_to_end(&mut text));
        }
        let whole = text
            .iter()
            .rposition(|byte| *byte == b'\n')
            .map_or(0, |end| end + 1);
        self.read += whole as u64;
        let lines = text[..whole]
            .split(|byte| *byte == b'\n')
            .filter_map(|line| serde_json::from_slice(line).ok());
        self.all.extend(lines.filter_map(|line: Value| read(&line)));
        &self.all
    }
}

fn read(line: &Value) -> Option<Result> {
    let fused = line["fused"]
        .as_array()?
        .iter()
        .filter_map(|fused| Some(fused["cav"].as_str()?.to_owned()));
    let (epoch, published_ms) = (
        line["epoch"].as_u64()?,
        line["publish_nanos"].as_u64()? / 1_000_000,
    );
    Some(Result {
        epoch,
        published_ms,
        fused: fused.collect(),
    })
}

/// Findings over many faults.
#[derive(Debug, Clone, Default)]
pub struct Findings {
    /// Longest time between two results of one instance of the ego while no fault affected its inputs, milliseconds.
    pub longest_gap_ms: u64,
    /// Those above two periods, milliseconds, and the fault at that time.
    pub gaps: Vec<(u64, String)>,
    /// From the first message of a restarted vehicle to the first result with its data, milliseconds.
    pub fused_again_ms: Vec<u64>,
}

impl Findings {
    /// Adds the gaps between the results from `from_ms` to `to_ms`, during the fault `what`.
    pub(crate) fn add_gaps(
        &mut self,
        results: &[Result],
        [from_ms, to_ms]: [u64; 2],
        period_ms: u64,
        what: &str,
    ) {
        let within = |result: &&Result| (from_ms..=to_ms).contains(&result.published_ms);
        let results: Vec<&Result> = results.iter().filter(within).collect();
        for pair in results
            .windows(2)
            .filter(|pair| pair[0].epoch == pair[1].epoch)
        {
            let gap_ms = pair[1].published_ms.saturating_sub(pair[0].published_ms);
            self.longest_gap_ms = self.longest_gap_ms.max(gap_ms);
            if gap_ms > 2 * period_ms {
                self.gaps.push((gap_ms, what.to_owned()));
            }
        }
    }

    /// Adds the times of the first message of restarted vehicles, by vehicle.
    pub(crate) fn add_returns(
        &mut self,
        results: &[Result],
        first_message_ms: &BTreeMap<String, u64>,
    ) {
        for (cav, message_ms) in first_message_ms {
            let fused = results
                .iter()
                .find(|result| result.published_ms >= *message_ms && result.fused.contains(cav))
                .map(|result| result.published_ms - message_ms);
            self.fused_again_ms.push(fused.unwrap_or(u64::MAX));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn result(epoch: u64, published_ms: u64, fused: &[&str]) -> Result {
        Result {
            epoch,
            published_ms,
            fused: fused.iter().map(|cav| (*cav).to_owned()).collect(),
        }
    }

    #[test]
    fn gaps_count_within_one_instance() {
        let results = [
            result(1, 0, &[]),
            result(1, 100, &[]),
            result(1, 350, &[]),
            result(2, 900, &[]),
            result(2, 1000, &[]),
        ];
        let mut findings = Findings::default();
        findings.add_gaps(&results, [0, 2000], 100, "a fault");
        assert_eq!(
            (findings.longest_gap_ms, findings.gaps),
            (250, vec![(250, "a fault".into())])
        );
        let mut later = Findings::default();
        later.add_gaps(&results, [300, 2000], 100, "a fault");
        assert_eq!((later.longest_gap_ms, later.gaps), (100, vec![]));
    }

    #[test]
    fn a_return_is_timed_from_the_first_message() {
        let results = [
            result(1, 100, &["20"]),
            result(1, 200, &[]),
            result(1, 700, &["20"]),
        ];
        let mut findings = Findings::default();
        findings.add_returns(
            &results,
            &BTreeMap::from([("20".into(), 150), ("30".into(), 150)]),
        );
        assert_eq!(findings.fused_again_ms, [550, u64::MAX]);
    }
}
