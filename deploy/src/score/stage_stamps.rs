//! Time at which a frame passed each stage, from the capture to the detections.

use protocol::StageTiming;

/// Milliseconds after the publication of the tick; each is `None` if unknown.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StageStamps {
    /// Time of publication of the tick, Unix nanoseconds: origin of all others.
    pub began_nanos: Option<u64>,
    /// Publication of the pose by the ego's agent; unknown, as the next, where the agent has another clock.
    pub posed_ms: Option<f64>,
    /// Publication of its feature map, boxes or points.
    pub published_ms: Option<f64>,
    /// Arrival of these at the ego-fuser.
    pub arrived_ms: Option<f64>,
    /// End of the wait for neighbours.
    pub decided_ms: Option<f64>,
    /// Detections computed.
    pub fused_ms: Option<f64>,
    /// Publication of the detections.
    pub detected_ms: Option<f64>,
}

impl StageStamps {
    /// Stamps of a tick with publication times, Unix nanoseconds: of the tick `began_nanos`, of the ego's pose
    /// `posed_nanos`, of its detections `detected_nanos`. `stages` are the durations of the ego's stages, without
    /// `transport` where its agent has another clock.
    pub(crate) fn of(
        began_nanos: u64,
        posed_nanos: Option<u64>,
        detected_nanos: u64,
        stages: &[StageTiming],
    ) -> Self {
        let fusing = stages
            .iter()
            .filter(|timing| !matches!(timing.stage.as_str(), "transport" | "wait" | "send"));
        let fusing_ms: f64 = fusing.map(|timing| timing.nanos as f64 / 1e6).sum();
        let detected = ms_between(began_nanos, detected_nanos);
        // The ego's stages follow each other without a gap: counted back from the end.
        let fused = before_stage(stages, "send", Some(detected));
        let decided = fused.map(|fused| fused - fusing_ms);
        let arrived = before_stage(stages, "wait", decided);
        let published = before_stage(stages, "transport", arrived);
        // Of one clock with the publication.
        let posed = published.and(posed_nanos);
        Self {
            began_nanos: Some(began_nanos),
            posed_ms: posed.map(|posed_nanos| ms_between(began_nanos, posed_nanos)),
            published_ms: published,
            arrived_ms: arrived,
            decided_ms: decided,
            fused_ms: fused,
            detected_ms: Some(detected),
        }
    }
}

/// Time at which a stage began that ended at `end_ms`; `None` without one.
fn before_stage(stages: &[StageTiming], name: &str, end_ms: Option<f64>) -> Option<f64> {
    let stage = stages.iter().find(|timing| timing.stage == name)?;
    Some(end_ms? - stage.nanos as f64 / 1e6)
}

/// Milliseconds from one time to another.
pub(crate) fn ms_between(began_nanos: u64, nanos: u64) -> f64 {
    // Signed: the two times may be of two clocks.
    (nanos as f64 - began_nanos as f64) / 1e6
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn stages_are_laid_out_from_the_end() {
        let stages = [
            ("transport", 4),
            ("wait", 20),
            ("warp", 3),
            ("fuse", 7),
            ("send", 1),
        ]
        .map(|(name, ms)| StageTiming::new(name, Duration::from_millis(ms)));
        let stamps = StageStamps::of(1_000_000_000, Some(1_030_000_000), 1_100_000_000, &stages);
        let expected = StageStamps {
            began_nanos: Some(1_000_000_000),
            posed_ms: Some(30.0),
            published_ms: Some(65.0),
            arrived_ms: Some(69.0),
            decided_ms: Some(89.0),
            fused_ms: Some(99.0),
            detected_ms: Some(100.0),
        };
        assert_eq!(stamps, expected);
    }

    #[test]
    fn times_of_an_agent_with_another_clock_are_absent() {
        let stages = [("wait", 20), ("fuse", 7), ("send", 1)]
            .map(|(name, ms)| StageTiming::new(name, Duration::from_millis(ms)));
        for posed_nanos in [4_030_000_000, 10_000_000] {
            let stamps = StageStamps::of(1_000_000_000, Some(posed_nanos), 1_100_000_000, &stages);
            assert_eq!((stamps.posed_ms, stamps.published_ms), (None, None));
            assert_eq!(stamps.arrived_ms, Some(72.0));
        }
    }

    #[test]
    fn stages_that_an_ego_does_not_report_are_absent() {
        let stamps = StageStamps::of(0, None, 5_000_000, &[]);
        assert_eq!(
            stamps,
            StageStamps {
                began_nanos: Some(0),
                detected_ms: Some(5.0),
                ..StageStamps::default()
            }
        );
    }
}
