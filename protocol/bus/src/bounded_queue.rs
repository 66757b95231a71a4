//! A bounded hand-over between two threads that never hides a loss.
//!
//! It stands wherever one side of the bus must not wait for the other: in front of every publisher and behind every
//! subscriber. Items lie in lanes, one per key, each of a fixed capacity; whatever does not fit comes back to the
//! caller, who counts it.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

/// What became of a pushed item.
#[derive(Debug, PartialEq, Eq)]
#[must_use = "a displaced or refused item is a loss that has to be counted"]
pub enum PushOutcome<T> {
    /// It waits for the consumer.
    Queued,
    /// It waits for the consumer, in the place of this older item of its lane.
    Replaced(T),
    /// There are already as many lanes as may be; the item was not taken.
    NoLane(T),
    /// The mailbox is closed; the item was not taken.
    Closed(T),
}

/// What a consumer found.
#[derive(Debug, PartialEq, Eq)]
pub enum Pop<K, T> {
    /// The oldest item of all lanes.
    Item(K, T),
    /// Nothing came before the deadline.
    TimedOut,
    /// The mailbox is closed and empty: nothing will ever come.
    Closed,
}

struct State<K, T> {
    // Each item carries its place in the order of arrival, so that no lane can starve another.
    lanes: BTreeMap<K, VecDeque<(u64, T)>>,
    next_arrival: u64,
    closed: bool,
}

/// Lanes of at most `lane_capacity` items each; safe to share between threads.
pub struct BoundedQueue<K, T> {
    state: Mutex<State<K, T>>,
    changed: Condvar,
    lane_capacity: usize,
    max_lanes: usize,
}

impl<K: Ord + Clone, T> BoundedQueue<K, T> {
    /// An empty mailbox of at most `max_lanes` lanes of `lane_capacity` items (both at least one).
    #[must_use]
    pub fn new(lane_capacity: usize, max_lanes: usize) -> Self {
        Self {
            state: Mutex::new(State { lanes: BTreeMap::new(), next_arrival: 0, closed: false }),
            changed: Condvar::new(),
            lane_capacity: lane_capacity.max(1),
            max_lanes: max_lanes.max(1),
        }
    }

    /// Puts `item` behind the others of its lane without waiting; a full lane gives up its oldest item.
    pub fn push(&self, key: K, item: T) -> PushOutcome<T> {
        self.push_within(self.lane_capacity, key, item)
    }

    /// [`Self::push`] for a lane of another capacity than the others.
    pub fn push_within(&self, lane_capacity: usize, key: K, item: T) -> PushOutcome<T> {
        let mut state = self.lock();
        let displaced = match self.make_lane(&mut state, &key, lane_capacity.max(1)) {
            Err(Full::Closed) => return PushOutcome::Closed(item),
            Err(Full::NoLane) => return PushOutcome::NoLane(item),
            Err(Full::Lane) => state.lanes.get_mut(&key).and_then(VecDeque::pop_front),
            Ok(()) => None,
        };
        self.append(state, key, item);
        displaced.map_or(PushOutcome::Queued, |(_, older)| PushOutcome::Replaced(older))
    }

    /// Puts `item` behind the others of its lane, waiting for room as long as it takes.
    pub fn push_waiting(&self, key: K, item: T) -> PushOutcome<T> {
        let mut state = self.lock();
        loop {
            match self.make_lane(&mut state, &key, self.lane_capacity) {
                Ok(()) => break,
                Err(Full::Closed) => return PushOutcome::Closed(item),
                Err(Full::NoLane) => return PushOutcome::NoLane(item),
                Err(Full::Lane) => state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
            }
        }
        self.append(state, key, item);
        PushOutcome::Queued
    }

    /// Takes the item that has waited longest, waiting for one until `deadline` (for ever without one).
    pub fn take(&self, deadline: Option<Instant>) -> Pop<K, T> {
        let mut state = self.lock();
        loop {
            if let Some((key, item)) = pop_oldest(&mut state.lanes) {
                self.changed.notify_all();
                return Pop::Item(key, item);
            }
            if state.closed {
                return Pop::Closed;
            }
            state = match deadline {
                None => self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
                Some(deadline) => {
                    let left = deadline.saturating_duration_since(Instant::now());
                    if left.is_zero() {
                        return Pop::TimedOut;
                    }
                    self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0
                }
            };
        }
    }

    /// Refuses further items; those inside can still be taken.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    /// Takes everything out at once, oldest first.
    pub fn drain(&self) -> Vec<(K, T)> {
        let mut state = self.lock();
        let drained = std::iter::from_fn(|| pop_oldest(&mut state.lanes)).collect();
        self.changed.notify_all();
        drained
    }

    /// Items inside.
    #[must_use]
    pub fn len(&self) -> usize {
        self.lock().lanes.values().map(VecDeque::len).sum()
    }

    /// Whether nothing is inside.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    // A panic elsewhere leaves no half-done change behind: every method changes the state in one step.
    fn lock(&self) -> MutexGuard<'_, State<K, T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn make_lane(&self, state: &mut State<K, T>, key: &K, capacity: usize) -> Result<(), Full> {
        if state.closed {
            return Err(Full::Closed);
        }
        match state.lanes.get(key) {
            Some(lane) if lane.len() >= capacity => Err(Full::Lane),
            None if state.lanes.len() >= self.max_lanes => Err(Full::NoLane),
            _ => Ok(()),
        }
    }

    fn append(&self, mut state: MutexGuard<'_, State<K, T>>, key: K, item: T) {
        let arrival = state.next_arrival;
        state.next_arrival += 1;
        state.lanes.entry(key).or_default().push_back((arrival, item));
        // Whoever wakes up may take this thread's place at once: it must not find the door locked then.
        drop(state);
        self.changed.notify_all();
    }
}

enum Full {
    Closed,
    NoLane,
    Lane,
}

/// Lanes that run empty are forgotten, so that peers that come and go do not use the lanes up.
fn pop_oldest<K: Ord + Clone, T>(lanes: &mut BTreeMap<K, VecDeque<(u64, T)>>) -> Option<(K, T)> {
    let oldest =
        lanes.iter().filter_map(|(key, lane)| Some((lane.front()?.0, key))).min_by_key(|(arrival, _)| *arrival);
    let key = oldest?.1.clone();
    let lane = lanes.get_mut(&key)?;
    let (_, item) = lane.pop_front()?;
    if lane.is_empty() {
        lanes.remove(&key);
    }
    Some((key, item))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::thread;
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_full_lane_gives_up_its_oldest_item() {
        let mailbox = BoundedQueue::new(2, 4);
        assert_eq!(mailbox.push("a", 1), PushOutcome::Queued);
        assert_eq!(mailbox.push("a", 2), PushOutcome::Queued);
        assert_eq!(mailbox.push("b", 3), PushOutcome::Queued);
        assert_eq!(mailbox.push("a", 4), PushOutcome::Replaced(1));
        assert_eq!(mailbox.drain(), [("a", 2), ("b", 3), ("a", 4)]);
    }

    #[test]
    fn strangers_cannot_open_lanes_without_end() {
        let mailbox = BoundedQueue::new(1, 2);
        assert_eq!(mailbox.push(1, ()), PushOutcome::Queued);
        assert_eq!(mailbox.push(2, ()), PushOutcome::Queued);
        assert_eq!(mailbox.push(3, ()), PushOutcome::NoLane(()));
        let _ = mailbox.take(None);
        assert_eq!(mailbox.push(3, ()), PushOutcome::Queued, "an emptied lane is free again");
    }

    #[test]
    fn what_was_pushed_before_closing_is_still_taken() {
        let mailbox = BoundedQueue::new(1, 1);
        assert_eq!(mailbox.push((), 7), PushOutcome::Queued);
        mailbox.close();
        assert_eq!(mailbox.push((), 8), PushOutcome::Closed(8));
        assert_eq!(mailbox.take(None), Pop::Item((), 7));
        assert_eq!(mailbox.take(None), Pop::Closed);
    }

    #[test]
    fn an_empty_mailbox_times_out() {
        let mailbox = BoundedQueue::<(), ()>::new(1, 1);
        assert_eq!(mailbox.take(Some(Instant::now() + Duration::from_millis(5))), Pop::TimedOut);
    }

    #[test]
    fn a_waiting_producer_loses_nothing() {
        let mailbox = Arc::new(BoundedQueue::new(1, 1));
        let producer = thread::spawn({
            let mailbox = Arc::clone(&mailbox);
            move || (0..100).all(|item| mailbox.push_waiting((), item) == PushOutcome::Queued)
        });
        for expected in 0..100 {
            assert_eq!(mailbox.take(None), Pop::Item((), expected));
        }
        assert!(producer.join().unwrap());
    }

    #[test]
    fn closing_frees_a_waiting_producer() {
        let mailbox = Arc::new(BoundedQueue::new(1, 1));
        assert_eq!(mailbox.push((), 1), PushOutcome::Queued);
        let producer = thread::spawn({
            let mailbox = Arc::clone(&mailbox);
            move || mailbox.push_waiting((), 2)
        });
        mailbox.close();
        assert_eq!(producer.join().unwrap(), PushOutcome::Closed(2));
    }
}
