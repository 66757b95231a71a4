//! Bounded queue between two threads that returns every item it cannot keep.
//!
//! Used where one side of the bus must not wait for the other: in front of every publisher and behind every subscriber.
//! Items are held in lanes, one per key, each of a fixed capacity; an item that does not fit is returned to the caller,
//! which counts it.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Condvar, Mutex};
use std::time::Instant;

use support::sync::{lock, wait, wait_at_most};

/// Result of a push.
#[derive(Debug, PartialEq, Eq)]
#[must_use = "a replaced or refused item is a loss that has to be counted"]
pub enum PushOutcome<T> {
    /// The item is queued.
    Queued,
    /// The item is queued and replaces this older item of its lane.
    Replaced(T),
    /// The maximum number of lanes is reached; the item was not taken.
    NoLane(T),
    /// The queue is closed; the item was not taken.
    Closed(T),
}

/// Result of a pop.
#[derive(Debug, PartialEq, Eq)]
pub enum Pop<K, T> {
    /// The oldest item of all lanes.
    Item(K, T),
    /// No item before the deadline.
    TimedOut,
    /// The queue is closed and empty: no item will follow.
    Closed,
}

struct QueueState<K, T> {
    // Each item carries its index in the order of arrival, so that no lane can starve another.
    lanes: BTreeMap<K, VecDeque<(u64, T)>>,
    next_arrival: u64,
    closed: bool,
}

/// Lanes of at most `lane_capacity` items each; safe to share between threads.
pub struct BoundedQueue<K, T> {
    // A panic elsewhere leaves no half-done change: every method changes the state in one step.
    state: Mutex<QueueState<K, T>>,
    changed: Condvar,
    lane_capacity: usize,
    max_lanes: usize,
}

impl<K: Ord + Clone, T> BoundedQueue<K, T> {
    /// An empty queue of at most `max_lanes` lanes of `lane_capacity` items (both at least one).
    pub fn new(lane_capacity: usize, max_lanes: usize) -> Self {
        Self {
            state: Mutex::new(QueueState {
                lanes: BTreeMap::new(),
                next_arrival: 0,
                closed: false,
            }),
            changed: Condvar::new(),
            lane_capacity: lane_capacity.max(1),
            max_lanes: max_lanes.max(1),
        }
    }

    /// Appends `item` to its lane without waiting; a full lane gives up its oldest item.
    pub fn push(&self, key: K, item: T) -> PushOutcome<T> {
        self.push_within(None, key, item)
    }

    /// [`Self::push`] for a lane that may have another capacity than the others.
    pub(crate) fn push_within(&self, capacity: Option<usize>, key: K, item: T) -> PushOutcome<T> {
        let capacity = capacity.map_or(self.lane_capacity, |capacity| capacity.max(1));
        self.append(key, item, capacity, false)
    }

    /// Appends `item` to its lane, waiting for room without a time limit.
    pub(crate) fn push_waiting(&self, key: K, item: T) -> PushOutcome<T> {
        self.append(key, item, self.lane_capacity, true)
    }

    /// Takes the oldest item, waiting for one until `deadline` (without a limit if `None`).
    pub fn take(&self, deadline: Option<Instant>) -> Pop<K, T> {
        let mut state = lock(&self.state);
        loop {
            if let Some((key, item)) = pop_oldest(&mut state.lanes) {
                // All of them: producers and consumers wait on the same condition variable.
                self.changed.notify_all();
                return Pop::Item(key, item);
            }
            if state.closed {
                return Pop::Closed;
            }
            state = match deadline {
                None => wait(&self.changed, state),
                Some(deadline) => {
                    let left = deadline.saturating_duration_since(Instant::now());
                    if left.is_zero() {
                        return Pop::TimedOut;
                    }
                    wait_at_most(&self.changed, state, left)
                }
            };
        }
    }

    /// Rejects further items; items inside can still be taken.
    pub fn close(&self) {
        lock(&self.state).closed = true;
        self.changed.notify_all();
    }

    /// Appends `item` to its lane; one of `capacity` items is waited for (`waits`), or gives up its oldest item.
    fn append(&self, key: K, item: T, capacity: usize, waits: bool) -> PushOutcome<T> {
        let mut state = lock(&self.state);
        let replaced = loop {
            if state.closed {
                return PushOutcome::Closed(item);
            }
            match state.lanes.get(&key) {
                Some(lane) if lane.len() >= capacity => {}
                None if state.lanes.len() >= self.max_lanes => return PushOutcome::NoLane(item),
                _ => break None,
            }
            if !waits {
                break state.lanes.get_mut(&key).and_then(VecDeque::pop_front);
            }
            state = wait(&self.changed, state);
        };
        let arrival = state.next_arrival;
        state.next_arrival += 1;
        let lane = state.lanes.entry(key).or_default();
        lane.push_back((arrival, item));
        // The woken thread may run at once: the lock must be free then.
        drop(state);
        self.changed.notify_all();
        replaced.map_or(PushOutcome::Queued, |(_, older)| {
            PushOutcome::Replaced(older)
        })
    }
}

/// Empty lanes are removed, so that peers that join and leave do not use the lanes up.
fn pop_oldest<K: Ord + Clone, T>(lanes: &mut BTreeMap<K, VecDeque<(u64, T)>>) -> Option<(K, T)> {
    let oldest = lanes
        .iter()
        .filter_map(|(key, lane)| Some((lane.front()?.0, key)))
        .min_by_key(|(arrival, _)| *arrival);
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
        let queue = BoundedQueue::new(2, 4);
        assert_eq!(queue.push("a", 1), PushOutcome::Queued);
        assert_eq!(queue.push("a", 2), PushOutcome::Queued);
        assert_eq!(queue.push("b", 3), PushOutcome::Queued);
        assert_eq!(queue.push("a", 4), PushOutcome::Replaced(1));
        for (lane, item) in [("a", 2), ("b", 3), ("a", 4)] {
            assert_eq!(queue.take(None), Pop::Item(lane, item));
        }
    }

    #[test]
    fn the_number_of_lanes_is_bounded() {
        let queue = BoundedQueue::new(1, 2);
        assert_eq!(queue.push(1, ()), PushOutcome::Queued);
        assert_eq!(queue.push(2, ()), PushOutcome::Queued);
        assert_eq!(queue.push(3, ()), PushOutcome::NoLane(()));
        let _ = queue.take(None);
        assert_eq!(
            queue.push(3, ()),
            PushOutcome::Queued,
            "an emptied lane is free again"
        );
    }

    #[test]
    fn items_pushed_before_closing_are_still_taken() {
        let queue = BoundedQueue::new(1, 1);
        assert_eq!(queue.push((), 7), PushOutcome::Queued);
        queue.close();
        assert_eq!(queue.push((), 8), PushOutcome::Closed(8));
        assert_eq!(queue.take(None), Pop::Item((), 7));
        assert_eq!(queue.take(None), Pop::Closed);
    }

    #[test]
    fn an_empty_queue_times_out() {
        let queue = BoundedQueue::<(), ()>::new(1, 1);
        assert_eq!(
            queue.take(Some(Instant::now() + Duration::from_millis(5))),
            Pop::TimedOut
        );
    }

    #[test]
    fn a_waiting_producer_loses_nothing() {
        let queue = Arc::new(BoundedQueue::new(1, 1));
        let producer = thread::spawn({
            let queue = Arc::clone(&queue);
            move || (0..100).all(|item| queue.push_waiting((), item) == PushOutcome::Queued)
        });
        for expected in 0..100 {
            assert_eq!(queue.take(None), Pop::Item((), expected));
        }
        assert!(producer.join().unwrap());
    }

    #[test]
    fn closing_frees_a_waiting_producer() {
        let queue = Arc::new(BoundedQueue::new(1, 1));
        assert_eq!(queue.push((), 1), PushOutcome::Queued);
        let producer = thread::spawn({
            let queue = Arc::clone(&queue);
            move || queue.push_waiting((), 2)
        });
        queue.close();
        assert_eq!(producer.join().unwrap(), PushOutcome::Closed(2));
    }
}
