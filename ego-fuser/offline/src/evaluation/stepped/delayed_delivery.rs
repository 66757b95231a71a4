//! Messages between the agents and an ego in virtual time: handed over ahead, offered to the air in the order of time,
//! and booked.

use std::collections::{BTreeMap, BTreeSet};

use bus::process_id;
use link::{Delivery, LinkEmulator, Outcome, Packet};
use protocol::{Account, CavId, DropReason, Ledger, ProcessId, RateReason, Role, Stream, Topic};

use ego_fuser::ego::View;

/// A neighbour's message for the ego.
#[derive(Debug, Clone)]
pub(super) struct Envelope {
    pub(super) view: View,
    pub(super) payload_bytes: u64,
    /// Headers and the pose's own message included.
    pub(super) wire_bytes: u64,
}

/// A message that has come.
pub(super) struct Arrived {
    /// When, on the scene's clock.
    pub(super) nanos: u64,
    pub(super) letter: Envelope,
}

/// A message that was handed over; of a pose nothing is of use but its bytes.
struct Kept {
    topic: Topic,
    letter: Option<Envelope>,
}

/// Carries what neighbours send to the ego.
pub(super) struct DelayedDelivery {
    air: LinkEmulator,
    ego: CavId,
    receiver: ProcessId,
    /// Time 0 of the air on the scene's clock.
    began_nanos: u64,
    /// What will be offered, by time and number.
    posted: BTreeMap<(u64, u64), Packet>,
    /// What was handed over and has not come to its end.
    kept: BTreeMap<u64, Kept>,
    next_id: u64,
    /// Which stream letters take.
    stream: Stream,
    ledger: Ledger,
    sent_bytes: u64,
}

impl DelayedDelivery {
    pub(super) fn new(air: LinkEmulator, ego: &CavId, began_nanos: u64) -> Self {
        Self {
            air,
            receiver: process_id(Role::Ego, ego),
            ego: ego.clone(),
            began_nanos,
            posted: BTreeMap::new(),
            kept: BTreeMap::new(),
            next_id: 0,
            stream: Stream::Bev,
            ledger: Ledger::default(),
            sent_bytes: 0,
        }
    }

    /// Hands a pose over that will be sent at `nanos`.
    pub(super) fn post_pose(&mut self, from: &CavId, sequence: u64, bytes: u64, nanos: u64, distance_m: f64) {
        self.hand_over(from, Stream::Pose, sequence, bytes, nanos, distance_m, None);
    }

    /// Hands a message over that will be sent at `nanos`.
    pub(super) fn enqueue(
        &mut self,
        stream: Stream,
        sequence: u64,
        bytes: u64,
        nanos: u64,
        distance_m: f64,
        mut letter: Envelope,
    ) {
        self.stream = stream;
        let clock = self.air.clock();
        letter.view.capture_nanos = clock.shown_since(self.began_nanos, letter.view.capture_nanos);
        let from = letter.view.cav.clone();
        self.hand_over(&from, stream, sequence, bytes, nanos, distance_m, Some(letter));
    }

    /// A map that is handed over was written so that it keeps within a limit.
    pub(super) fn adapted(&mut self, from: &CavId, stream: Stream, reason: RateReason) {
        self.ledger.adapted(&Account::published(topic(from, stream)), reason);
    }

    #[expect(clippy::too_many_arguments, reason = "the fields of a parcel")]
    fn hand_over(
        &mut self,
        from: &CavId,
        stream: Stream,
        sequence: u64,
        bytes: u64,
        nanos: u64,
        distance_m: f64,
        letter: Option<Envelope>,
    ) {
        let id = self.next_id;
        self.next_id += 1;
        self.kept.insert(id, Kept { topic: topic(from, stream), letter });
        let offered_nanos = nanos.saturating_sub(self.began_nanos);
        let (from, to) = (from.clone(), self.ego.clone());
        let parcel = Packet { id, from, to, stream, sequence, bytes, offered_nanos, distance_m };
        self.posted.insert((offered_nanos, id), parcel);
    }

    /// What has come by `nanos`, in the order of time. Everything that is sent until then was handed over.
    pub(super) fn until(&mut self, nanos: u64) -> Vec<Arrived> {
        let nanos = nanos.saturating_sub(self.began_nanos);
        while let Some(entry) = self.posted.first_entry().filter(|entry| entry.key().0 <= nanos) {
            let parcel = entry.remove();
            self.ledger.sent(&Account::published(topic(&parcel.from, parcel.stream)));
            self.sent_bytes += parcel.bytes;
            self.air.offer(parcel);
        }
        self.air.advance(nanos).into_iter().filter_map(|outcome| self.settle(outcome)).collect()
    }

    fn settle(&mut self, outcome: Outcome) -> Option<Arrived> {
        let Outcome { nanos, parcel, fate } = outcome;
        let account = Account::towards(topic(&parcel.from, parcel.stream), &self.receiver);
        let letter = match fate {
            Delivery::Dropped(reason) => {
                self.kept.remove(&parcel.id);
                self.ledger.dropped(&account, reason);
                return None;
            }
            Delivery::Arrived { is_repeated: true, .. } => {
                // The copy is one more message.
                self.ledger.sent(&account);
                self.kept.get(&parcel.id).and_then(|kept| kept.letter.clone())
            }
            Delivery::Arrived { .. } => self.kept.remove(&parcel.id).and_then(|kept| kept.letter),
        };
        match letter {
            Some(letter) => Some(Arrived { nanos: nanos.saturating_add(self.began_nanos), letter }),
            None => {
                self.ledger.received(&account);
                None
            }
        }
    }

    /// The ego has used a message.
    pub(super) fn received(&mut self, cav: &CavId) {
        self.ledger.received(&Account::towards(topic(cav, self.stream), &self.receiver));
    }

    /// The ego has not used a message.
    pub(super) fn dropped(&mut self, cav: &CavId, reason: DropReason) {
        self.ledger.dropped(&Account::towards(topic(cav, self.stream), &self.receiver), reason);
    }

    /// MessageStats what of a vehicle has not come to its end; `waiting` messages of it have arrived and were never used.
    pub(super) fn close(&mut self, cav: &CavId, waiting: u64) {
        let not_sent: BTreeSet<u64> = self.posted.values().map(|parcel| parcel.id).collect();
        for (stream, waiting) in [(Stream::Pose, 0), (self.stream, waiting)] {
            let topic = topic(cav, stream);
            let under_way = self.kept.iter().filter(|(id, kept)| kept.topic == topic && !not_sent.contains(id)).count();
            self.ledger.set_in_flight(&Account::towards(topic, &self.receiver), under_way as u64 + waiting);
        }
    }

    /// Bytes of all that was sent so far, poses included.
    pub(super) fn sent_bytes(&self) -> u64 {
        self.sent_bytes
    }

    /// The books.
    pub(super) fn ledger(&self) -> &Ledger {
        &self.ledger
    }
}

fn topic(cav: &CavId, stream: Stream) -> Topic {
    Topic::Stream { cav: cav.clone(), stream }
}
