//! Sweeps to a ROS 2 network: of vehicles whose points somebody there subscribes to.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{Bus, BusError};
use protocol::{CavId, KeyExpr, Kind, Limits, Stream, Topic, wire};
use ros2::{FrameNames, Translator};

use super::publisher::RosPublisher;

/// Period at which subscribers are looked for.
const POLL_PERIOD: Duration = Duration::from_millis(100);

/// Forwards the sweeps of `cav` until `ending` is set. The run is asked for them only while they have a subscriber:
/// sweeps are most of the bytes of a run.
pub(super) fn forward(
    bus: &Bus,
    cav: &CavId,
    (publisher, names): (&mut RosPublisher, FrameNames),
    ending: &Arc<AtomicBool>,
) -> Result<(), BusError> {
    let topic = Topic::stream(cav, Stream::Lidar);
    let key = KeyExpr::one(&bus.key(topic.clone()));
    let mut translator = Translator::new(&bus.identity().run).with_frames(names, BTreeSet::new());
    while !ending.load(Ordering::Relaxed) {
        if !publisher.is_wanted() {
            thread::sleep(POLL_PERIOD);
            continue;
        }
        // One place: a slow network gets the newest sweep.
        let subscriber = bus.tap(std::slice::from_ref(&key), 1)?;
        while publisher.is_wanted() && !ending.load(Ordering::Relaxed) {
            let Pop::Item(_, raw) = subscriber.take(Some(Instant::now() + POLL_PERIOD)) else {
                continue;
            };
            match wire::decode_any(raw.pieces(), &Limits::DEFAULT) {
                Ok((header, _)) if header.kind == Kind::Control => {}
                Ok((header, message)) => {
                    let capture_nanos = header.stamp.capture_nanos;
                    for message in translator.translate(&topic, capture_nanos, &message) {
                        publisher.publish(message.cdr)?;
                    }
                }
                Err(error) => tracing::warn!("{}: left out: {error}", raw.key),
            }
        }
    }
    Ok(())
}
