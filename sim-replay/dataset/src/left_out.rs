//! Account of data left out while reading: counts by kind, and the findings behind them.

use std::collections::BTreeSet;
use std::fmt;

use serde::{Deserialize, Serialize};

use super::problem::reasons;
use super::{LoadedTick, Problem, findings};
use crate::average_precision::Scorer;
use crate::frame::Frame;
use support::cli::Outcome;
use support::output;

/// Largest number of findings kept; further ones are only counted.
const KEPT: usize = 1000;
/// Objects of which a network that works at all finds one: one with a recall of 5 % misses all so many in one of 60
/// evaluations.
const MISSED_OBJECTS: usize = 80;

/// Data left out while the frames of a data set were used.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LeftOut {
    /// Ticks of the ego without a result, because its own frame cannot be read.
    pub ticks: u64,
    /// Frames of other agents that cannot be read: the agent counts as absent there.
    pub frames: u64,
    /// Invalid objects and other parts of frames.
    pub parts: u64,
    /// Frames of other agents that do not exist at the ego's ticks, because they joined later or have left. Not a
    /// fault.
    pub absent_frames: u64,
    /// Frames that were read but could not be computed, of the ego or of other agents.
    #[serde(default)]
    pub failed: u64,
    /// Unused files and folders of the data set, found when it was opened.
    pub files: u64,
    problems: BTreeSet<Problem>,
    /// Implausible properties of the data that were used. Nothing was left out for them.
    #[serde(default)]
    findings: BTreeSet<Problem>,
}

impl LeftOut {
    /// Adds the findings of opening the data set.
    pub fn add_files<'a>(&mut self, problems: impl IntoIterator<Item = &'a super::ReadError>) {
        for problem in problems {
            self.files += 1;
            self.keep([Problem::from(problem)]);
        }
    }

    /// Adds findings about the data that are used ([`crate::findings`]).
    pub fn add_findings(&mut self, findings: impl IntoIterator<Item = Problem>) {
        self.findings.extend(findings);
    }

    /// Adds the missing and unreadable frames of a tick.
    pub fn add_tick(&mut self, loaded: &LoadedTick) {
        self.absent_frames += loaded.absent as u64;
        for (_, frame) in &loaded.frames {
            self.add_parts(frame);
        }
        for (agent, problem) in &loaded.unreadable {
            self.add_unreadable(*agent, problem.clone());
        }
    }

    /// Adds a frame that cannot be read; the ego is agent 0.
    pub fn add_unreadable(&mut self, agent: usize, problem: Problem) {
        if agent == 0 {
            self.ticks += 1;
        } else {
            self.frames += 1;
        }
        self.keep([problem]);
    }

    /// Adds a frame, named by scenario, tick and agent, that could not be computed.
    pub fn add_failed(&mut self, frame: &str, reason: &str) {
        self.failed += 1;
        self.keep([Problem {
            message: format!("{frame}: {reason}"),
            ..Problem::default()
        }]);
    }

    /// Adds a failure where all frames of a method together have no detection, though there are many objects.
    pub fn add_scores(&mut self, method: &str, scorer: &Scorer) {
        let found_none = scorer.tallies.iter().filter(|all| all.matched.is_empty());
        if let Some(objects) = found_none.map(|all| all.objects).max()
            && objects >= MISSED_OBJECTS
        {
            let reason = format!("no detection of {objects} objects: are these weights sound?");
            self.add_failed(&format!("method {method}, all frames"), &reason);
        }
    }

    /// Adds the parts left out of a frame.
    fn add_parts(&mut self, frame: &Frame) {
        self.parts += frame.problems.len() as u64;
        self.keep(frame.problems.iter().cloned());
    }

    /// Adds another account.
    pub fn merge(&mut self, other: &Self) {
        self.ticks += other.ticks;
        self.frames += other.frames;
        self.parts += other.parts;
        self.absent_frames += other.absent_frames;
        self.failed += other.failed;
        self.files += other.files;
        self.add_findings(other.findings.iter().cloned());
        self.keep(other.problems.iter().cloned());
    }

    /// True if nothing was lost. Absent agents are no loss.
    pub fn is_nothing(&self) -> bool {
        self.ticks + self.frames + self.parts + self.failed + self.files == 0
    }

    /// The findings without duplicates, at most 1,000.
    pub fn problems(&self) -> impl Iterator<Item = &Problem> {
        self.problems.iter()
    }

    /// [`reasons`] of the findings.
    pub fn reasons(&self) -> String {
        reasons(&self.problems)
    }

    /// Prints the findings to standard error; returns the outcome of a command that lost no other data.
    pub fn print(&self) -> Outcome {
        findings::note(&self.findings);
        self.problems()
            .for_each(|problem| output::note(format_args!("left out: {}", problem.message)));
        Outcome::of(!self.is_nothing())
    }

    fn keep(&mut self, problems: impl IntoIterator<Item = Problem>) {
        for problem in problems {
            if self.problems.len() < KEPT {
                self.problems.insert(problem);
            }
        }
    }
}

impl fmt::Display for LeftOut {
    /// One line, empty if nothing is missing.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counts = [
            (self.ticks, "ticks (the ego's frame cannot be used)"),
            (self.frames, "frames of other agents that cannot be read"),
            (self.parts, "objects or other parts of frames"),
            (
                self.failed,
                "frames that could not be computed, or methods without any detection",
            ),
            (self.files, "files or folders"),
        ];
        let counts = counts.into_iter().filter(|(count, _)| *count > 0);
        let left_out = counts.map(|(count, kind)| format!("{count} {kind}"));
        let left_out: Vec<String> = left_out.collect();
        if !left_out.is_empty() {
            write!(f, "left out: {}", left_out.join(", "))?;
        }
        if self.absent_frames > 0 {
            let separator = if left_out.is_empty() { "" } else { "; " };
            write!(f, "{separator}absent agents: {} frames", self.absent_frames)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use protocol::{Box3d, CavId, Detection, Handedness};

    use super::*;
    use crate::ground_truth::GroundTruth;

    fn problem(name: &str) -> Problem {
        Problem {
            path: name.into(),
            line: None,
            field: None,
            message: format!("{name}: cut off"),
        }
    }

    fn frame(problems: &[&str]) -> Frame {
        let problems = problems.iter().map(|name| problem(name)).collect();
        Frame {
            problems,
            ..Frame::empty(CavId::new("1").unwrap(), 0, Handedness::Right)
        }
    }

    #[test]
    fn losses_and_absent_frames_are_distinguished() {
        let mut left_out = LeftOut::default();
        let loaded = LoadedTick {
            frames: vec![(0, frame(&[]))],
            unreadable: vec![],
            absent: 2,
        };
        left_out.add_tick(&loaded);
        assert!(left_out.is_nothing());
        assert_eq!(left_out.to_string(), "absent agents: 2 frames");
        let loaded = LoadedTick {
            frames: vec![(1, frame(&["a.yaml", "b.yaml"]))],
            unreadable: vec![(0, problem("0.pcd")), (2, problem("2.pcd"))],
            absent: 0,
        };
        left_out.add_tick(&loaded);
        assert!(!left_out.is_nothing());
        assert_eq!(
            (
                left_out.ticks,
                left_out.frames,
                left_out.parts,
                left_out.problems().count()
            ),
            (1, 1, 2, 4)
        );
        let expected = "left out: 1 ticks (the ego's frame cannot be used), 1 frames of other agents that cannot be read, \
                        2 objects or other parts of frames; absent agents: 2 frames";
        assert_eq!(left_out.to_string(), expected);
    }

    #[test]
    fn a_method_without_a_detection_is_a_failure_where_there_are_many_objects() {
        let box3d = |x_m: f64| Box3d {
            center_m: [x_m, 0.0, 0.0],
            size_m: [4.0, 2.0, 1.5],
            heading_rad: 0.0,
        };
        let far = Detection {
            box3d: box3d(-90.0),
            score: 0.5,
            source: None,
        };
        for (objects, detections, expected) in [
            (79, vec![], None),
            (
                80,
                vec![],
                Some(
                    "method max, all frames: no detection of 80 objects: are these weights sound?",
                ),
            ),
            (80, vec![far], None),
        ] {
            let mut scorer = Scorer::default();
            let boxes = (0..objects).map(|place| box3d(10.0 * f64::from(place)));
            scorer.add(&detections, &GroundTruth::of_boxes(boxes));
            let mut left_out = LeftOut::default();
            left_out.add_scores("max", &scorer);
            let found = left_out.problems().next();
            assert_eq!(found.map(|problem| problem.message.as_str()), expected);
            assert_eq!(left_out.is_nothing(), expected.is_none());
        }
    }

    #[test]
    fn the_same_finding_is_kept_once_and_counted_each_time() {
        let mut left_out = LeftOut::default();
        (0..3).for_each(|_| left_out.add_parts(&frame(&["a.yaml"])));
        assert_eq!((left_out.parts, left_out.problems().count()), (3, 1));
        let mut both = left_out.clone();
        both.merge(&left_out);
        assert_eq!((both.parts, both.problems().count()), (6, 1));
    }
}
