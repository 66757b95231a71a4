//! Queue and server of one sender: waiting packets, the packet being sent, and departure times.

use std::collections::VecDeque;

use protocol::DropReason;

use super::capacity::{ServiceCurve, work};
use super::config::{QueueConfig, QueueDrop};
use super::packet::Packet;

/// A queue and its sender.
#[derive(Debug, Clone, Default)]
pub(super) struct QueueServer {
    /// All work up to here is used: the next packet ends later.
    used: u128,
    /// The same for urgent messages among themselves.
    urgent_used: u128,
    sending: Option<Sending>,
    urgent: VecDeque<Sending>,
    waiting: VecDeque<Packet>,
    waiting_bytes: u64,
}

#[derive(Debug, Clone)]
struct Sending {
    packet: Packet,
    start_nanos: u64,
    /// Its last bit is sent when this much work could have been done.
    end: u128,
}

/// A packet that leaves the queue.
#[derive(Debug, Clone)]
pub(super) enum Departure {
    /// The packet, and the times at which its first and its last bit were sent, nanoseconds.
    Sent(Packet, [u64; 2]),
    /// The packet was dropped when another was submitted, or on its own submission.
    Dropped(Packet, DropReason),
}

/// Parameters of a queue.
#[derive(Debug)]
pub(super) struct Rules {
    pub(super) capacity: ServiceCurve,
    pub(super) burst_bytes: u64,
    pub(super) queue: QueueConfig,
}

impl QueueServer {
    /// Submits a packet now. The queue has been advanced to now.
    pub(super) fn submit(&mut self, packet: Packet, rules: &Rules, left: &mut Vec<Departure>) {
        let nanos = packet.submitted_nanos;
        if rules.capacity == ServiceCurve::Unlimited {
            left.push(Departure::Sent(packet, [nanos; 2]));
            return;
        }
        // Before the limits of the queue: an idle sender takes a packet of any size.
        if self.sending.is_none() {
            self.send(packet, nanos, rules);
            return;
        }
        if packet.bytes <= rules.queue.urgent_bytes {
            self.cut_in(packet, rules);
            return;
        }
        // Before the queue is measured: the bytes of the replaced message make room for the new one.
        if rules.queue.keep_last {
            self.supersede(&packet, left);
        }
        // A packet larger than the whole queue empties it and is dropped itself below.
        while rules.queue.drop == QueueDrop::Head && self.is_full_for(&packet, rules) {
            let Some(oldest) = self.waiting.pop_front() else {
                break;
            };
            self.waiting_bytes -= oldest.bytes;
            left.push(Departure::Dropped(oldest, DropReason::LinkQueue));
        }
        if self.is_full_for(&packet, rules) {
            left.push(Departure::Dropped(packet, DropReason::LinkQueue));
            return;
        }
        self.waiting_bytes += packet.bytes;
        self.waiting.push_back(packet);
    }

    fn is_full_for(&self, packet: &Packet, rules: &Rules) -> bool {
        self.waiting_bytes.saturating_add(packet.bytes) > rules.queue.bytes
    }

    /// Advances to `nanos`; the packets sent by then are added to `left`, in that order.
    pub(super) fn advance(&mut self, nanos: u64, rules: &Rules, left: &mut Vec<Departure>) {
        while let Some((end_nanos, is_urgent)) = self.next(rules)
            && end_nanos <= nanos
        {
            let sent = match is_urgent {
                true => self.urgent.pop_front(),
                false => self.sending.take(),
            };
            let Some(sent) = sent else { return };
            let sent_nanos = [sent.start_nanos, end_nanos];
            left.push(Departure::Sent(sent.packet, sent_nanos));
            // Urgent packets share the rate with the one being sent and do not free the sender.
            if !is_urgent && let Some(next) = self.waiting.pop_front() {
                self.waiting_bytes -= next.bytes;
                self.send(next, end_nanos, rules);
            }
        }
    }

    /// Time at which the next last bit is sent.
    pub(super) fn next_nanos(&self, rules: &Rules) -> Option<u64> {
        self.next(rules).map(|(nanos, _)| nanos)
    }

    /// The same, with true for an urgent packet.
    fn next(&self, rules: &Rules) -> Option<(u64, bool)> {
        let urgent = self.urgent.front().map(|sending| (sending, true));
        let usual = self.sending.as_ref().map(|sending| (sending, false));
        let ends = urgent.into_iter().chain(usual);
        let ends = ends.filter_map(|(sending, is_urgent)| {
            // With a burst the work may have been available before the packet was submitted.
            let end_nanos = rules.capacity.time_of(sending.end)?;
            Some((end_nanos.max(sending.start_nanos), is_urgent))
        });
        // Of two at the same time the first, which is the urgent one.
        ends.min_by_key(|(nanos, _)| *nanos)
    }

    fn send(&mut self, packet: Packet, nanos: u64, rules: &Rules) {
        // Capacity unused before now is lost, except for the burst.
        let done = rules.capacity.done_by(nanos);
        let idle = done.saturating_sub(work(rules.burst_bytes));
        self.used = self.used.max(idle) + work(packet.bytes);
        self.sending = Some(Sending {
            packet,
            start_nanos: nanos,
            end: self.used,
        });
    }

    /// Inserts an urgent packet: the end of the packet being sent is delayed by its duration.
    fn cut_in(&mut self, packet: Packet, rules: &Rules) {
        let nanos = packet.submitted_nanos;
        let added = work(packet.bytes);
        self.urgent_used = self.urgent_used.max(rules.capacity.done_by(nanos)) + added;
        // The capacity that the urgent packet takes is missing to all others: no rate is created.
        self.used += added;
        if let Some(sending) = &mut self.sending {
            sending.end += added;
        }
        self.urgent.push_back(Sending {
            packet,
            start_nanos: nanos,
            end: self.urgent_used,
        });
    }

    fn supersede(&mut self, newer: &Packet, left: &mut Vec<Departure>) {
        while let Some(place) = self.waiting.iter().position(|other| {
            (&other.from, &other.to, other.stream) == (&newer.from, &newer.to, newer.stream)
        }) {
            let Some(older) = self.waiting.remove(place) else {
                return;
            };
            self.waiting_bytes -= older.bytes;
            left.push(Departure::Dropped(older, DropReason::Superseded));
        }
    }
}
