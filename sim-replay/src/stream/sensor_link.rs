//! Sensor link: link emulation between a replayed sensor and its vehicle's agent.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

use protocol::{CavId, DropReason, HEADER_LEN, Stream};
use serde::Serialize;

use dataset::frame::Frame;
use link::{Delivery, LinkConfig, LinkEmulator, LinkError, Packet};
use support::nanos;

/// x, y, z and intensity of a point, bytes; for a radar's its velocity.
const POINT_BYTES: u64 = 16;

/// Counters of replayed sensor frames on the link.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize)]
pub struct SensorLinkReport {
    /// Frames submitted.
    pub submitted: u64,
    /// Frames that reached their agent, copies counted.
    pub arrived: u64,
    /// Frames that did not reach their agent, by reason.
    pub dropped: BTreeMap<DropReason, u64>,
}

/// A frame on its way to its agent.
#[derive(Debug, Clone)]
pub(super) struct Sweep {
    /// Index of the vehicle among those that take part.
    pub(super) agent: usize,
    pub(super) capture_nanos: u64,
    pub(super) frame: Frame,
}

/// Frames in flight to the agents.
pub(super) struct SensorLink {
    emulator: LinkEmulator,
    held: BTreeMap<u64, Sweep>,
    next_id: u64,
    /// By vehicle, as for its own messages: losses must not depend on the other vehicles.
    next_sequences: BTreeMap<CavId, u64>,
    began: Instant,
    pub(super) report: SensorLinkReport,
}

impl SensorLink {
    /// # Errors
    /// [`LinkError`] with the invalid field.
    pub(super) fn new(link: &LinkConfig, seed: u64) -> Result<Self, LinkError> {
        Ok(Self {
            emulator: LinkEmulator::new(link.clone(), Path::new("."), seed)?,
            held: BTreeMap::new(),
            next_id: 0,
            next_sequences: BTreeMap::new(),
            began: Instant::now(),
            report: SensorLinkReport::default(),
        })
    }

    /// Submits the current frame of a vehicle. Data of all its sensors at a tick are transmitted together.
    pub(super) fn submit(&mut self, held: Sweep, now: Instant) {
        let (cav, frame) = (&held.frame.cav, &held.frame);
        let points = frame.points.len() + frame.radar.as_ref().map_or(0, |radar| radar.len());
        let cameras = frame.cameras.iter();
        let images: usize = cameras.map(|(_, camera)| camera.image.len()).sum();
        let bytes = HEADER_LEN as u64 + POINT_BYTES * points as u64 + images as u64;
        let id = self.next_id;
        self.next_id += 1;
        let next_sequence = self.next_sequences.entry(cav.clone()).or_default();
        let sequence = *next_sequence;
        *next_sequence += 1;
        self.report.submitted += 1;
        self.emulator.submit(Packet {
            id,
            from: cav.clone(),
            to: cav.clone(),
            stream: Stream::Lidar,
            sequence,
            bytes,
            submitted_nanos: nanos::between(self.began, now),
            // Sensor and agent are on one vehicle.
            distance_m: 0.0,
        });
        self.held.insert(id, held);
    }

    /// Time at which the next frame can arrive; `None` while none is in flight.
    pub(super) fn next(&self) -> Option<Instant> {
        let next_nanos = self.emulator.next_nanos()?;
        Some(self.began + Duration::from_nanos(next_nanos))
    }

    /// Frames that have arrived by now.
    pub(super) fn arrived(&mut self, now: Instant) -> Vec<Sweep> {
        let mut arrived = Vec::new();
        for outcome in self.emulator.advance(nanos::between(self.began, now)) {
            let id = outcome.packet.id;
            match outcome.delivery {
                Delivery::Dropped(reason) => {
                    self.held.remove(&id);
                    *self.report.dropped.entry(reason).or_default() += 1;
                }
                // Its copy follows, so the frame stays held.
                Delivery::Arrived {
                    is_repeated: true, ..
                } => arrived.extend(self.held.get(&id).cloned()),
                Delivery::Arrived { .. } => arrived.extend(self.held.remove(&id)),
            }
        }
        self.report.arrived += arrived.len() as u64;
        arrived
    }
}

#[cfg(test)]
mod tests {
    use protocol::{Handedness, PointCloud};

    use super::*;
    use link::{CapacityConfig, LatencyModel, LossModel};

    fn held(cav: &CavId, tick: u64) -> Sweep {
        let points = PointCloud {
            xyzi: vec![[0.0; 4]; 1000],
        };
        let frame = Frame {
            points,
            ..Frame::empty(cav.clone(), tick, Handedness::Right)
        };
        Sweep {
            agent: 0,
            capture_nanos: tick,
            frame,
        }
    }

    #[test]
    fn losses_of_a_vehicle_do_not_depend_on_the_others() {
        let [cav, other] = ["7", "8"].map(|cav| CavId::new(cav).unwrap());
        let lossy = LinkConfig {
            loss: LossModel::Bernoulli(0.5),
            ..LinkConfig::default()
        };
        let [with_other, alone] = [vec![&other, &cav], vec![&cav]].map(|cavs| {
            let mut link_under_test = SensorLink::new(&lossy, 1).unwrap();
            let began = link_under_test.began;
            for tick in 0..100 {
                cavs.iter()
                    .for_each(|cav| link_under_test.submit(held(cav, tick), began));
            }
            let arrived = link_under_test
                .arrived(began)
                .into_iter()
                .filter(|held| held.frame.cav == cav);
            arrived.map(|held| held.capture_nanos).collect::<Vec<_>>()
        });
        assert_eq!(with_other, alone);
    }

    #[test]
    fn frames_come_late_in_their_order_and_some_never() {
        let cav = CavId::new("7").unwrap();
        // 16 kB at 16 Mbit/s: 8 ms each, then 100 ms.
        let link = LinkConfig {
            capacity: CapacityConfig::TokenBucket {
                bandwidth_mbps: 16.0,
                burst_bytes: 0,
            },
            latency: LatencyModel::ConstantMs(100.0),
            ..LinkConfig::default()
        };
        let mut link_under_test = SensorLink::new(&link, 1).unwrap();
        let at = Duration::from_millis;
        let began = link_under_test.began;
        link_under_test.submit(held(&cav, 0), began);
        link_under_test.submit(held(&cav, 1), began);
        assert!(link_under_test.arrived(began + at(107)).is_empty());
        let first = link_under_test.arrived(began + at(110));
        assert_eq!(
            first
                .iter()
                .map(|held| held.capture_nanos)
                .collect::<Vec<_>>(),
            [0]
        );
        assert!(
            link_under_test
                .next()
                .is_some_and(|next| next > began + at(110))
        );
        assert_eq!(link_under_test.arrived(began + at(120)).len(), 1);
        assert_eq!(link_under_test.next(), None);

        let mut lossy = SensorLink::new(
            &LinkConfig {
                loss: LossModel::Bernoulli(0.5),
                ..LinkConfig::default()
            },
            1,
        )
        .unwrap();
        let began = lossy.began;
        (0..200).for_each(|tick| lossy.submit(held(&cav, tick), began));
        let arrived = lossy.arrived(began).len() as u64;
        let report = &lossy.report;
        assert!((70..130).contains(&arrived), "{arrived}");
        assert_eq!((report.submitted, report.arrived), (200, arrived));
        assert_eq!(
            report.dropped.get(&DropReason::LinkLoss),
            Some(&(200 - arrived))
        );
    }
}
