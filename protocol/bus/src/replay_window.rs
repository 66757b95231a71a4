//! Replay protection: rejects duplicate and stale sequence numbers and detects two senders with one id.
//!
//! A sender numbers its messages in increasing order and draws an epoch when it starts. A new epoch means a restarted
//! sender and is accepted at once. If the previous epoch continues, two senders use one id; the receiver cannot tell
//! which one is legitimate, so both are quarantined until one of them has been silent for a while.

use std::collections::{BTreeMap, VecDeque};
use std::time::{Duration, Instant};

use protocol::{DropReason, Topic};

/// Period after a restart in which messages of the previous instance may still arrive.
const GRACE: Duration = Duration::from_secs(1);
/// Silence after which a sender is considered gone.
const QUIET: Duration = Duration::from_secs(3);
/// Number of previous epochs kept per topic.
const EPOCHS: usize = 8;
/// New epochs that a sender may have within [`QUIET`]: more mean several senders, or forged epochs.
const STARTS: usize = 4;
/// Maximum number of topics kept: a hostile sender must not fill the memory.
const TOPICS: usize = 1024;

/// State of the senders on all topics of an inbox.
#[derive(Debug, Default)]
pub(super) struct ReplayWindow {
    topics: BTreeMap<Topic, TopicSenders>,
}

/// Result of the check of a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Admission {
    /// Drop reason; `None` if the message is accepted.
    pub(super) dropped: Option<DropReason>,
    /// `true` if the topic's senders are quarantined from now on, `false` if the quarantine ends.
    pub(super) quarantine: Option<bool>,
}

#[derive(Debug)]
struct TopicSenders {
    current: Sender,
    former: VecDeque<Sender>,
    starts: VecDeque<Instant>,
    quarantined_until: Option<Instant>,
}

#[derive(Debug)]
struct Sender {
    epoch: u64,
    /// Highest sequence number received.
    highest: u64,
    /// Sequence numbers received: a bit mask of the highest and the 63 before it.
    came: u64,
    last_seen: Instant,
    /// Time at which another epoch replaced this one.
    replaced: Instant,
}

impl ReplayWindow {
    /// Adds a message and decides whether it is accepted.
    pub(super) fn admit(
        &mut self,
        topic: &Topic,
        epoch: u64,
        sequence: u64,
        now: Instant,
    ) -> Admission {
        if let Some(senders) = self.topics.get_mut(topic) {
            return senders.admit(epoch, sequence, now);
        }
        // The topic that has been silent for longest gives up its place.
        if self.topics.len() >= TOPICS {
            let topics = self.topics.iter();
            let oldest = topics.min_by_key(|(_, senders)| senders.current.last_seen);
            if let Some(oldest) = oldest.map(|(topic, _)| topic.clone()) {
                self.topics.remove(&oldest);
            }
        }
        let current = Sender::new(epoch, sequence, now);
        let senders = TopicSenders {
            current,
            former: VecDeque::new(),
            starts: VecDeque::new(),
            quarantined_until: None,
        };
        self.topics.insert(topic.clone(), senders);
        Admission::default()
    }
}

impl TopicSenders {
    fn admit(&mut self, epoch: u64, sequence: u64, now: Instant) -> Admission {
        let was_quarantined = self.quarantined_until.is_some();
        self.quarantined_until = self.quarantined_until.filter(|until| now < *until);
        // Judged under quarantine too: the last times of the senders show when one of them has gone.
        let dropped = self.judge(epoch, sequence, now);
        let is_quarantined = self.quarantined_until.is_some();
        let dropped = dropped.or(is_quarantined.then_some(DropReason::Identity));
        Admission {
            dropped,
            quarantine: (was_quarantined != is_quarantined).then_some(is_quarantined),
        }
    }

    fn judge(&mut self, epoch: u64, sequence: u64, now: Instant) -> Option<DropReason> {
        if epoch == self.current.epoch {
            let repeated = self.current.note(sequence);
            if repeated.is_none() {
                self.current.last_seen = now;
            }
            return repeated;
        }
        if let Some(place) = self.former.iter().position(|sender| sender.epoch == epoch) {
            return self.admit_previous_epoch(place, sequence, now);
        }
        // A restarted sender is accepted at once.
        while self
            .starts
            .pop_front_if(|start| now.duration_since(*start) > QUIET)
            .is_some()
        {}
        self.starts.push_back(now);
        if self.starts.len() > STARTS {
            self.starts.pop_front();
            self.quarantined_until = Some(now + QUIET);
        }
        self.replace(Sender::new(epoch, sequence, now), now);
        None
    }

    /// A message of a previous epoch: a replay, a message in transit at the restart, or a second sender.
    fn admit_previous_epoch(
        &mut self,
        place: usize,
        sequence: u64,
        now: Instant,
    ) -> Option<DropReason> {
        let sender = self.former.get_mut(place)?;
        // A replayed message must neither renew the sender nor begin a quarantine.
        if let Some(repeated) = sender.note(sequence) {
            return Some(repeated);
        }
        sender.last_seen = now;
        if now.duration_since(self.current.last_seen) > QUIET {
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
        Self {
            epoch,
            highest: sequence,
            came: 1,
            last_seen: now,
            replaced: now,
        }
    }

    /// Adds a sequence number; returns the drop reason if it is rejected. Overtaken messages are stale.
    fn note(&mut self, sequence: u64) -> Option<DropReason> {
        if sequence > self.highest {
            // Bit n stands for the number n below the highest.
            let ahead = u32::try_from(sequence - self.highest).unwrap_or(u32::MAX);
            self.came = self.came.unbounded_shl(ahead) | 1;
            self.highest = sequence;
            return None;
        }
        let behind = self.highest - sequence;
        // Older than the window: whether it had come before is unknown, so it is refused.
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

    struct Receiver {
        replay_window: ReplayWindow,
        topic: Topic,
        begun: Instant,
    }

    impl Receiver {
        fn new() -> Self {
            Self {
                replay_window: ReplayWindow::default(),
                topic: "4279/bev".parse().unwrap(),
                begun: Instant::now(),
            }
        }

        fn receive(&mut self, epoch: u64, sequence: u64, at_ms: u64) -> Admission {
            self.replay_window.admit(
                &self.topic,
                epoch,
                sequence,
                self.begun + Duration::from_millis(at_ms),
            )
        }

        fn dropped(&mut self, epoch: u64, sequence: u64, at_ms: u64) -> Option<DropReason> {
            self.receive(epoch, sequence, at_ms).dropped
        }
    }

    #[test]
    fn a_repeated_number_is_a_duplicate_and_an_overtaken_one_is_stale() {
        let mut receiver = Receiver::new();
        assert_eq!(
            [10, 11, 14].map(|number| receiver.dropped(1, number, 0)),
            [None; 3]
        );
        assert_eq!(receiver.dropped(1, 14, 0), Some(DropReason::Duplicate));
        assert_eq!(receiver.dropped(1, 12, 0), Some(DropReason::Superseded));
        assert_eq!(receiver.dropped(1, 12, 0), Some(DropReason::Duplicate));
        assert_eq!(receiver.dropped(1, 1_000_000, 0), None);
        assert_eq!(
            receiver.dropped(1, 15, 0),
            Some(DropReason::Duplicate),
            "outside of the window"
        );
    }

    #[test]
    fn a_restarted_sender_is_accepted_at_once_and_its_old_messages_are_not() {
        let mut receiver = Receiver::new();
        assert_eq!(receiver.dropped(1, 100, 0), None);
        let again = receiver.receive(2, 0, 100);
        assert_eq!(
            again,
            Admission {
                dropped: None,
                quarantine: None
            }
        );
        // A replay of old messages, and the last of them in transit.
        assert_eq!(receiver.dropped(1, 100, 5_000), Some(DropReason::Duplicate));
        assert_eq!(receiver.dropped(2, 1, 5_000), None);
        assert_eq!(receiver.dropped(3, 0, 6_000), None);
        assert_eq!(receiver.dropped(2, 2, 6_200), Some(DropReason::Superseded));
        assert_eq!(receiver.dropped(3, 1, 6_300), None);
    }

    #[test]
    fn two_senders_with_one_id_are_quarantined_until_one_is_left() {
        let mut receiver = Receiver::new();
        let mut changes = Vec::new();
        for step in 0..40_u64 {
            receiver.dropped(1, step, step * 100);
            changes.extend(receiver.receive(2, step, step * 100 + 50).quarantine);
        }
        assert_eq!(receiver.dropped(2, 40, 4_000), Some(DropReason::Identity));
        // The intruder has gone; the other sender continues.
        let mut accepted_from = None;
        for step in 40..120_u64 {
            let admission = receiver.receive(1, step, step * 100);
            changes.extend(admission.quarantine);
            if admission.dropped.is_none() && accepted_from.is_none() {
                accepted_from = Some(step * 100);
            }
        }
        assert!(
            (6_900..=7_300).contains(&accepted_from.unwrap()),
            "{accepted_from:?}"
        );
        assert_eq!(
            changes,
            [false],
            "its start was reported with a message of the other sender"
        );
    }

    #[test]
    fn a_sender_with_many_epochs_is_quarantined() {
        let mut receiver = Receiver::new();
        let verdicts: Vec<_> = (0..20)
            .map(|epoch| receiver.dropped(epoch, 0, epoch * 100))
            .collect();
        assert!(verdicts[..4].iter().all(Option::is_none));
        assert!(
            verdicts[6..]
                .iter()
                .all(|dropped| *dropped == Some(DropReason::Identity)),
            "{verdicts:?}"
        );
    }

    #[test]
    fn the_memory_of_topics_is_bounded() {
        let mut replay_window = ReplayWindow::default();
        let begun = Instant::now();
        for vehicle in 0..2 * TOPICS as u64 {
            let topic: Topic = format!("{vehicle}/bev").parse().unwrap();
            assert_eq!(
                replay_window
                    .admit(&topic, 1, 1, begun + Duration::from_millis(vehicle))
                    .dropped,
                None
            );
        }
        assert_eq!(replay_window.topics.len(), TOPICS);
    }
}
