//! Period of a scene: one for the report of a data set, the replay, the forecast of a run and simulation time.

use support::{rounding, statistics};

use super::Tick;

/// Time from one tick of a scene to the next, nanoseconds: the median of the steps above 0, so that neither a pause nor
/// an odd step decides. A step back, in a faulty data set, is none. `None` without any step.
pub fn period_nanos(ticks: &[Tick]) -> Option<u64> {
    let steps = ticks.array_windows();
    let steps = steps.map(|[tick, next]| next.capture_nanos.saturating_sub(tick.capture_nanos));
    let steps = steps.filter(|step| *step > 0).map(|step| step as f64);
    statistics::median(&Vec::from_iter(steps)).map(rounding::to_u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_short_step_a_pause_and_equal_times_do_not_change_the_period() {
        let period_ms = |captures_ms: &[u64]| {
            let ticks = captures_ms.iter();
            let ticks = ticks.map(|capture_ms| Tick::new("", capture_ms * 1_000_000));
            period_nanos(&Vec::from_iter(ticks)).map(|nanos| nanos / 1_000_000)
        };
        assert_eq!(period_ms(&[0, 100, 200, 300]), Some(100));
        assert_eq!(period_ms(&[0, 100, 110, 200, 300]), Some(95));
        assert_eq!(period_ms(&[0, 100, 110, 210, 310, 410]), Some(100));
        assert_eq!(period_ms(&[0, 100, 200, 9000, 9100]), Some(100));
        assert_eq!(period_ms(&[0, 0, 0, 0, 100, 200]), Some(100));
        assert_eq!(period_ms(&[500, 0, 100]), Some(100));
        assert_eq!(period_ms(&[7, 7]), None);
        assert_eq!(period_ms(&[7]), None);
    }
}
