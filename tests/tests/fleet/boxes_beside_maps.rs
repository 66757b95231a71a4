//! Boxes beside maps in simulation time: of each neighbour what has come, and no wait for maps that are late.

use agent::config::SentBoxes;
use ego_fuser_offline::evaluation::EvaluatedFrame;
use link::{CapacityConfig, LinkConfig, QueueConfig};
use protocol::{CavId, DropReason};
use tests::fleet::write_weights_with_box_input;

use super::simulation_time::{MS, TICKS, config, evaluate, scene};

#[test]
fn maps_that_are_always_late_are_not_awaited_beside_boxes() {
    let folder = scene();
    write_weights_with_box_input(&folder.path().join("weights.safetensors"));
    let sending = |boxes, link| {
        let mut setup = config(link);
        setup.agents.boxes = boxes;
        evaluate(folder.path(), setup)
    };
    let (on_time, ledger) = sending(Some(SentBoxes::Beside), LinkConfig::default());
    let (maps, _) = sending(None, LinkConfig::default());
    for (beside, alone) in on_time.iter().zip(&maps) {
        assert_ne!(beside.result.detections, alone.result.detections);
        let bytes = |frame: &EvaluatedFrame| -> Vec<(CavId, u64)> {
            let fused = frame.result.fused.iter();
            fused
                .map(|one| (one.cav.clone(), one.payload_bytes))
                .collect()
        };
        for ((cav, both), (same, map)) in bytes(beside).into_iter().zip(bytes(alone)) {
            assert!(cav == same && both > map, "one neighbour, two messages");
        }
    }
    assert_eq!(ledger.total().dropped.get(&DropReason::Unneeded), None);

    // A map takes 120 ms, more than the ego waits.
    let map_bytes = maps[0].result.fused[0].payload_bytes;
    let slow = LinkConfig {
        capacity: CapacityConfig::of_mbps(8e-6 * map_bytes as f64 / 0.12),
        queue: QueueConfig {
            keep_last: true,
            urgent_bytes: map_bytes / 2,
            ..QueueConfig::default()
        },
        ..LinkConfig::default()
    };
    let (late, _) = sending(Some(SentBoxes::Beside), slow);
    let waits_ms: Vec<u64> = late
        .iter()
        .map(|frame| {
            let mut stages = frame.result.stages.iter();
            stages.find(|stage| stage.stage == "wait").unwrap().nanos / MS
        })
        .collect();
    assert_eq!(waits_ms[..3], [100; 3], "{waits_ms:?}");
    assert!(waits_ms[3..].iter().all(|ms| *ms < 80), "{waits_ms:?}");
    for frame in &late {
        for fused in &frame.result.fused {
            // A map of one sweep before comes before boxes.
            let is_map = fused.payload_bytes > map_bytes / 2;
            assert_eq!(fused.age_nanos / MS as i64, if is_map { 100 } else { 0 });
        }
    }
}

#[test]
fn maps_of_another_network_are_left_out_on_every_clock_also_of_the_same_shape() {
    let folder = scene();
    let other = folder.path().join("other.safetensors");
    write_weights_with_box_input(&other);
    let mut setup = config(LinkConfig::default());
    setup.agents.weights = Some(other);
    let (frames, ledger) = evaluate(folder.path(), setup.clone());
    assert!(frames.iter().all(|frame| frame.result.fused.is_empty()));
    let shape = ledger.total().dropped.get(&DropReason::Shape).copied();
    assert_eq!(shape, Some(2 * TICKS as u64), "maps of two neighbours");
    // Nor without an emulation of the link, where no ledger is kept.
    setup.link = None;
    let (frames, _) = evaluate(folder.path(), setup);
    assert!(frames.iter().all(|frame| frame.result.fused.is_empty()));
}
