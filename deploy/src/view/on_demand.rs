//! Store of the newest values of a live run that a page asks for one by one: images, feature maps.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;
use std::time::{Duration, Instant};

use support::sync::lock;

/// Time after the last request until which values are received.
const WANTED: Duration = Duration::from_secs(3);
/// Largest number of keys that are counted beyond those that are kept.
const MOST_LEFT_OUT: usize = 1024;

/// Newest value of every key, kept while a page asks for any. Such streams are the largest after sweeps, so they are
/// received only then.
#[derive(Debug)]
pub(super) struct OnDemand<K, V> {
    /// Largest number of keys that are kept.
    most: usize,
    state: Mutex<OnDemandState<K, V>>,
}

#[derive(Debug)]
struct OnDemandState<K, V> {
    /// Last request for each key.
    asked: BTreeMap<K, Instant>,
    newest: BTreeMap<K, V>,
    left_out: BTreeSet<K>,
}

impl<K: Ord + Clone, V: Clone> OnDemand<K, V> {
    /// Keeps the values of up to `most` keys.
    pub(super) fn new(most: usize) -> Self {
        let state = OnDemandState {
            asked: BTreeMap::new(),
            newest: BTreeMap::new(),
            left_out: BTreeSet::new(),
        };
        Self {
            most,
            state: Mutex::new(state),
        }
    }

    /// The newest value of a key; from now on values are wanted.
    pub(super) fn get(&self, key: &K) -> Option<V> {
        let mut state = lock(&self.state);
        if state.asked.len() < self.most || state.asked.contains_key(key) {
            state.asked.insert(key.clone(), Instant::now());
        }
        state.newest.get(key).cloned()
    }

    /// Keys that pages have asked for lately; when there are none, the values that are kept are forgotten.
    pub(super) fn wanted(&self) -> BTreeSet<K> {
        let mut state = lock(&self.state);
        state.asked.retain(|_, asked| asked.elapsed() < WANTED);
        if state.asked.is_empty() {
            state.newest.clear();
            state.left_out.clear();
        }
        state.asked.keys().cloned().collect()
    }

    /// Number of keys whose values are not kept, beyond the largest number.
    pub(super) fn left_out(&self) -> usize {
        lock(&self.state).left_out.len()
    }

    /// Keeps a value.
    pub(super) fn keep(&self, key: K, value: V) {
        let mut state = lock(&self.state);
        if state.newest.len() < self.most || state.newest.contains_key(&key) {
            state.newest.insert(key, value);
        } else if state.left_out.len() < MOST_LEFT_OUT {
            state.left_out.insert(key);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_beyond_the_most_are_counted_once_each() {
        let store = OnDemand::new(3);
        assert!(store.wanted().is_empty());
        for round in 0..2 {
            (0..5).for_each(|key| store.keep(key, round));
        }
        assert_eq!(store.left_out(), 2);
        assert_eq!([2, 4].map(|key| store.get(&key)), [Some(1), None]);
        assert_eq!(store.wanted(), BTreeSet::from([2, 4]));
    }
}
