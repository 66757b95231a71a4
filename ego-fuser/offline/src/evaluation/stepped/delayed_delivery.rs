//! Delayed delivery: messages between the agents and an ego in simulation time, handed over ahead, submitted to the
//! link in order of time, and counted.

use std::collections::BTreeMap;

use bus::process_id;
use link::{Delivery, LinkEmulator, Packet, PacketOutcome};
use protocol::{
    Account, CavId, DropReason, HEADER_LEN, Ledger, ProcessId, RateReason, Role, Stream, Topic,
};

use ego_fuser::capture_clock::SweepTime;
use ego_fuser::ego_loop::{Message, Source};
use support::nanos;

use super::super::sent::Sent;
use super::{ComputeTimes, exact_reception};

/// A neighbour's message for the ego.
#[derive(Debug, Clone)]
pub(super) struct Envelope {
    /// The arrival is known once it has arrived.
    pub(super) message: Message,
    /// Its sweep, which arrives at the agent at its capture.
    pub(super) sweep: SweepTime,
}

impl Envelope {
    /// Arrival on the scene's clock, nanoseconds.
    pub(super) fn arrived_nanos(&self) -> u64 {
        self.message.reception.arrived_nanos
    }
}

/// A message that was handed over, with the reason for its format, if it is a feature map that had to keep within a
/// limit; of a pose only the size is needed.
type Pending = (Packet, Option<RateReason>, Option<Envelope>);

/// Delivers the neighbours' messages to the ego.
pub(super) struct DelayedDelivery {
    link: LinkEmulator,
    ego: CavId,
    receiver: ProcessId,
    /// Time 0 of the link on the scene's clock.
    began_nanos: u64,
    /// Messages to be submitted, by time and number.
    pending: BTreeMap<(u64, u64), Pending>,
    /// Messages that were submitted and neither arrived nor were lost yet.
    kept: BTreeMap<u64, (Topic, Option<Envelope>)>,
    next_id: u64,
    /// Number of messages of each stream so far: as in a live run, where a sender counts what it publishes.
    sequences: BTreeMap<Source, u64>,
    /// The message accounting.
    pub(super) ledger: Ledger,
    /// Bytes of all that was sent so far, poses included.
    pub(super) sent_bytes: u64,
}

impl DelayedDelivery {
    /// Delivery of all messages from `began_nanos` on.
    pub(super) fn new(link: LinkEmulator, ego: &CavId, began_nanos: u64) -> Self {
        Self {
            link,
            receiver: process_id(Role::Ego, ego),
            ego: ego.clone(),
            began_nanos,
            pending: BTreeMap::new(),
            kept: BTreeMap::new(),
            next_id: 0,
            sequences: BTreeMap::new(),
            ledger: Ledger::default(),
            sent_bytes: 0,
        }
    }

    /// Hands over a neighbour's messages for a tick: its pose as soon as it is known, the rest when it is computed.
    pub(super) fn enqueue(&mut self, mut sent: Sent, compute: &ComputeTimes, distance_m: f64) {
        let pose = Packet {
            id: 0,
            from: sent.cav.clone(),
            to: self.ego.clone(),
            stream: Stream::Pose,
            sequence: 0,
            bytes: sent.pose_bytes,
            submitted_nanos: nanos::of_ms(compute.pose_ms).saturating_add(sent.capture_nanos),
            distance_m,
        };
        self.hand_over(pose.clone(), None, None);
        for message in std::mem::take(&mut sent.messages) {
            let packet = Packet {
                stream: message.content.exchange().stream(),
                bytes: message.bytes,
                submitted_nanos: sent.capture_nanos.saturating_add(compute.agent_nanos()),
                ..pose.clone()
            };
            let adapted = message.rate.map(|rate| rate.reason);
            let mut view = sent.view(message.content);
            // The sender stamps by its own clock, which may be wrong.
            let clock = self.link.clock();
            view.capture_nanos = clock.shown_since(self.began_nanos, sent.capture_nanos);
            let sweep = SweepTime {
                capture_nanos: view.capture_nanos,
                arrived_nanos: sent.capture_nanos,
            };
            let message = Message {
                reception: exact_reception(&view.cav, 0),
                view,
                sequence: 0,
                // The payload is without the header; on the wire the pose message counts too.
                payload_bytes: message.bytes - HEADER_LEN as u64,
                wire_bytes: message.bytes + sent.pose_bytes,
            };
            self.hand_over(packet, adapted, Some(Envelope { message, sweep }));
        }
    }

    fn hand_over(
        &mut self,
        mut packet: Packet,
        adapted: Option<RateReason>,
        envelope: Option<Envelope>,
    ) {
        let source = (packet.from.clone(), packet.stream);
        let count = self.sequences.entry(source).or_default();
        packet.sequence = *count;
        *count += 1;
        packet.id = self.next_id;
        packet.submitted_nanos = packet.submitted_nanos.saturating_sub(self.began_nanos);
        self.next_id += 1;
        // By time, then by number: messages of one time keep their order.
        let place = (packet.submitted_nanos, packet.id);
        self.pending.insert(place, (packet, adapted, envelope));
    }

    /// Arrivals by `nanos`, in order of time. All messages that are sent until then have been handed over.
    pub(super) fn until(&mut self, nanos: u64) -> Vec<Envelope> {
        let nanos = nanos.saturating_sub(self.began_nanos);
        while let Some(entry) = self.pending.first_entry()
            && entry.key().0 <= nanos
        {
            let (packet, adapted, envelope) = entry.remove();
            let topic = Topic::stream(&packet.from, packet.stream);
            let account = Account::published(topic.clone());
            self.ledger.sent(&account);
            if let Some(reason) = adapted {
                self.ledger.adapted(&account, reason);
            }
            self.sent_bytes += packet.bytes;
            self.kept.insert(packet.id, (topic, envelope));
            self.link.submit(packet);
        }
        let outcomes = self.link.advance(nanos).into_iter();
        outcomes.filter_map(|it| self.settle(it)).collect()
    }

    fn settle(&mut self, outcome: PacketOutcome) -> Option<Envelope> {
        let packet = outcome.packet;
        let topic = Topic::stream(&packet.from, packet.stream);
        let account = Account::towards(topic, &self.receiver);
        let envelope = match outcome.delivery {
            Delivery::Dropped(reason) => {
                self.kept.remove(&packet.id);
                self.ledger.dropped(&account, reason);
                return None;
            }
            // The receiver has the message already, and refuses its copy: neither sent nor lost.
            Delivery::Arrived { is_copy: true, .. } => return None,
            Delivery::Arrived { .. } => self.kept.remove(&packet.id).and_then(|kept| kept.1),
        };
        let Some(mut envelope) = envelope else {
            // A pose has no envelope: its arrival is only counted.
            self.ledger.received(&account);
            return None;
        };
        envelope.message.reception.arrived_nanos = outcome.nanos.saturating_add(self.began_nanos);
        Some(envelope)
    }

    /// The ego has used a message, or not for a reason. That of its own agent takes no link.
    pub(super) fn count(&mut self, (cav, stream): &Source, reason: Option<DropReason>) {
        if *cav != self.ego {
            let account = Account::towards(Topic::stream(cav, *stream), &self.receiver);
            match reason {
                Some(reason) => self.ledger.dropped(&account, reason),
                None => self.ledger.received(&account),
            }
        }
    }

    /// Counts the messages of a vehicle's stream that neither arrived nor were lost; `waiting` of them have arrived and
    /// were never used.
    pub(super) fn close(&mut self, (cav, stream): &Source, waiting: u64) {
        // Handed over ahead but not submitted by the end: these count as not sent.
        let topic = Topic::stream(cav, *stream);
        let of_stream = self.kept.values().filter(|(of, _)| *of == topic);
        let under_way = of_stream.count() as u64;
        let account = Account::towards(topic, &self.receiver);
        self.ledger.set_in_flight(&account, under_way + waiting);
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use ego_fuser::ego::Content;
    use link::LinkConfig;
    use localization::pose_source::NO_SOURCE;
    use protocol::RateChoice;

    use super::super::super::sent::SentMessage;
    use super::*;

    fn delivery() -> DelayedDelivery {
        let link = LinkEmulator::new(LinkConfig::default(), Path::new("."), 0).unwrap();
        DelayedDelivery::new(link, &CavId::new("1").unwrap(), 0)
    }

    /// A pose and boxes of a vehicle, which are adapted.
    fn sent(cav: &CavId, capture_nanos: u64) -> Sent {
        let message = SentMessage {
            content: Content::Boxes(Vec::new()),
            bytes: 100,
            rate: Some(RateChoice {
                reason: RateReason::Fits,
                limit_bytes: 100,
            }),
        };
        Sent {
            cav: cav.clone(),
            capture_nanos,
            pose: NO_SOURCE,
            pose_bytes: 100,
            messages: vec![message],
            failure: None,
        }
    }

    #[test]
    fn messages_are_counted_by_stream_from_the_first_of_the_run_as_live_senders_do() {
        let mut delivery = delivery();
        let [one, other] = ["2", "3"].map(|name| CavId::new(name).unwrap());
        // The second vehicle has no sweep at the first of the two times.
        for (cav, nanos) in [(&one, 500), (&one, 600), (&other, 600)] {
            delivery.enqueue(sent(cav, nanos), &ComputeTimes::default(), 1.0);
        }
        let packets = delivery.pending.values().map(|(packet, ..)| packet);
        let numbers: Vec<_> = packets
            .map(|packet| (packet.from.as_str(), packet.stream, packet.sequence))
            .collect();
        let (pose, boxes) = (Stream::Pose, Stream::Boxes);
        let expected = [
            ("2", pose, 0),
            ("2", boxes, 0),
            ("2", pose, 1),
            ("2", boxes, 1),
            ("3", pose, 0),
            ("3", boxes, 0),
        ];
        assert_eq!(numbers, expected);
    }

    #[test]
    fn a_copy_made_by_the_link_is_neither_sent_nor_lost() {
        let mut delivery = delivery();
        let config = LinkConfig {
            duplicate: 1.0,
            ..LinkConfig::default()
        };
        delivery.link = LinkEmulator::new(config, Path::new("."), 0).unwrap();
        let cav = CavId::new("2").unwrap();
        delivery.enqueue(sent(&cav, 1), &ComputeTimes::default(), 1.0);
        assert_eq!(delivery.until(1_000_000).len(), 1);
        let total = delivery.ledger.total();
        // The pose is received on arrival, the boxes when the ego uses them.
        assert_eq!((total.sent, total.received), (2, 1));
    }

    #[test]
    fn a_message_that_is_not_submitted_is_not_counted_as_adapted() {
        let mut delivery = delivery();
        let cav = CavId::new("2").unwrap();
        delivery.enqueue(sent(&cav, 1), &ComputeTimes::default(), 1.0);
        let account = Account::published(Topic::stream(&cav, Stream::Boxes));
        assert_eq!(delivery.ledger.get(&account), None);
        delivery.until(1);
        let counts = delivery.ledger.get(&account).unwrap();
        assert_eq!((counts.sent, counts.adapted[&RateReason::Fits]), (1, 1));
    }
}
