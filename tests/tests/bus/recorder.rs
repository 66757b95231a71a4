//! Recorder: what arrives around the end of a recording.

use bus::shutdown::Stop;
use bus::{Barrier, PublisherOptions, Route};
use protocol::Topic;
use sim_replay::recorder::{self, RecordReport};
use tests::bus::{TIMEOUT, TestRouter, recorder_config};

use super::sessions::gnss;

/// Messages that are published once the recorder is asked to stop.
const LATE: u64 = 20;

/// Records what is published after the request to stop.
fn record_late_messages(out: std::path::PathBuf) -> RecordReport {
    let (router, stop) = (TestRouter::open(), Stop::new());
    let bus = router.join("recorder", "recorder");
    let replay = router.join("replay", "replay");
    let topic: Topic = "7/gnss".parse().unwrap();
    let publisher = replay
        .publisher(topic.clone(), PublisherOptions::SENSOR.lossless(8))
        .unwrap();
    let config = recorder_config(&bus, out);
    std::thread::scope(|scope| {
        let recorder = scope.spawn(|| recorder::record(&bus, &config, &stop, &mut |_| {}).unwrap());
        let route = Route {
            topic,
            receiver: "recorder".parse().unwrap(),
        };
        Barrier::new([route])
            .await_routes(&replay)
            .unwrap()
            .wait(TIMEOUT)
            .unwrap();
        stop.request();
        (0..LATE).for_each(|tick| publisher.submit(tick, gnss(tick as f64)));
        recorder.join().unwrap()
    })
}

#[test]
fn messages_under_way_when_a_recorder_is_asked_to_stop_are_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let report = record_late_messages(folder.path().join("late.mcap"));
    assert!(
        report.messages >= LATE && report.is_complete(),
        "{report:?}"
    );
}
