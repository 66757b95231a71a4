//! Delayed delivery: messages between the agents and an ego in simulation time, handed over ahead, submitted to the
//! link in order of time, and counted.

use std::collections::{BTreeMap, BTreeSet};

use bus::process_id;
use link::{Delivery, LinkEmulator, Outcome, Packet};
use protocol::{Account, CavId, DropReason, Ledger, ProcessId, RateReason, Role, Stream, Topic};

use ego_fuser::capture_clock::SweepTime;
use ego_fuser::ego::View;

/// A neighbour's message for the ego.
#[derive(Debug, Clone)]
pub(super) struct Envelope {
    pub(super) view: View,
    /// Its sweep, which arrives at the agent at its capture.
    pub(super) sweep: SweepTime,
    pub(super) payload_bytes: u64,
    /// Headers and the pose message included.
    pub(super) wire_bytes: u64,
}

/// A message that has arrived.
pub(super) struct Arrived {
    /// Arrival on the scene's clock, nanoseconds.
    pub(super) nanos: u64,
    pub(super) envelope: Envelope,
}

/// A message that was handed over; of a pose only the size is needed.
struct Kept {
    topic: Topic,
    envelope: Option<Envelope>,
}

/// Delivers the neighbours' messages to the ego.
pub(super) struct DelayedDelivery {
    link: LinkEmulator,
    ego: CavId,
    receiver: ProcessId,
    /// Time 0 of the link on the scene's clock.
    began_nanos: u64,
    /// Messages to be submitted, by time and number.
    pending: BTreeMap<(u64, u64), Packet>,
    /// Messages that were handed over and neither arrived nor were lost yet.
    kept: BTreeMap<u64, Kept>,
    next_id: u64,
    /// Stream of the messages.
    stream: Stream,
    ledger: Ledger,
    sent_bytes: u64,
}

impl DelayedDelivery {
    pub(super) fn new(link: LinkEmulator, ego: &CavId, began_nanos: u64) -> Self {
        Self {
            link,
            receiver: process_id(Role::Ego, ego),
            ego: ego.clone(),
            began_nanos,
            pending: BTreeMap::new(),
            kept: BTreeMap::new(),
            next_id: 0,
            stream: Stream::Bev,
            ledger: Ledger::default(),
            sent_bytes: 0,
        }
    }

    /// Hands over a pose that will be sent at `nanos`.
    pub(super) fn enqueue_pose(
        &mut self,
        from: &CavId,
        sequence: u64,
        bytes: u64,
        nanos: u64,
        distance_m: f64,
    ) {
        self.hand_over(from, Stream::Pose, sequence, bytes, nanos, distance_m, None);
    }

    /// Hands over a message that will be sent at `nanos`.
    pub(super) fn enqueue(
        &mut self,
        stream: Stream,
        sequence: u64,
        bytes: u64,
        nanos: u64,
        distance_m: f64,
        mut envelope: Envelope,
    ) {
        self.stream = stream;
        let clock = self.link.clock();
        envelope.view.capture_nanos =
            clock.shown_since(self.began_nanos, envelope.view.capture_nanos);
        envelope.sweep.capture_nanos = envelope.view.capture_nanos;
        let from = envelope.view.cav.clone();
        let envelope = Some(envelope);
        self.hand_over(&from, stream, sequence, bytes, nanos, distance_m, envelope);
    }

    /// Counts a map that the rate control has adapted.
    pub(super) fn adapted(&mut self, from: &CavId, stream: Stream, reason: RateReason) {
        self.ledger
            .adapted(&Account::published(topic(from, stream)), reason);
    }

    #[expect(clippy::too_many_arguments, reason = "the fields of a packet")]
    fn hand_over(
        &mut self,
        from: &CavId,
        stream: Stream,
        sequence: u64,
        bytes: u64,
        nanos: u64,
        distance_m: f64,
        envelope: Option<Envelope>,
    ) {
        let id = self.next_id;
        self.next_id += 1;
        let topic = topic(from, stream);
        self.kept.insert(id, Kept { topic, envelope });
        let submitted_nanos = nanos.saturating_sub(self.began_nanos);
        let packet = Packet {
            id,
            from: from.clone(),
            to: self.ego.clone(),
            stream,
            sequence,
            bytes,
            submitted_nanos,
            distance_m,
        };
        self.pending.insert((submitted_nanos, id), packet);
    }

    /// Arrivals by `nanos`, in order of time. All messages that are sent until then have been handed over.
    pub(super) fn until(&mut self, nanos: u64) -> Vec<Arrived> {
        let nanos = nanos.saturating_sub(self.began_nanos);
        while let Some(entry) = self
            .pending
            .first_entry()
            .filter(|entry| entry.key().0 <= nanos)
        {
            let packet = entry.remove();
            self.ledger
                .sent(&Account::published(topic(&packet.from, packet.stream)));
            self.sent_bytes += packet.bytes;
            self.link.submit(packet);
        }
        self.link
            .advance(nanos)
            .into_iter()
            .filter_map(|outcome| self.settle(outcome))
            .collect()
    }

    fn settle(&mut self, outcome: Outcome) -> Option<Arrived> {
        let packet = outcome.packet;
        let account = Account::towards(topic(&packet.from, packet.stream), &self.receiver);
        let envelope = match outcome.delivery {
            Delivery::Dropped(reason) => {
                self.kept.remove(&packet.id);
                self.ledger.dropped(&account, reason);
                return None;
            }
            Delivery::Arrived {
                is_repeated: true, ..
            } => {
                // The copy counts as one more message.
                self.ledger.sent(&account);
                self.kept
                    .get(&packet.id)
                    .and_then(|kept| kept.envelope.clone())
            }
            Delivery::Arrived { .. } => self.kept.remove(&packet.id).and_then(|kept| kept.envelope),
        };
        if envelope.is_none() {
            self.ledger.received(&account);
        }
        let nanos = outcome.nanos.saturating_add(self.began_nanos);
        envelope.map(|envelope| Arrived { nanos, envelope })
    }

    /// The ego has used a message. That of its own agent takes no link.
    pub(super) fn received(&mut self, cav: &CavId) {
        if *cav != self.ego {
            let account = Account::towards(topic(cav, self.stream), &self.receiver);
            self.ledger.received(&account);
        }
    }

    /// The ego has not used a message. That of its own agent takes no link.
    pub(super) fn dropped(&mut self, cav: &CavId, reason: DropReason) {
        if *cav != self.ego {
            let account = Account::towards(topic(cav, self.stream), &self.receiver);
            self.ledger.dropped(&account, reason);
        }
    }

    /// Counts a vehicle's messages that neither arrived nor were lost; `waiting` messages of it have arrived and were
    /// never used.
    pub(super) fn close(&mut self, cav: &CavId, waiting: u64) {
        let not_sent: BTreeSet<u64> = self.pending.values().map(|packet| packet.id).collect();
        for (stream, waiting) in [(Stream::Pose, 0), (self.stream, waiting)] {
            let topic = topic(cav, stream);
            let is_under_way =
                |(id, kept): &(&u64, &Kept)| kept.topic == topic && !not_sent.contains(id);
            let under_way = self.kept.iter().filter(is_under_way).count() as u64;
            let account = Account::towards(topic, &self.receiver);
            self.ledger.set_in_flight(&account, under_way + waiting);
        }
    }

    /// Bytes of all that was sent so far, poses included.
    pub(super) fn sent_bytes(&self) -> u64 {
        self.sent_bytes
    }

    /// The message accounting.
    pub(super) fn ledger(&self) -> &Ledger {
        &self.ledger
    }
}

fn topic(cav: &CavId, stream: Stream) -> Topic {
    Topic::Stream {
        cav: cav.clone(),
        stream,
    }
}
