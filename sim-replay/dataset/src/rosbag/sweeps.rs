//! Sweeps of one topic of a bag: those that belong together by frame and clock.

use std::collections::BTreeMap;
use std::path::Path;

use super::clock::longest_steady;
use super::contents::CloudStamp;
use crate::ReadError;

/// Finding about messages that are out of order.
pub(super) const STRAY: &str = "have a stamp that is not between those around it";

/// Sweeps of a topic, with increasing stamps.
#[derive(Debug)]
pub(super) struct SweepTopic {
    pub(super) topic: String,
    /// Frame of the points.
    pub(super) frame: String,
    pub(super) sweeps: Vec<CloudStamp>,
    /// Poses that were recorded outside of these times (nanoseconds, exclusive) belong to another setting of the clock.
    pub(super) recorded_nanos: (Option<u64>, Option<u64>),
    /// Sweeps that were left out.
    pub(super) problems: Vec<ReadError>,
}

impl SweepTopic {
    /// The sweeps of `topic` in the order in which they were recorded. Sweeps without a stamp, in another frame than most,
    /// or out of order are left out and counted.
    pub(super) fn new(path: &Path, topic: &str, clouds: &[CloudStamp]) -> Self {
        let frame = most_frequent(clouds.iter().map(|cloud| cloud.frame.as_str()));
        let (stamped, unstamped): (Vec<&CloudStamp>, Vec<&CloudStamp>) =
            clouds.iter().partition(|cloud| cloud.nanos > 0);
        let (of_frame, others): (Vec<&CloudStamp>, Vec<&CloudStamp>) =
            stamped.into_iter().partition(|cloud| cloud.frame == frame);
        let stamps: Vec<u64> = of_frame.iter().map(|cloud| cloud.nanos).collect();
        let steady = longest_steady(&stamps);
        let other_frame = format!("are not in frame {frame}, as most are");
        let other_part = "are before or after the clock of their stamps was set back";
        let mut problems = Vec::new();
        for (count, reason) in [
            (unstamped.len(), "have the stamp 0"),
            (others.len(), other_frame.as_str()),
            (steady.strays, STRAY),
            (steady.of_other_parts, other_part),
        ] {
            if count > 0 {
                let all = clouds.len();
                let reason = format!("{topic}: {count} of {all} sweeps {reason}: left out");
                problems.push(ReadError::malformed(path, reason));
            }
        }
        let [after, before] = [steady.bounds.0, steady.bounds.1]
            .map(|index| Some(of_frame.get(index?)?.recorded_nanos));
        Self {
            topic: topic.to_owned(),
            frame,
            sweeps: (steady.kept)
                .iter()
                .filter_map(|&index| of_frame.get(index).map(|cloud| (*cloud).clone()))
                .collect(),
            recorded_nanos: (after, before),
            problems,
        }
    }

    /// Bytes of its sweeps.
    pub(super) fn bytes(&self) -> usize {
        self.sweeps.iter().map(|sweep| sweep.bytes).sum()
    }

    /// True for poses of the clock by which the sweeps are stamped.
    pub(super) fn is_of_its_clock(&self, recorded_nanos: u64) -> bool {
        let (after, before) = self.recorded_nanos;
        after.is_none_or(|after| recorded_nanos > after)
            && before.is_none_or(|before| recorded_nanos < before)
    }
}

/// The most frequent text, the first in text order of several.
pub(super) fn most_frequent<'a>(texts: impl Iterator<Item = &'a str>) -> String {
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    texts.for_each(|text| *counts.entry(text).or_default() += 1);
    let most = counts.into_iter().rev().max_by_key(|(_, count)| *count);
    most.map_or(String::new(), |(text, _)| text.to_owned())
}
