//! Queue and server of one sender: waiting packets, the packet being sent, and departure times.

use std::collections::VecDeque;

use super::capacity::{ServiceCurve, work};
use super::config::{QueueConfig, QueueDrop};
use super::packet::Packet;

/// A queue and its sender.
#[derive(Debug, Clone, Default)]
pub(super) struct QueueServer {
    /// All work up to here is used: the next packet ends later. Work counts from a full burst at the beginning.
    used: u128,
    sending: Option<Sending>,
    /// A larger packet, which is sent on when no urgent one waits any more.
    interrupted: Option<Sending>,
    /// In order of submission. Urgent ones are sent first, each of both kinds in this order.
    waiting: VecDeque<Packet>,
    waiting_bytes: u64,
}

#[derive(Debug, Clone)]
struct Sending {
    packet: Packet,
    start_nanos: u64,
    /// Its last bit is sent when this much work could have been done, the burst included.
    end: u128,
}

/// A packet that leaves the queue.
#[derive(Debug, Clone)]
pub(super) enum Departure {
    /// The packet, and the times at which its first and its last bit were sent, nanoseconds.
    Sent(Packet, [u64; 2]),
    /// The packet was dropped when another was submitted, or on its own submission.
    Dropped(Packet),
}

/// Parameters of a queue.
#[derive(Debug)]
pub(super) struct Rules {
    pub(super) capacity: ServiceCurve,
    pub(super) burst_bytes: u64,
    pub(super) queue: QueueConfig,
}

impl Rules {
    fn is_urgent(&self, packet: &Packet) -> bool {
        packet.bytes <= self.queue.urgent_bytes
    }
}

impl QueueServer {
    /// Submits a packet now. The queue has been advanced to now.
    pub(super) fn submit(&mut self, packet: Packet, rules: &Rules, left: &mut Vec<Departure>) {
        let nanos = packet.submitted_nanos;
        if rules.capacity == ServiceCurve::Unlimited {
            left.push(Departure::Sent(packet, [nanos; 2]));
            return;
        }
        let done = rules.capacity.done_by(nanos);
        // Before the limits of the queue: an idle sender takes a packet of any size.
        if self.sending.is_none() {
            // Capacity unused before now is lost, except for the burst.
            self.send(packet, nanos, self.used.max(done));
            return;
        }
        // Before the queue is measured: the bytes of the replaced message make room for the new one.
        if rules.queue.keep_last {
            self.supersede(&packet, left);
        }
        let is_larger = |sending: &mut Sending| !rules.is_urgent(&sending.packet);
        if rules.is_urgent(&packet)
            && let Some(larger) = self.sending.take_if(is_larger)
        {
            self.interrupted = Some(larger);
            self.send(packet, nanos, done + work(rules.burst_bytes));
            return;
        }
        // A packet larger than the whole queue empties it and is dropped itself below.
        while rules.queue.drop == QueueDrop::Head && self.is_full_for(&packet, rules) {
            let Some(oldest) = self.waiting.pop_front() else {
                break;
            };
            self.waiting_bytes -= oldest.bytes;
            left.push(Departure::Dropped(oldest));
        }
        if self.is_full_for(&packet, rules) {
            left.push(Departure::Dropped(packet));
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
        while let Some(end_nanos) = self.next_nanos(rules)
            && end_nanos <= nanos
            && let Some(sent) = self.sending.take()
        {
            self.used = sent.end;
            let sent_nanos = [sent.start_nanos, end_nanos];
            left.push(Departure::Sent(sent.packet, sent_nanos));
            self.send_next(end_nanos, rules);
        }
    }

    /// Time at which the next last bit is sent.
    pub(super) fn next_nanos(&self, rules: &Rules) -> Option<u64> {
        let sending = self.sending.as_ref()?;
        let from_rate = sending.end.saturating_sub(work(rules.burst_bytes));
        // With a burst the work may have been available before the packet was submitted.
        Some(rules.capacity.time_of(from_rate)?.max(sending.start_nanos))
    }

    /// The oldest urgent packet, else the interrupted one, else the oldest.
    fn send_next(&mut self, nanos: u64, rules: &Rules) {
        let mut waiting = self.waiting.iter();
        let urgent = waiting.position(|packet| rules.is_urgent(packet));
        if urgent.is_none() && self.interrupted.is_some() {
            self.sending = self.interrupted.take();
        } else if let Some(next) = self.waiting.remove(urgent.unwrap_or(0)) {
            self.waiting_bytes -= next.bytes;
            self.send(next, nanos, self.used);
        }
    }

    /// Begins to send a packet behind the work `before`.
    fn send(&mut self, packet: Packet, start_nanos: u64, before: u128) {
        let added = work(packet.bytes);
        // The capacity that an urgent packet takes is missing to the interrupted one: no rate is created.
        if let Some(interrupted) = &mut self.interrupted {
            interrupted.end += added;
        }
        self.sending = Some(Sending {
            packet,
            start_nanos,
            end: before + added,
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
            left.push(Departure::Dropped(older));
        }
    }
}
