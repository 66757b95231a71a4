//! Neighbourhood: agents discovered by their liveliness tokens, and the subscriptions to them.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use bus::{Bus, BusError, Inbox, Membership, Subscription};
use protocol::{CavId, Role, Stream, Topic};

use crate::ego_loop::Input;

/// Largest number of subscribed neighbours: a flood of tokens must not become a flood of subscriptions.
const MAX_NEIGHBOURS: usize = 64;
/// Largest number of vehicles that wait for a subscription.
const MAX_QUEUED: usize = 256;

/// The other agents of the run.
pub(crate) struct Neighbourhood {
    ego: CavId,
    streams: Vec<Stream>,
    over_link: bool,
    allowed: Option<BTreeSet<CavId>>,
    membership: Membership,
    members: BTreeMap<CavId, Vec<Subscription>>,
    /// Those to vehicles that have left: the link may still deliver messages of theirs, each of which is counted.
    departed: BTreeMap<CavId, Vec<Subscription>>,
    queue: Queue,
}

/// Vehicles beyond the limit when they joined, first in first out: their tokens are not announced again.
#[derive(Default)]
struct Queue(VecDeque<CavId>);

/// Topic on which an ego receives a vehicle: direct, or behind the link emulation if there is one. Its own agent is
/// always received directly.
pub(crate) fn topic_of(ego: &CavId, cav: &CavId, stream: Stream, over_link: bool) -> Topic {
    match over_link && cav != ego {
        true => Topic::Received {
            ego: ego.clone(),
            cav: cav.clone(),
            stream,
        },
        false => Topic::stream(cav, stream),
    }
}

/// Sender and stream of a topic's messages.
pub(crate) fn sender_of(topic: &Topic) -> Option<(&CavId, Stream)> {
    match topic {
        Topic::Stream { cav, stream } | Topic::Received { cav, stream, .. } => Some((cav, *stream)),
        _ => None,
    }
}

impl Neighbourhood {
    /// Watches for agents other than `ego`'s own, to subscribe to these streams of theirs, behind the link where there
    /// is one; `allowed` restricts them.
    pub(crate) fn watch(
        bus: &Bus,
        ego: &CavId,
        streams: Vec<Stream>,
        over_link: bool,
        allowed: Option<BTreeSet<CavId>>,
    ) -> Result<Self, BusError> {
        let membership = Membership::begin(bus, Role::Agent, 2 * MAX_NEIGHBOURS)?;
        Ok(Self {
            ego: ego.clone(),
            streams,
            over_link,
            allowed,
            membership,
            members: BTreeMap::new(),
            departed: BTreeMap::new(),
            queue: Queue::default(),
        })
    }

    /// Handles agents that joined and left, as inputs of the ego's loop.
    pub(crate) fn update(&mut self, bus: &Bus, inbox: &Arc<Inbox>) -> Result<Vec<Input>, BusError> {
        let mut changes = Vec::new();
        while let Some((cav, is_there)) = self.membership.next() {
            if is_there && self.is_wanted(&cav) {
                self.queue.add(cav);
            } else if !is_there {
                self.queue.remove(&cav);
                if let Some(subscriptions) = self.members.remove(&cav) {
                    tracing::info!(%cav, "a neighbour has left");
                    // Bounded as the members are. Without a link nothing of it is still on its way.
                    if self.over_link && self.departed.len() < MAX_NEIGHBOURS {
                        self.departed.insert(cav.clone(), subscriptions);
                    }
                    changes.push(Input::Left(cav));
                }
            }
            // After each change, as a vehicle that has left makes room for one that waits.
            while let Some(cav) = self.queue.next(self.members.len()) {
                self.subscribe(cav.clone(), bus, inbox)?;
                changes.push(Input::Joined(cav));
            }
        }
        Ok(changes)
    }

    fn subscribe(&mut self, cav: CavId, bus: &Bus, inbox: &Arc<Inbox>) -> Result<(), BusError> {
        tracing::info!(%cav, "a neighbour has joined");
        let subscribe = |&stream: &Stream| {
            let topic = topic_of(&self.ego, &cav, stream, self.over_link);
            bus.subscribe(topic, inbox)
        };
        // A second subscription to a topic would receive every message again.
        let subscriptions = match self.departed.remove(&cav) {
            Some(kept) => kept,
            None => (self.streams.iter().map(subscribe)).collect::<Result<_, _>>()?,
        };
        self.members.insert(cav, subscriptions);
        Ok(())
    }

    /// True for a vehicle that has left while the link may still deliver messages of it.
    pub(crate) fn has_left(&self, cav: &CavId) -> bool {
        self.departed.contains_key(cav)
    }

    fn is_wanted(&self, cav: &CavId) -> bool {
        let allowed = self.allowed.as_ref();
        let is_allowed = allowed.is_none_or(|allowed| allowed.contains(cav));
        *cav != self.ego && !self.members.contains_key(cav) && is_allowed
    }
}

impl Queue {
    /// Queues a vehicle that joined; beyond the limit it is ignored.
    fn add(&mut self, cav: CavId) {
        if self.0.len() >= MAX_QUEUED {
            tracing::warn!(%cav, "more vehicles wait for a subscription than can be queued");
        } else if !self.0.contains(&cav) {
            self.0.push_back(cav);
        }
    }

    /// Removes a vehicle that left.
    fn remove(&mut self, cav: &CavId) {
        self.0.retain(|waiting| waiting != cav);
    }

    /// The vehicle that has waited longest, if there is capacity beside so many members.
    fn next(&mut self, members: usize) -> Option<CavId> {
        self.0.pop_front_if(|_| members < MAX_NEIGHBOURS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cav(number: usize) -> CavId {
        CavId::new(&format!("v{number}")).unwrap()
    }

    #[test]
    fn a_vehicle_that_joined_beyond_the_limit_gets_the_next_free_place() {
        let mut queue = Queue::default();
        [0, 1, 2, 1]
            .into_iter()
            .for_each(|number| queue.add(cav(number)));
        assert_eq!(queue.next(MAX_NEIGHBOURS), None);
        assert_eq!(queue.next(MAX_NEIGHBOURS - 1), Some(cav(0)));
        queue.remove(&cav(1));
        assert_eq!(queue.next(MAX_NEIGHBOURS - 1), Some(cav(2)));
        assert_eq!(queue.next(0), None);
    }

    #[test]
    fn a_flood_of_tokens_is_bounded() {
        let mut queue = Queue::default();
        (0..1000).for_each(|number| queue.add(cav(number)));
        assert_eq!(queue.0.len(), MAX_QUEUED);
    }
}
