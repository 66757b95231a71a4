//! Router watch: the failure of a run's router, its outages, and times in which the run itself was suspended.

use std::time::{Duration, Instant};

use bus::RouterProbe;

use crate::score::ScorerNode;

/// Longest time without a message through the router.
pub(crate) const LIMIT: Duration = Duration::from_secs(2);

/// Longest time until the clients of a replaced router are back: over QUIC they notice its end after 10 to 30 s.
const RETURN_LIMIT: Duration = Duration::from_secs(30);

/// Shortest time without a router: one that has ended is started again after 0.2 s.
const SHORTEST: Duration = Duration::from_millis(150);

/// A change of the state of the router or of the run.
#[derive(Debug, PartialEq)]
pub(crate) enum RouterFinding {
    /// A line for the terminal: the router is gone, or back, or the run was suspended.
    Line(String),
    /// The router of this run is there and passes no message, with the reason: it has to be replaced.
    Hung(String),
}

/// Reason for the failure of a router through which nothing came for this time.
pub(crate) fn in_words(silence: Duration) -> String {
    let seconds = silence.as_secs_f64();
    format!("nothing came through it for {seconds:.1} s")
}

/// Times of one kind.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct TimeSum {
    count: usize,
    sum: Duration,
}

impl TimeSum {
    pub(crate) fn add(&mut self, times: impl IntoIterator<Item = Duration>) {
        for time in times {
            self.count += 1;
            self.sum += time;
        }
    }

    /// `router gone for 4.0 s`, with the number of times where there were several.
    pub(crate) fn sentence(&self, what: &str) -> Option<String> {
        let times = match self.count {
            0 => return None,
            1 => String::new(),
            count => format!(" in all ({count} times)"),
        };
        Some(format!("{what} for {:.1} s{times}", self.sum.as_secs_f64()))
    }
}

/// Watch of the router of a run.
#[derive(Default)]
pub(crate) struct RouterWatch {
    /// Absent where no second session could be opened.
    probe: Option<RouterProbe>,
    /// True if the router is of this run, which can replace it.
    is_own: bool,
    /// When it was last replaced, or restarted after an end of its own.
    replaced: Option<Instant>,
    looked: Option<Instant>,
    gone_since: Option<Instant>,
    outages: TimeSum,
    pauses: TimeSum,
}

impl RouterWatch {
    /// A watch over the router that `probe` reaches.
    pub(crate) fn new(probe: Option<RouterProbe>, is_own: bool) -> Self {
        Self {
            probe,
            is_own,
            ..Self::default()
        }
    }

    /// Judges the router by its probe, by the connection of `scorer`, and by the last report of another process.
    pub(crate) fn look(
        &mut self,
        scorer: &ScorerNode,
        reported: Option<Instant>,
    ) -> Option<RouterFinding> {
        let now = Instant::now();
        let probe = self.probe.as_mut();
        let silence = probe.map_or(Duration::ZERO, |probe| probe.silence(now));
        let reported = reported.map_or(silence, |at| now.saturating_duration_since(at));
        // Any message that came through shows that the router passes messages.
        self.judge(silence.min(reported), scorer.router_lost_since(), now)
    }

    /// Takes note of an end of the router, which is started again: it may be back before its absence is observed.
    pub(crate) fn note_restart(&mut self, now: Instant) {
        self.replaced = Some(now);
        self.gone_since.get_or_insert(now);
    }

    /// Judges it by the time for which nothing has come through it, and since when there is no connection.
    fn judge(
        &mut self,
        silence: Duration,
        lost_since: Option<Instant>,
        now: Instant,
    ) -> Option<RouterFinding> {
        let looked = self.looked.replace(now).unwrap_or(now);
        let pause = now.saturating_duration_since(looked);
        // A gap in the own loop says nothing about the router.
        if pause > LIMIT {
            self.pauses.add([pause]);
            let seconds = pause.as_secs_f64();
            let line = format!("the run was suspended for {seconds:.1} s");
            return Some(RouterFinding::Line(line));
        }
        let is_silent = silence > LIMIT;
        let since = lost_since.or_else(|| is_silent.then(|| now.checked_sub(silence))?);
        let line = match (self.gone_since, since) {
            (None, Some(since)) => {
                self.gone_since = Some(since);
                "the router is gone: no message passes".to_owned()
            }
            (Some(since), None) if now.saturating_duration_since(since) >= SHORTEST => {
                let outage = now.saturating_duration_since(since);
                self.gone_since = None;
                self.outages.add([outage]);
                let seconds = outage.as_secs_f64();
                format!("the router is back after {seconds:.1} s")
            }
            // One that has ended is started again without a request.
            (Some(_), Some(_)) if self.is_own && lost_since.is_none() && !self.is_new(now) => {
                self.replaced = Some(now);
                return Some(RouterFinding::Hung(in_words(silence)));
            }
            _ => return None,
        };
        Some(RouterFinding::Line(line))
    }

    /// True if not all clients of the last router need to be back.
    fn is_new(&self, now: Instant) -> bool {
        let age = self.replaced.map(|at| now.saturating_duration_since(at));
        age.is_some_and(|age| age < RETURN_LIMIT)
    }

    /// Time since which the router is gone.
    pub(crate) fn gone_s(&self) -> Option<f64> {
        self.gone_since.map(|since| since.elapsed().as_secs_f64())
    }

    /// Outages and pauses so far, as text.
    pub(crate) fn causes(&self) -> Vec<String> {
        let current = self
            .gone_s()
            .map(|seconds| format!("router gone for {seconds:.1} s"));
        let over = [
            self.outages.sentence("router gone"),
            self.pauses.sentence("suspended"),
        ];
        over.into_iter().flatten().chain(current).collect()
    }

    /// True if messages of any process may have been lost without its knowledge.
    pub(crate) fn had_outages(&self) -> bool {
        self.gone_since.is_some() || self.outages.count + self.pauses.count > 0
    }

    /// Ends the probe.
    pub(crate) fn end(&mut self) {
        if let Some(probe) = self.probe.take() {
            probe.end(self.gone_since.is_some());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEAT: Duration = Duration::from_millis(100);

    fn line(found: Option<RouterFinding>) -> String {
        match found {
            Some(RouterFinding::Line(line)) => line,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_router_elsewhere_that_is_silent_or_lost_is_gone_until_it_is_back() {
        let (mut watch, mut now) = (RouterWatch::new(None, false), Instant::now());
        let mut look = |watch: &mut RouterWatch, silence: f64, lost: Option<f64>| {
            now += BEAT;
            let lost = lost.map(|seconds| now - Duration::from_secs_f64(seconds));
            watch.judge(Duration::from_secs_f64(silence), lost, now)
        };
        assert_eq!(look(&mut watch, 1.9, None), None);
        assert!(line(look(&mut watch, 2.1, None)).contains("the router is gone"));
        assert_eq!(look(&mut watch, 2.2, Some(0.1)), None, "once");
        assert_eq!(
            line(look(&mut watch, 0.0, None)),
            "the router is back after 2.3 s"
        );
        assert_eq!(watch.causes(), ["router gone for 2.3 s"]);
        assert!(line(look(&mut watch, 0.1, Some(0.1))).contains("gone"));
        assert!(watch.causes()[1].starts_with("router gone for 0."));
        line(look(&mut watch, 0.2, None));
        assert_eq!(watch.causes(), ["router gone for 2.5 s in all (2 times)"]);
    }

    #[test]
    fn a_router_of_the_run_that_is_silent_is_replaced_and_has_time_then() {
        let mut watch = RouterWatch::new(None, true);
        let mut now = Instant::now();
        assert_eq!(watch.judge(LIMIT, None, now), None);
        for _ in 0..2 {
            now += BEAT;
            assert!(line(watch.judge(LIMIT + BEAT, None, now)).contains("gone"));
            now += BEAT;
            let found = watch.judge(LIMIT + 2 * BEAT, None, now);
            let reason = "nothing came through it for 2.2 s".to_owned();
            assert_eq!(found, Some(RouterFinding::Hung(reason)));
            now += BEAT;
            assert_eq!(watch.judge(2 * LIMIT, None, now), None, "it is new");
            assert!(line(watch.judge(BEAT, None, now)).contains("back"));
            now += RETURN_LIMIT;
            watch.looked = Some(now);
        }
    }

    #[test]
    fn a_router_that_ended_by_itself_is_not_replaced_once_more() {
        let mut watch = RouterWatch::new(None, true);
        let now = Instant::now();
        watch.note_restart(now);
        assert_eq!(
            watch.judge(BEAT, None, now),
            None,
            "its end is not seen yet"
        );
        assert_eq!(watch.judge(2 * LIMIT, None, now + BEAT), None);
        let back = line(watch.judge(BEAT, None, now + 3 * BEAT));
        assert_eq!(back, "the router is back after 0.3 s");
        assert_eq!(watch.causes(), ["router gone for 0.3 s"]);
    }

    #[test]
    fn a_pause_of_the_run_is_no_outage_of_the_router() {
        let mut watch = RouterWatch::new(None, true);
        let now = Instant::now();
        watch.judge(BEAT, None, now);
        let after = now + Duration::from_secs(20);
        assert_eq!(
            line(watch.judge(Duration::from_secs(20), None, after)),
            "the run was suspended for 20.0 s"
        );
        assert_eq!(watch.judge(BEAT, None, after + BEAT), None);
        assert_eq!(watch.causes(), ["suspended for 20.0 s"]);
        assert!(watch.had_outages());
    }
}
