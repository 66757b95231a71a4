//! Whether a message is news: what came before, what is repeated, and who else speaks under the same name.
//!
//! A sender numbers its messages in rising order and draws an epoch when it starts. A new epoch is a sender that has
//! started again, and is believed at once. When the one before it goes on speaking, two speak under one name; which of
//! them is the right one cannot be told from here, so neither is heard until one of them has been silent for a while.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use protocol::{DropReason, Topic};

/// What a sender had under way when it was started again may come so long after the first word of its successor.
const GRACE: Duration = Duration::from_secs(1);
/// A sender that says nothing for so long is not there any more.
const QUIET: Duration = Duration::from_secs(3);
/// Epochs before the current one that are remembered per topic.
const EPOCHS: usize = 8;
/// New epochs within [`QUIET`] that a sender may have: who starts more often is several, or one that makes them up.
const STARTS: usize = 4;
/// Topics remembered at most: a hostile sender must not fill the memory.
const TOPICS: usize = 1024;

/// What is known of the senders on all topics of an inbox.
#[derive(Debug, Default)]
pub(super) struct ReplayWindow {
    topics: BTreeMap<Topic, Senders>,
}

/// Whether a message is news, and what to say of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Admission {
    /// Why it is not; none where it is.
    pub(super) dropped: Option<DropReason>,
    /// Whether the topic's senders are quarantined from now on, or not any more.
    pub(super) quarantine: Option<bool>,
}

#[derive(Debug)]
struct Senders {
    current: Sender,
    former: VecDeque<Sender>,
    starts: VecDeque<Instant>,
    quarantined_until: Option<Instant>,
}

#[derive(Debug)]
struct Sender {
    epoch: u64,
    numbers: SequenceWindow,
    heard: Instant,
    /// When another epoch took its place.
    replaced: Instant,
}

/// SequenceWindow that came: the highest, and which of the 64 before it.
#[derive(Debug)]
struct SequenceWindow {
    highest: u64,
    came: u64,
}

impl ReplayWindow {
    /// Takes note of a message and says whether it is news.
    pub(super) fn admit(&mut self, topic: &Topic, epoch: u64, sequence: u64, now: Instant) -> Admission {
        if let Some(senders) = self.topics.get_mut(topic) {
            return senders.admit(epoch, sequence, now);
        }
        if self.topics.len() >= TOPICS {
            let oldest = self.topics.iter().min_by_key(|(_, senders)| senders.current.heard);
            if let Some(oldest) = oldest.map(|(topic, _)| topic.clone()) {
                self.topics.remove(&oldest);
            }
        }
        let current = Sender::new(epoch, sequence, now);
        let senders = Senders { current, former: VecDeque::new(), starts: VecDeque::new(), quarantined_until: None };
        self.topics.insert(topic.clone(), senders);
        Admission { dropped: None, quarantine: None }
    }
}

impl Senders {
    fn admit(&mut self, epoch: u64, sequence: u64, now: Instant) -> Admission {
        let was_quarantined = self.quarantined_until.is_some();
        self.quarantined_until = self.quarantined_until.filter(|until| now < *until);
        let dropped = self.judge(epoch, sequence, now);
        let is_quarantined = self.quarantined_until.is_some();
        let dropped = dropped.or(is_quarantined.then_some(DropReason::Identity));
        Admission { dropped, quarantine: (was_quarantined != is_quarantined).then_some(is_quarantined) }
    }

    fn judge(&mut self, epoch: u64, sequence: u64, now: Instant) -> Option<DropReason> {
        if epoch == self.current.epoch {
            let repeated = self.current.numbers.note(sequence);
            if repeated.is_none() {
                self.current.heard = now;
            }
            return repeated;
        }
        if let Some(place) = self.former.iter().position(|sender| sender.epoch == epoch) {
            return self.heard_again(place, sequence, now);
        }
        // Started again: believed at once.
        while self.starts.front().is_some_and(|start| now.duration_since(*start) > QUIET) {
            self.starts.pop_front();
        }
        self.starts.push_back(now);
        if self.starts.len() > STARTS {
            self.starts.pop_front();
            self.quarantined_until = Some(now + QUIET);
        }
        self.replace(Sender::new(epoch, sequence, now), now);
        None
    }

    /// A sender of before speaks: a copy of its words, the last of them, or a second sender.
    fn heard_again(&mut self, place: usize, sequence: u64, now: Instant) -> Option<DropReason> {
        let sender = &mut self.former[place];
        if let Some(repeated) = sender.numbers.note(sequence) {
            return Some(repeated);
        }
        sender.heard = now;
        if now.duration_since(self.current.heard) > QUIET {
            // Its successor has gone.
            if let Some(sender) = self.former.remove(place) {
                self.replace(sender, now);
            }
            self.quarantined_until = None;
            return None;
        }
        if now.duration_since(sender.replaced) <= GRACE {
            return Some(DropReason::Superseded);
        }
        self.quarantined_until = Some(now + QUIET);
        Some(DropReason::Identity)
    }

    fn replace(&mut self, by: Sender, now: Instant) {
        let mut before = std::mem::replace(&mut self.current, by);
        before.replaced = now;
        self.former.push_back(before);
        if self.former.len() > EPOCHS {
            self.former.pop_front();
        }
    }
}

impl Sender {
    fn new(epoch: u64, sequence: u64, now: Instant) -> Self {
        Self { epoch, numbers: SequenceWindow { highest: sequence, came: 1 }, heard: now, replaced: now }
    }
}

impl SequenceWindow {
    /// Takes note of a number; why it is no news, where it is none. What was overtaken comes too late.
    fn note(&mut self, sequence: u64) -> Option<DropReason> {
        if sequence > self.highest {
            let ahead = sequence - self.highest;
            self.came = if ahead < 64 { self.came << ahead | 1 } else { 1 };
            self.highest = sequence;
            return None;
        }
        let behind = self.highest - sequence;
        if behind >= 64 || self.came >> behind & 1 == 1 {
            return Some(DropReason::Duplicate);
        }
        self.came |= 1 << behind;
        Some(DropReason::Superseded)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Ear {
        freshness: ReplayWindow,
        topic: Topic,
        begun: Instant,
    }

    impl Ear {
        fn new() -> Self {
            Self { freshness: ReplayWindow::default(), topic: "4279/bev".parse().unwrap(), begun: Instant::now() }
        }

        fn hear(&mut self, epoch: u64, sequence: u64, at_ms: u64) -> Admission {
            self.freshness.admit(&self.topic, epoch, sequence, self.begun + Duration::from_millis(at_ms))
        }

        fn dropped(&mut self, epoch: u64, sequence: u64, at_ms: u64) -> Option<DropReason> {
            self.hear(epoch, sequence, at_ms).dropped
        }
    }

    #[test]
    fn a_repeated_number_is_a_duplicate_and_one_that_was_overtaken_comes_too_late() {
        let mut ear = Ear::new();
        assert_eq!([10, 11, 14].map(|number| ear.dropped(1, number, 0)), [None; 3]);
        assert_eq!(ear.dropped(1, 14, 0), Some(DropReason::Duplicate));
        assert_eq!(ear.dropped(1, 12, 0), Some(DropReason::Superseded));
        assert_eq!(ear.dropped(1, 12, 0), Some(DropReason::Duplicate));
        assert_eq!(ear.dropped(1, 1_000_000, 0), None);
        assert_eq!(ear.dropped(1, 15, 0), Some(DropReason::Duplicate), "too long ago to know");
    }

    #[test]
    fn a_sender_that_starts_again_is_heard_at_once_and_its_old_words_are_not() {
        let mut ear = Ear::new();
        assert_eq!(ear.dropped(1, 100, 0), None);
        let again = ear.hear(2, 0, 100);
        assert_eq!(again, Admission { dropped: None, quarantine: None });
        // A replay of old words, and the last of them on their way.
        assert_eq!(ear.dropped(1, 100, 5_000), Some(DropReason::Duplicate));
        assert_eq!(ear.dropped(2, 1, 5_000), None);
        assert_eq!(ear.dropped(3, 0, 6_000), None);
        assert_eq!(ear.dropped(2, 2, 6_200), Some(DropReason::Superseded));
        assert_eq!(ear.dropped(3, 1, 6_300), None);
    }

    #[test]
    fn two_under_one_name_are_both_silenced_until_one_is_left() {
        let mut ear = Ear::new();
        let mut said = Vec::new();
        for step in 0..40_u64 {
            ear.dropped(1, step, step * 100);
            said.extend(ear.hear(2, step, step * 100 + 50).quarantine);
        }
        assert_eq!(ear.dropped(2, 40, 4_000), Some(DropReason::Identity));
        // The intruder has gone; the other one goes on.
        let mut heard_from = None;
        for step in 40..120_u64 {
            let verdict = ear.hear(1, step, step * 100);
            said.extend(verdict.quarantine);
            if verdict.dropped.is_none() && heard_from.is_none() {
                heard_from = Some(step * 100);
            }
        }
        assert!((6_900..=7_300).contains(&heard_from.unwrap()), "{heard_from:?}");
        assert_eq!(said, [false], "the beginning was said to the other one");
    }

    #[test]
    fn a_sender_that_draws_epochs_like_lots_is_silenced() {
        let mut ear = Ear::new();
        let verdicts: Vec<_> = (0..20).map(|epoch| ear.dropped(epoch, 0, epoch * 100)).collect();
        assert!(verdicts[..4].iter().all(Option::is_none));
        assert!(verdicts[6..].iter().all(|dropped| *dropped == Some(DropReason::Identity)), "{verdicts:?}");
    }

    #[test]
    fn the_memory_of_topics_is_bounded() {
        let mut freshness = ReplayWindow::default();
        let begun = Instant::now();
        for vehicle in 0..2 * TOPICS as u64 {
            let topic: Topic = format!("{vehicle}/bev").parse().unwrap();
            assert_eq!(freshness.admit(&topic, 1, 1, begun + Duration::from_millis(vehicle)).dropped, None);
        }
        assert_eq!(freshness.topics.len(), TOPICS);
    }
}
