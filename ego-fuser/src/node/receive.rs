//! Messages from the bus as inputs of the ego's loop: decoded and timed.

use std::time::Instant;

use bus::{Arrival, LINK_TRANSIT_S, NETWORK_TRANSIT_S};
use protocol::message::Descriptor;
use protocol::{CavId, Limits, Stream};

use super::EgoNode;
use crate::capture_clock::SweepTime;
use crate::ego_loop::recorded::{EgoRecord, WireMessage};
use crate::ego_loop::{Input, Reception, Refusal};
use crate::neighbourhood::sender_of;

impl EgoNode<'_> {
    /// Decodes a message and hands it to the loop.
    pub(super) fn admit(&mut self, arrival: &Arrival) {
        let Some((cav, stream)) = sender_of(&arrival.topic) else {
            return;
        };
        if stream == Stream::Descriptor {
            return self.admit_descriptor(cav, arrival);
        }
        let (stats, began) = (self.bus.stats(), Instant::now());
        let transport = stats.transport(arrival, self.longest_transit_s());
        let reception = Reception {
            cav: cav.clone(),
            arrived_nanos: self.clock.nanos(arrival.at),
            transport,
            clock_offset_s: stats.measured_clock_offset_s(cav),
        };
        let (header, limits) = (&arrival.header, &Limits::DEFAULT);
        let ego_loop = &self.ego_loop;
        let decoded = ego_loop.decode(&reception, header, arrival.pieces(), limits);
        let message = match decoded {
            Ok(message) => message,
            Err(Refusal::Unneeded(reason)) => return stats.dropped(&arrival.topic, reason),
            Err(Refusal::Malformed(error)) => return stats.rejected(&arrival.topic, &error),
        };
        stats.timed("decode", began.elapsed());
        if let Some(transport) = transport {
            stats.timed(&format!("{stream} transport"), transport);
        }
        // Read after the decoding, and recorded: the replay gets the time that the loop gets.
        let now_nanos = self.clock.now_nanos();
        if let Some(log) = &self.log {
            let bytes = arrival.pieces().flatten().copied().collect();
            let input = Input::Message(WireMessage { reception, bytes });
            log.add(&EgoRecord::Input { now_nanos, input });
        }
        self.decide(Input::Message(Box::new(message)), now_nanos);
    }

    /// Processes an agent's descriptor: its network, and the arrivals of its sweeps.
    fn admit_descriptor(&mut self, cav: &CavId, arrival: &Arrival) {
        let descriptor = self.inbox.decode::<Descriptor>(arrival, &Limits::DEFAULT);
        let Some(descriptor) = descriptor else {
            return;
        };
        let stats = self.bus.stats();
        let offset_s = stats.system_clock_offset_s(cav, self.longest_transit_s());
        let offset_nanos = (offset_s * 1e9) as i64;
        let newest_nanos = arrival.header.stamp.capture_nanos;
        // Arrivals are on the clock of the agent. Minus its lead they are on that of the ego.
        let sweeps = descriptor.sweeps.iter().map(|sweep| SweepTime {
            capture_nanos: newest_nanos.saturating_sub(sweep.before_nanos),
            arrived_nanos: sweep.arrived_nanos.saturating_sub_signed(offset_nanos),
        });
        self.handle(Input::Sweeps(cav.clone(), sweeps.collect()));
        self.handle(Input::Model(cav.clone(), descriptor));
    }

    /// Longest transit time of a message, seconds; the own agent's, which takes no link, has one clock with the ego.
    fn longest_transit_s(&self) -> f64 {
        match self.options.over_link {
            true => LINK_TRANSIT_S,
            false => NETWORK_TRANSIT_S,
        }
    }
}
