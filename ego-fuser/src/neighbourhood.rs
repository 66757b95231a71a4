//! Who is around: agents found by their liveliness tokens, and the subscriptions to them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use protocol::{CavId, Role, Stream, Topic};
use sim_replay::bus::{Bus, BusError, Inbox, RollCall, Subscription};

/// Neighbours that an ego listens to at most: a flood of tokens must not become a flood of subscriptions.
const MAX_NEIGHBOURS: usize = 64;
/// Frames in a row without a word after which a neighbour is not waited for any more, until it speaks again.
const SILENT_AFTER: u32 = 3;

/// The other agents of the run.
pub(crate) struct Neighbourhood {
    ego: CavId,
    streams: Vec<Stream>,
    over_link: bool,
    allowed: Option<BTreeSet<CavId>>,
    roll_call: RollCall,
    members: BTreeMap<CavId, Member>,
}

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
        let roll_call = RollCall::begin(bus, Role::Agent, 2 * MAX_NEIGHBOURS)?;
        Ok(Self { ego: ego.clone(), streams, over_link, allowed, roll_call, members: BTreeMap::new() })
    }

    /// Follows up on who came and went; those who went are returned.
    pub(crate) fn update(&mut self, bus: &Bus, inbox: &Arc<Inbox>) -> Result<Vec<CavId>, BusError> {
        let mut gone = Vec::new();
        while let Some((cav, is_there)) = self.roll_call.next() {
            if !is_there {
                if self.members.remove(&cav).is_some() {
                    tracing::info!(%cav, "a neighbour has left");
                    gone.push(cav);
                }
            } else if self.is_wanted(&cav) {
                tracing::info!(%cav, "a neighbour has come");
                let topics = self.streams.iter().map(|&stream| heard_on(&self.ego, &cav, stream, self.over_link));
                let subscriptions = topics.map(|topic| bus.subscribe(topic, inbox)).collect::<Result<_, _>>()?;
                self.members.insert(cav, Member { silent_frames: 0, _subscriptions: subscriptions });
            }
        }
        Ok(gone)
    }

    fn is_wanted(&self, cav: &CavId) -> bool {
        *cav != self.ego
            && self.members.len() < MAX_NEIGHBOURS
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
