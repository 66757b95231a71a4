//! Replay of scenes: order, pace, control, missing and unreadable files.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bus::shutdown::Stop;
use bus::{Bus, Event, Inbox, PublisherOptions, Subscription, bounded_queue::Pop};
use dataset::{self, Scenario};
use protocol::{CavId, Control, Gnss, KeyExpr, Lidar, Limits, Stream, Topic, Truth, wire};
use sim_replay::stream::{Replay, StreamOptions, StreamReport};
use tests::bus::{TIMEOUT, TestRouter, next_event, stream_options, wait_for};
use tests::scene;

const AGENTS: [&str; 2] = ["10", "20"];

fn scenario(dir: &Path) -> Scenario {
    dataset::open(dir).unwrap().scenarios.remove(0)
}

fn topic(cav: &str, stream: Stream) -> Topic {
    Topic::Stream {
        cav: CavId::new(cav).unwrap(),
        stream,
    }
}

/// Subscriber to everything a replay publishes, under the names of the agents it waits for.
struct Listener {
    buses: Vec<Bus>,
    inbox: Arc<Inbox>,
    _subscriptions: Vec<Subscription>,
}

impl Listener {
    fn new(router: &TestRouter) -> Self {
        let buses: Vec<Bus> = AGENTS
            .iter()
            .map(|cav| router.join(&format!("agent-{cav}"), cav))
            .collect();
        let inbox = buses[0].inbox(1000, 16);
        let mut subscriptions = vec![buses[0].subscribe(Topic::Truth, &inbox).unwrap()];
        for (bus, cav) in buses.iter().zip(AGENTS) {
            for stream in [Stream::Lidar, Stream::Gnss, Stream::Imu] {
                subscriptions.push(bus.subscribe(topic(cav, stream), &inbox).unwrap());
            }
        }
        Self {
            buses,
            inbox,
            _subscriptions: subscriptions,
        }
    }

    /// Capture times by topic, once every topic has ended.
    fn captures(&self) -> BTreeMap<Topic, Vec<u64>> {
        let mut captures: BTreeMap<Topic, Vec<u64>> = BTreeMap::new();
        let mut ended = 0;
        while ended < 7 {
            match next_event(&self.inbox) {
                (topic, Event::Message(arrival)) => {
                    captures
                        .entry(topic)
                        .or_default()
                        .push(arrival.header.stamp.capture_nanos);
                }
                (_, Event::End { .. }) => ended += 1,
            }
        }
        captures
    }
}

fn play(router: &TestRouter, scenario: &Scenario, options: StreamOptions) -> StreamReport {
    play_until(router, scenario, options, &Stop::new())
}

fn play_until(
    router: &TestRouter,
    scenario: &Scenario,
    options: StreamOptions,
    stop: &Stop,
) -> StreamReport {
    let bus = router.join("replay", "replay");
    let replay = Replay::prepare(&bus, scenario, options, stop).unwrap();
    replay.wait_until_ready().unwrap();
    let report = replay.play();
    bus.leave(TIMEOUT).unwrap();
    report
}

#[test]
fn every_tick_reaches_every_agent_in_order() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 6);
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let listener = Listener::new(&router);
    let report = play(
        &router,
        &scenario,
        StreamOptions {
            rate: 0.0,
            ..stream_options()
        },
    );
    let recorded: Vec<u64> = scenario
        .ticks
        .iter()
        .map(|tick| tick.capture_nanos)
        .collect();
    let captures = listener.captures();
    assert_eq!(captures.len(), 7);
    for (topic, captures) in captures {
        assert_eq!(captures, recorded, "{topic}");
    }
    assert_eq!((report.ticks, report.unreadable_frames), (6, 0));
    assert!(report.sent.iter().all(|count| count.messages == 6) && report.is_complete());
}

#[test]
fn what_is_published_is_what_was_recorded() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 1);
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let listener = Listener::new(&router);
    play(&router, &scenario, stream_options());
    let frame = scenario
        .load(1, 0, &dataset::LoadOptions::default())
        .unwrap();
    let (mut seen, inbox) = (0, &listener.inbox);
    while seen < 3 {
        let (found, Event::Message(arrival)) = next_event(&listener.inbox) else {
            continue;
        };
        if found == topic("20", Stream::Lidar) {
            assert_eq!(
                inbox
                    .decode::<Lidar>(&arrival, &Limits::DEFAULT)
                    .unwrap()
                    .points,
                frame.points
            );
            seen += 1;
        } else if found == topic("20", Stream::Gnss) {
            let gnss: Gnss = inbox.decode(&arrival, &Limits::DEFAULT).unwrap();
            assert_eq!(Some(gnss.world_from_lidar), frame.world_from_lidar);
            seen += 1;
        } else if found == Topic::Truth {
            let truth: Truth = inbox.decode(&arrival, &Limits::DEFAULT).unwrap();
            assert_eq!(truth.agents.len(), 2);
            assert_eq!(truth.agents[1].objects.len(), frame.objects.len());
            assert_eq!(truth.agents[1].objects[0].class, "car");
            seen += 1;
        }
    }
}

#[test]
fn previews_are_published_for_viewers_only() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 6);
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let bus = router.join("replay", "replay");
    let preview = bus
        .publisher(topic("10", Stream::Preview), PublisherOptions::PREVIEW)
        .unwrap();
    let recorder = router.join("recorder", "recorder");
    let everything = recorder
        .tap(&[KeyExpr::run(&recorder.identity().run)], 64)
        .unwrap();
    assert!(!preview.is_wanted(), "a recorder has whole sweeps");
    let viewer = router.join("viewer", "viewer");
    let viewing = viewer
        .tap(
            &[KeyExpr::stream(&viewer.identity().run, Stream::Preview)],
            64,
        )
        .unwrap();
    wait_for("a subscriber to previews", || preview.is_wanted());
    let _listener = Listener::new(&router);
    play(&router, &scenario, stream_options());

    let at_once = || Some(Instant::now());
    let mut previews = 0;
    while let Pop::Item(found, preview) = viewing.take(at_once()) {
        assert!(
            matches!(
                found,
                Topic::Stream {
                    stream: Stream::Preview,
                    ..
                }
            ),
            "{found}"
        );
        let (header, Lidar { points }) =
            wire::decode([preview.bytes().as_ref()], &Limits::DEFAULT).unwrap();
        let agent = AGENTS
            .iter()
            .position(|cav| header.stamp.cav.as_str() == *cav)
            .unwrap();
        let tick = scenario
            .ticks
            .iter()
            .position(|tick| tick.capture_nanos == header.stamp.capture_nanos)
            .unwrap();
        let frame = scenario
            .load(agent, tick, &dataset::LoadOptions::default())
            .unwrap();
        assert_eq!(points, frame.points.decimate(4_000));
        previews += 1;
    }
    assert!((1..=12).contains(&previews), "{previews}");
    let mut recorded = 0;
    while let Pop::Item(found, _) = everything.take(at_once()) {
        assert!(!matches!(
            found,
            Topic::Stream {
                stream: Stream::Preview,
                ..
            }
        ));
        recorded += 1;
    }
    assert!(recorded > 12, "{recorded}");
    drop(viewing);
    wait_for("no subscriber to previews", || !preview.is_wanted());
}

#[test]
fn the_pace_is_the_recorded_one_times_the_rate() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 11);
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let listener = Listener::new(&router);
    let report = play(
        &router,
        &scenario,
        StreamOptions {
            rate: 2.0,
            ..stream_options()
        },
    );
    // Ten steps of 100 ms at twice the speed.
    assert!((0.5..1.5).contains(&report.seconds), "{} s", report.seconds);
    assert_eq!(listener.captures()[&Topic::Truth].len(), 11);
}

#[test]
fn pause_step_seek_and_resume_steer_the_clock() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 8);
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let listener = Listener::new(&router);
    let (operator, stop) = (router.join("operator", "operator"), Stop::new());
    let next_truth = || loop {
        if let (Topic::Truth, Event::Message(arrival)) = next_event(&listener.inbox) {
            let truth: Truth = listener.inbox.decode(&arrival, &Limits::DEFAULT).unwrap();
            return (truth.tick, arrival.header.stamp.capture_nanos);
        }
    };
    let recorded: Vec<u64> = scenario
        .ticks
        .iter()
        .map(|tick| tick.capture_nanos)
        .collect();
    std::thread::scope(|scope| {
        let playing = scope.spawn(|| {
            let options = StreamOptions {
                repeats: true,
                ..stream_options()
            };
            play_until(&router, &scenario, options, &stop)
        });
        // While ticks arrive, the replay receives: its subscriptions were sent before them.
        while next_truth().0 < 2 {}
        operator.publish_control(Control::Pause, 0);
        operator.publish_control(Control::Seek { tick: 6 }, 0);
        operator.publish_control(Control::Step { ticks: 1 }, 0);
        // Any tick before 6 was published before the pause arrived.
        let capture = loop {
            let (index, capture) = next_truth();
            if index == 6 {
                break capture;
            }
            assert!(index < 6, "{index}");
        };
        assert_eq!(capture, recorded[6]);
        operator.publish_control(Control::Step { ticks: 2 }, 0);
        assert_eq!([next_truth().0, next_truth().0], [7, 0]);
        operator.publish_control(Control::Seek { tick: 99 }, 0);
        operator.publish_control(Control::Seek { tick: 4 }, 0);
        operator.publish_control(Control::Resume, 0);
        let (index, capture) = next_truth();
        assert_eq!(index, 4);
        assert!(capture > recorded[7], "time goes on over a jump back");
        assert_eq!(next_truth().0, 5);
        stop.request();
        assert!(playing.join().unwrap().ticks >= 3 + 1 + 2 + 2);
    });
}

#[test]
fn a_restarted_replay_resumes_and_does_not_wait_for_offline_agents() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 12);
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let checkpoint = folder.path().join("replay.json");
    let options = StreamOptions {
        rate: 4.0,
        checkpoint: Some(checkpoint.clone()),
        ..stream_options()
    };
    let (listener, stop) = (Listener::new(&router), Stop::new());
    let next_truth = || loop {
        if let (Topic::Truth, Event::Message(arrival)) = next_event(&listener.inbox) {
            return arrival.header.stamp.capture_nanos;
        }
    };
    let mut seen: Vec<u64> = std::thread::scope(|scope| {
        let playing = scope.spawn(|| play_until(&router, &scenario, options.clone(), &stop));
        let mut seen = vec![next_truth(), next_truth(), next_truth()];
        stop.request();
        let ticks = playing.join().unwrap().ticks as usize;
        assert!((3..12).contains(&ticks), "{ticks}");
        seen.resize_with(ticks, next_truth);
        seen
    });
    // A route that never exists: the first instance would wait for it for a minute.
    let missing = "99/lidar>agent-99".parse().unwrap();
    let report = play(
        &router,
        &scenario,
        StreamOptions {
            expect: vec![missing],
            ..options.clone()
        },
    );
    seen.resize_with(12, next_truth);
    let recorded: Vec<u64> = scenario
        .ticks
        .iter()
        .map(|tick| tick.capture_nanos)
        .collect();
    assert_eq!((seen, report.ticks), (recorded, 12));
    assert_eq!(
        play(&router, &scenario, options.clone()).ticks,
        12,
        "there is nothing left to play"
    );

    std::fs::write(&checkpoint, "{}").unwrap();
    let bus = router.join("replay", "replay");
    let error = Replay::prepare(&bus, &scenario, options, &Stop::new())
        .err()
        .unwrap()
        .to_string();
    assert!(
        error.contains("replay.json: not a replay checkpoint: missing field"),
        "{error}"
    );
}

#[test]
fn an_agent_that_does_not_come_is_named() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 1);
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let agent = router.join("agent-10", "10");
    let inbox = agent.inbox(8, 8);
    let _subscriptions = [Stream::Lidar, Stream::Gnss, Stream::Imu]
        .map(|stream| agent.subscribe(topic("10", stream), &inbox).unwrap());
    let bus = router.join("replay", "replay");
    let options = StreamOptions {
        ready_timeout: Duration::from_millis(400),
        ..stream_options()
    };
    let replay = Replay::prepare(&bus, &scenario, options, &Stop::new()).unwrap();
    let error = replay.wait_until_ready().unwrap_err().to_string();
    assert!(
        error.contains("20/lidar>agent-20, 20/gnss>agent-20, 20/imu>agent-20")
            && !error.contains("10/"),
        "{error}"
    );
}

#[test]
fn what_the_scene_does_not_have_is_named() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 2);
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let bus = router.join("replay", "replay");
    let refused = |options| {
        Replay::prepare(&bus, &scenario, options, &Stop::new())
            .err()
            .unwrap()
    };
    let error = refused(StreamOptions {
        agents: vec![CavId::new("30").unwrap()],
        ..stream_options()
    });
    assert!(
        error.to_string().contains("no agent 30; it has 10, 20"),
        "{error}"
    );
    let error = refused(StreamOptions {
        seek: 2,
        ..stream_options()
    });
    assert!(
        error
            .to_string()
            .ends_with("has 2 ticks, counted from 0; there is no tick 2"),
        "{error}"
    );
    let error = refused(StreamOptions {
        rate: f64::NAN,
        ..stream_options()
    });
    assert_eq!(
        error.to_string(),
        "rate is NaN, not a number from 0 to 1000"
    );
}

#[test]
fn an_unreadable_frame_is_named_and_the_rest_is_replayed() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 3);
    let broken = folder.path().join("scene/20/000062.pcd");
    let bytes = std::fs::read(&broken).unwrap();
    std::fs::write(&broken, &bytes[..bytes.len() / 2]).unwrap();
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let listener = Listener::new(&router);
    let report = play(
        &router,
        &scenario,
        StreamOptions {
            rate: 0.0,
            ..stream_options()
        },
    );
    assert_eq!(
        (report.ticks, report.unreadable_frames, report.is_complete()),
        (3, 1, false)
    );
    assert!(
        report.unreadable[0].error.contains("000062.pcd"),
        "{}",
        report.unreadable[0].error
    );
    let captures = listener.captures();
    assert_eq!(captures[&topic("10", Stream::Lidar)].len(), 3);
    assert_eq!(captures[&topic("20", Stream::Lidar)].len(), 2);
    assert_eq!(captures[&Topic::Truth].len(), 3);
}

#[test]
fn a_request_to_stop_ends_a_loop_without_end() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(folder.path(), &AGENTS, 2);
    let (router, scenario) = (TestRouter::open(), scenario(folder.path()));
    let listener = Listener::new(&router);
    let stop = Stop::new();
    let bus = router.join("replay", "replay");
    let options = StreamOptions {
        repeats: true,
        rate: 10.0,
        ..stream_options()
    };
    let replay = Replay::prepare(&bus, &scenario, options, &stop).unwrap();
    replay.wait_until_ready().unwrap();
    let report = std::thread::scope(|scope| {
        let playing = scope.spawn(|| replay.play());
        let mut truths = 0;
        while truths < 5 {
            truths += u32::from(matches!(
                next_event(&listener.inbox),
                (Topic::Truth, Event::Message(_))
            ));
        }
        let asked = Instant::now();
        stop.request();
        let report = playing.join().unwrap();
        assert!(asked.elapsed() < Duration::from_secs(5));
        report
    });
    assert!(report.ticks >= 5);
    // Capture times increase over every loop.
    let mut last = 0;
    while let Pop::Item(found, event) = listener
        .inbox
        .take(Some(Instant::now() + Duration::from_millis(200)))
    {
        if let (Topic::Truth, Event::Message(arrival)) = (found, event) {
            assert!(arrival.header.stamp.capture_nanos > last);
            last = arrival.header.stamp.capture_nanos;
        }
    }
    assert_eq!(listener.buses.len(), 2);
}
