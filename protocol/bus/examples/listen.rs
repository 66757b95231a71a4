//! Detections of a live run: one line per frame, until nothing arrives for ten seconds.
//!
//! `listen ENDPOINT RUN`, both as `v2vloc up` prints them: `listen tcp/127.0.0.1:7447 my-run`.

use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{Bus, BusOptions, Identity, process_id};
use protocol::{CavId, Detections, KeyExpr, Limits, Role, RunId, Stream, wire};

const SILENCE: Duration = Duration::from_secs(10);

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(endpoint), Some(run)) = (arguments.next(), arguments.next()) else {
        return Err("which endpoint, and which run?".into());
    };
    let (run, cav) = (RunId::new(&run)?, CavId::new("listener")?);
    let identity = Identity {
        run: run.clone(),
        process: process_id(Role::Viewer, &cav),
        cav,
    };
    let bus = Bus::join(&BusOptions::client(endpoint.parse()?), identity)?;
    // A passive subscriber joins and leaves at any time: nobody waits for it, and no account of the run counts it.
    let detections = bus.tap(&[KeyExpr::stream(&run, Stream::Detections)], 8)?;
    while let Pop::Item(_, message) = detections.take(Some(Instant::now() + SILENCE)) {
        match wire::decode::<Detections>(message.pieces(), &Limits::DEFAULT) {
            Ok((header, result)) => println!(
                "{:.1} s: {} boxes, {} neighbours fused",
                header.stamp.capture_nanos as f64 * 1e-9,
                result.detections.len(),
                result.fused.len()
            ),
            Err(error) => eprintln!("{}: {error}", message.key),
        }
    }
    Ok(())
}
