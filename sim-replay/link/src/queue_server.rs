//! One queue in front of one sender: who waits, who is on the way, when the last bit of each is sent.

use std::collections::VecDeque;

use protocol::DropReason;

use super::capacity::{Capacity, work};
use super::config::{QueueConfig, QueueDrop};
use super::emulator::Packet;

/// A queue and its sender.
#[derive(Debug, Clone, Default)]
pub(super) struct QueueServer {
    /// All work up to here is used up: what is sent next ends later.
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
    parcel: Packet,
    start_nanos: u64,
    /// Its last bit is sent when so much work could have been done.
    end: u128,
}

/// What became of a parcel here.
#[derive(Debug, Clone)]
pub(super) enum Departure {
    /// Its first and its last bit were sent at these times.
    Sent { parcel: Packet, start_nanos: u64, end_nanos: u64 },
    /// It never was.
    Dropped { parcel: Packet, reason: DropReason, nanos: u64 },
}

/// The rules of a line.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rules<'a> {
    pub(super) capacity: &'a Capacity,
    pub(super) burst_bytes: u64,
    pub(super) queue: &'a QueueConfig,
}

impl QueueServer {
    /// Takes a parcel that is offered now. The line has been advanced to now.
    pub(super) fn offer(&mut self, parcel: Packet, rules: &Rules<'_>, left: &mut Vec<Departure>) {
        let nanos = parcel.offered_nanos;
        if *rules.capacity == Capacity::Unlimited {
            left.push(Departure::Sent { parcel, start_nanos: nanos, end_nanos: nanos });
            return;
        }
        if self.sending.is_none() {
            self.send(parcel, nanos, rules);
            return;
        }
        if parcel.bytes <= rules.queue.urgent_bytes {
            self.cut_in(parcel, rules);
            return;
        }
        if rules.queue.keep_newest {
            self.supersede(&parcel, left);
        }
        let is_full = |line: &Self| line.waiting_bytes.saturating_add(parcel.bytes) > rules.queue.bytes;
        while rules.queue.drop == QueueDrop::Head && is_full(self) {
            let Some(oldest) = self.waiting.pop_front() else { break };
            self.waiting_bytes -= oldest.bytes;
            left.push(Departure::Dropped { parcel: oldest, reason: DropReason::LinkQueue, nanos });
        }
        if is_full(self) {
            left.push(Departure::Dropped { parcel, reason: DropReason::LinkQueue, nanos });
            return;
        }
        self.waiting_bytes += parcel.bytes;
        self.waiting.push_back(parcel);
    }

    /// Goes on until `nanos`; who was sent by then is in `left`, in that order.
    pub(super) fn advance(&mut self, nanos: u64, rules: &Rules<'_>, left: &mut Vec<Departure>) {
        while let Some((end_nanos, is_urgent)) = self.next(rules).filter(|(end_nanos, _)| *end_nanos <= nanos) {
            let sent = if is_urgent { self.urgent.pop_front() } else { self.sending.take() };
            let Some(Sending { parcel, start_nanos, .. }) = sent else { return };
            left.push(Departure::Sent { parcel, start_nanos, end_nanos });
            if !is_urgent && let Some(next) = self.waiting.pop_front() {
                self.waiting_bytes -= next.bytes;
                self.send(next, end_nanos, rules);
            }
        }
    }

    /// When the next last bit is sent.
    pub(super) fn next_nanos(&self, rules: &Rules<'_>) -> Option<u64> {
        self.next(rules).map(|(nanos, _)| nanos)
    }

    /// The same, and whether it is an urgent one's.
    fn next(&self, rules: &Rules<'_>) -> Option<(u64, bool)> {
        let end = |sending: &Sending| rules.capacity.time_of(sending.end).map(|nanos| nanos.max(sending.start_nanos));
        let urgent = self.urgent.front().and_then(end).map(|nanos| (nanos, true));
        let usual = self.sending.as_ref().and_then(end).map(|nanos| (nanos, false));
        match (urgent, usual) {
            (Some(urgent), Some(usual)) => Some(if urgent.0 <= usual.0 { urgent } else { usual }),
            (urgent, usual) => urgent.or(usual),
        }
    }

    fn send(&mut self, parcel: Packet, nanos: u64, rules: &Rules<'_>) {
        // What could have been sent before now is gone, but for the burst.
        let idle = rules.capacity.done_by(nanos).saturating_sub(work(rules.burst_bytes));
        self.used = self.used.max(idle) + work(parcel.bytes);
        self.sending = Some(Sending { parcel, start_nanos: nanos, end: self.used });
    }

    /// Puts an urgent parcel in between: whoever is being sent ends that much later.
    fn cut_in(&mut self, parcel: Packet, rules: &Rules<'_>) {
        let nanos = parcel.offered_nanos;
        let added = work(parcel.bytes);
        self.urgent_used = self.urgent_used.max(rules.capacity.done_by(nanos)) + added;
        self.used += added;
        if let Some(sending) = &mut self.sending {
            sending.end += added;
        }
        self.urgent.push_back(Sending { parcel, start_nanos: nanos, end: self.urgent_used });
    }

    fn supersede(&mut self, newer: &Packet, left: &mut Vec<Departure>) {
        let is_same = |other: &Packet| (&other.from, &other.to, other.stream) == (&newer.from, &newer.to, newer.stream);
        while let Some(place) = self.waiting.iter().position(is_same) {
            let Some(older) = self.waiting.remove(place) else { return };
            self.waiting_bytes -= older.bytes;
            let nanos = newer.offered_nanos;
            left.push(Departure::Dropped { parcel: older, reason: DropReason::Superseded, nanos });
        }
    }
}
