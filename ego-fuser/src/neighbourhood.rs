//! Who is around: agents found by their liveliness tokens, and the subscriptions to them.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use bus::{Bus, BusError, Inbox, Membership, Subscription};
use protocol::{CavId, Role, Stream, Topic};

/// Neighbours that an ego listens to at most: a flood of tokens must not become a flood of subscriptions.
const MAX_NEIGHBOURS: usize = 64;
/// Vehicles that are remembered at most while there is no place for them.
const MAX_QUEUED: usize = 256;
/// Frames in a row without a word after which a neighbour is not waited for any more, until it speaks again.
const SILENT_AFTER: u32 = 3;

/// The other agents of the run.
pub(crate) struct Neighbourhood {
    ego: CavId,
    streams: Vec<Stream>,
    over_link: bool,
    allowed: Option<BTreeSet<CavId>>,
    roll_call: Membership,
    members: BTreeMap<CavId, Member>,
    queue: Queue,
}

/// Vehicles for which there was no place when they came, first come first: their tokens are not told of again.
#[derive(Default)]
struct Queue(VecDeque<CavId>);

struct Member {
    silent_frames: u32,
    _subscriptions: Vec<Subscription>,
}

/// Where an ego hears a vehicle: directly, or behind the emulated air if there is one. Its own agent it always hears
/// directly.
pub(crate) fn heard_on(ego: &CavId, cav: &CavId, stream: Stream, over_link: bool) -> Topic {
    if over_link && cav != ego {
        Topic::Received { ego: ego.clone(), cav: cav.clone(), stream }
    } else {
        Topic::Stream { cav: cav.clone(), stream }
    }
}

/// Whose message a topic carries, and which.
pub(crate) fn sender_of(topic: &Topic) -> Option<(&CavId, Stream)> {
    match topic {
        Topic::Stream { cav, stream } | Topic::Received { cav, stream, .. } => Some((cav, *stream)),
        _ => None,
    }
}

impl Neighbourhood {
    /// Watches for agents other than `ego`'s own, to listen to these streams of theirs, behind the link where there is
    /// one; `allowed` restricts them.
    pub(crate) fn watch(
        bus: &Bus,
        ego: &CavId,
        streams: Vec<Stream>,
        over_link: bool,
        allowed: Option<BTreeSet<CavId>>,
    ) -> Result<Self, BusError> {
        let roll_call = Membership::begin(bus, Role::Agent, 2 * MAX_NEIGHBOURS)?;
        let (members, queue) = (BTreeMap::new(), Queue::default());
        Ok(Self { ego: ego.clone(), streams, over_link, allowed, roll_call, members, queue })
    }

    /// Follows up on who came and went; those who went are returned.
    pub(crate) fn update(&mut self, bus: &Bus, inbox: &Arc<Inbox>) -> Result<Vec<CavId>, BusError> {
        let mut gone = Vec::new();
        while let Some((cav, is_there)) = self.roll_call.next() {
            if is_there && self.is_wanted(&cav) {
                self.queue.add(cav);
            } else if !is_there {
                self.queue.remove(&cav);
                if self.members.remove(&cav).is_some() {
                    tracing::info!(%cav, "a neighbour has left");
                    gone.push(cav);
                }
            }
            while let Some(cav) = self.queue.next(self.members.len()) {
                self.listen_to(cav, bus, inbox)?;
            }
        }
        Ok(gone)
    }

    fn listen_to(&mut self, cav: CavId, bus: &Bus, inbox: &Arc<Inbox>) -> Result<(), BusError> {
        tracing::info!(%cav, "a neighbour has come");
        let topics = self.streams.iter().map(|&stream| heard_on(&self.ego, &cav, stream, self.over_link));
        let subscriptions = topics.map(|topic| bus.subscribe(topic, inbox)).collect::<Result<_, _>>()?;
        self.members.insert(cav, Member { silent_frames: 0, _subscriptions: subscriptions });
        Ok(())
    }

    fn is_wanted(&self, cav: &CavId) -> bool {
        *cav != self.ego
            && !self.members.contains_key(cav)
            && self.allowed.as_ref().is_none_or(|allowed| allowed.contains(cav))
    }

    /// Everyone who is there.
    pub(crate) fn members(&self) -> impl Iterator<Item = &CavId> {
        self.members.keys()
    }

    /// Those whose word a frame waits for.
    pub(crate) fn awaited(&self) -> impl Iterator<Item = &CavId> {
        self.members.iter().filter(|(_, member)| member.silent_frames < SILENT_AFTER).map(|(cav, _)| cav)
    }

    /// A message came from `cav`.
    pub(crate) fn spoke(&mut self, cav: &CavId) {
        if let Some(member) = self.members.get_mut(cav) {
            member.silent_frames = 0;
        }
    }

    /// A frame was decided without a word of `cav` for it.
    pub(crate) fn was_silent(&mut self, cav: &CavId) {
        if let Some(member) = self.members.get_mut(cav) {
            member.silent_frames = member.silent_frames.saturating_add(1);
        }
    }
}

impl Queue {
    /// Somebody has come. Of too many the last are passed over.
    fn add(&mut self, cav: CavId) {
        if self.0.len() >= MAX_QUEUED {
            tracing::warn!(%cav, "more vehicles wait to be listened to than can be remembered");
        } else if !self.0.contains(&cav) {
            self.0.push_back(cav);
        }
    }

    /// Somebody has gone.
    fn remove(&mut self, cav: &CavId) {
        self.0.retain(|waiting| waiting != cav);
    }

    /// Who has waited longest, where there is a place beside so many members.
    fn next(&mut self, members: usize) -> Option<CavId> {
        if members < MAX_NEIGHBOURS { self.0.pop_front() } else { None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cav(number: usize) -> CavId {
        CavId::new(&format!("v{number}")).unwrap()
    }

    #[test]
    fn who_came_while_there_was_no_place_gets_the_next_that_is_free() {
        let mut queue = Queue::default();
        [0, 1, 2, 1].into_iter().for_each(|number| queue.add(cav(number)));
        assert_eq!(queue.next(MAX_NEIGHBOURS), None);
        assert_eq!(queue.next(MAX_NEIGHBOURS - 1), Some(cav(0)));
        queue.remove(&cav(1));
        assert_eq!(queue.next(MAX_NEIGHBOURS - 1), Some(cav(2)));
        assert_eq!(queue.next(0), None);
    }

    #[test]
    fn a_flood_of_tokens_is_not_remembered() {
        let mut queue = Queue::default();
        (0..1000).for_each(|number| queue.add(cav(number)));
        assert_eq!(queue.0.len(), MAX_QUEUED);
    }
}
