//! Two robots of ROS 2 whose clocks differ: each with a node, an agent and PGC of its own, and an ego that fuses them.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::thread::sleep;
use std::time::{Duration, Instant};

use bus::bounded_queue::Pop;
use bus::{Bus, Event, Inbox, Subscription};
use dataset::average_precision::{Ordering, Scorer};
use dataset::evaluation_protocol::EvaluationProtocol;
use dataset::frame::Frame;
use dataset::ground_truth::GroundTruth;
use dataset::{LoadOptions, Scenario};
use perception::model_config::DetectorConfig;
use protocol::{Detections, Limits, PointCloud, Stream, Topic};
use ros2::{Distribution, RosType};
use simulator::generate::{Subset, SynthOptions, generate};
use tests::bus::{TestRouter, wait_for};
use tests::fleet::programs;
use tests::locks::exclusive_lock;
use zenoh::Session;

use super::ros2::{
    DOMAIN, FLOAT32, announce, other_node, point_cloud, put, wait_for_subscriptions,
};

/// Ticks of the scene, which every round plays once.
const TICKS: usize = 8;
/// Rounds after a change of the offset: in the first the ego may follow, in the last it has to fuse as before.
const ROUNDS: usize = 2;
const TICK_NANOS: u64 = 100_000_000;
/// Slower than the robots' clocks: two vehicles with PGC on a busy machine.
const PAUSE: Duration = Duration::from_millis(400);
/// Capture times of the second robot against those of the first, seconds. The last one is a step back.
const OFFSETS_S: [f64; 5] = [0.0, 0.1, 0.3, 3.0, 2.0];
const START_NANOS: u64 = 100_000_000_000;

/// Processes of the test, killed with it.
struct Processes(Vec<Child>);

impl Processes {
    fn start(&mut self, program: &str, arguments: &str) {
        let child = Command::new(programs().join(program))
            .args(arguments.split(' '))
            .stdout(Stdio::null())
            .spawn();
        self.0.push(child.expect("a program of this workspace"));
    }
}

impl Drop for Processes {
    fn drop(&mut self) {
        for child in &mut self.0 {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// A sweep as a driver publishes it.
fn cloud(nanos: u64, points: &PointCloud) -> Vec<u8> {
    let values = points.xyzi.iter().flatten();
    let bytes: Vec<u8> = values.flat_map(|value| value.to_le_bytes()).collect();
    point_cloud(nanos, FLOAT32, 16, &bytes)
}

/// The scene, and the ego's results so far.
struct Drive {
    scenario: Scenario,
    frames: Vec<Vec<Frame>>,
    session: Session,
    results: Arc<Inbox>,
    _subscription: Subscription,
    _bus: Bus,
    /// Ticks so far.
    tick: u64,
}

/// Average precision at an IoU of 0.5 of the rounds of a phase, answered ticks of the last, and the last offset found.
struct Phase {
    precision: [f64; ROUNDS],
    answered: usize,
    fused: usize,
    offset_s: Option<f64>,
}

impl Drive {
    fn open(folder: &Path, router: &TestRouter) -> Self {
        let options = SynthOptions {
            frames: TICKS,
            agents: 2..=2,
            ..SynthOptions::new(Subset::V2vdet, 1008, folder.to_owned())
        };
        generate(&options, &|_| {}).unwrap();
        let scenario = dataset::open(folder).unwrap().scenarios.remove(0);
        let load = |tick| {
            let agents = 0..scenario.agents.len();
            agents
                .map(|agent| scenario.load(agent, tick, &LoadOptions::default()).unwrap())
                .collect()
        };
        let frames = (0..TICKS).map(load).collect();
        let bus = router.join("scorer", "scorer");
        let results = bus.inbox(100, 1);
        let detections = Topic::Stream {
            cav: scenario.agents[0].clone(),
            stream: Stream::Detections,
        };
        Self {
            _subscription: bus.subscribe(detections, &results).unwrap(),
            _bus: bus,
            session: other_node(router),
            tick: 0,
            frames,
            results,
            scenario,
        }
    }

    fn capture_nanos(&self) -> u64 {
        START_NANOS + self.tick * TICK_NANOS
    }

    /// Publishes a tick: of the first robot, and of the second where it is there, with its clock ahead.
    fn sense(&mut self, ahead_s: Option<f64>) {
        let frames = &self.frames[self.tick as usize % TICKS];
        let nanos = self.capture_nanos();
        let ahead_nanos = ahead_s.map(|ahead_s| (ahead_s * 1e9) as u64);
        let sensed = [Some(0), ahead_nanos]
            .into_iter()
            .zip(frames)
            .zip(["one", "two"]);
        for ((ahead, frame), robot) in sensed {
            if let Some(ahead) = ahead {
                let topic = format!("{robot}/points");
                let cloud = cloud(nanos + ahead, &frame.points);
                put(
                    &self.session,
                    (&topic, RosType::PointCloud2),
                    Distribution::Jazzy,
                    cloud,
                );
            }
        }
        self.tick += 1;
        sleep(PAUSE);
    }

    /// The results that have arrived, with the number of their tick.
    fn taken(&self) -> Vec<(u64, Detections)> {
        let mut taken = Vec::new();
        while let Pop::Item(_, Event::Message(arrival)) = self.results.take(Some(Instant::now())) {
            let result = self.results.decode(&arrival, &Limits::DEFAULT).unwrap();
            let tick = (arrival.header.stamp.capture_nanos - START_NANOS) / TICK_NANOS;
            taken.push((tick, result));
        }
        taken
    }

    /// Plays all rounds with one offset.
    fn play(&mut self, ahead_s: Option<f64>) -> Phase {
        let first = self.tick;
        (0..ROUNDS * TICKS).for_each(|_| self.sense(ahead_s));
        sleep(2 * PAUSE);
        let rule = EvaluationProtocol::preset("opv2v")
            .expect("a preset")
            .rule_within(DetectorConfig::lean().lidar_range_m);
        let mut scorers = [(); ROUNDS].map(|()| Scorer::new(&[0.5]));
        let results = self.taken();
        let (mut answered, mut fused) = (0, 0);
        for tick in first..self.tick {
            let round = (tick - first) as usize / TICKS;
            let frames: Vec<&Frame> = self.frames[tick as usize % TICKS].iter().collect();
            let truth = GroundTruth::of_tick(&frames, 0, &rule);
            let found = results.iter().find(|(of, _)| *of == tick);
            // A tick without a result counts as one without detections.
            let detections = found.map_or(&[][..], |(_, result)| &result.detections[..]);
            scorers[round].add(detections, &truth);
            if let Some((_, result)) = found.filter(|_| round + 1 == ROUNDS) {
                answered += 1;
                fused += usize::from(!result.fused.is_empty());
            }
        }
        let precision =
            scorers.map(|scorer| scorer.average_precisions(Ordering::Global)[0].unwrap());
        let last = results.last().map(|(_, result)| result);
        let neighbour = last.and_then(|result| result.neighbours.first());
        Phase {
            precision,
            answered,
            fused,
            offset_s: neighbour.and_then(|neighbour| neighbour.capture_offset_s),
        }
    }
}

#[test]
fn two_robots_whose_clocks_differ_are_fused_as_if_they_agreed() {
    let _exclusive = exclusive_lock();
    let (folder, router) = (tempfile::tempdir().unwrap(), TestRouter::open());
    let mut drive = Drive::open(folder.path(), &router);
    let _node = announce(&drive.session);
    let mut processes = Processes(Vec::new());
    let weights = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/weights");
    let joined = format!("--connect {} --run test", router.endpoint);
    let agents = drive.scenario.agents.clone();
    let models = format!("--weights {weights}/lean-max.safetensors");
    for (cav, robot) in agents.iter().zip(["one", "two"]) {
        let pgc = format!(
            "--pose-source pgc --encoder {weights}/pgc-encoder.safetensors --head {weights}/pgc-town1.safetensors"
        );
        processes.start("agent", &format!("run {joined} --cav {cav} {models} {pgc}"));
        let ros = format!("--domain-id {DOMAIN} --namespace /{robot} --robot {cav}");
        let lidar = format!("--lidar /{robot}/points={cav}");
        processes.start("v2vloc", &format!("ros2 {joined} {ros} {lidar}"));
    }
    let ego = &agents[0];
    let deadline = PAUSE.as_millis();
    processes.start(
        "ego-fuser",
        &format!("run {joined} --ego {ego} --method max {models} --deadline-ms {deadline}"),
    );
    wait_for_subscriptions(&drive.session, &["%one%points", "%two%points"]);
    // Until all models are loaded.
    wait_for("a fused result", || {
        drive.sense(Some(0.0));
        drive
            .taken()
            .iter()
            .any(|(_, result)| !result.fused.is_empty())
    });
    // Every phase begins at the first tick of the scene.
    drive.tick = drive.tick.next_multiple_of(TICKS as u64);
    let phases = OFFSETS_S.map(|ahead_s| {
        let phase = drive.play(Some(ahead_s));
        println!(
            "{ahead_s} s ahead: AP@0.5 by round {:.3?}, {} of {TICKS} answered, {} fused, offset {:?} s",
            phase.precision, phase.answered, phase.fused, phase.offset_s
        );
        phase
    });
    let alone = drive.play(None).precision;
    println!("alone: AP@0.5 by round {alone:.3?}");
    let [ego_only, agreed] = [alone, phases[0].precision].map(|rounds| rounds[ROUNDS - 1]);
    assert!(
        agreed > ego_only + 0.05,
        "{agreed} with the neighbour, {ego_only} without"
    );
    for (phase, ahead_s) in phases.iter().zip(OFFSETS_S) {
        let found = phase.precision[ROUNDS - 1];
        assert!(
            found >= agreed - 0.01,
            "{ahead_s} s ahead: {found}, {agreed} without"
        );
        let worst = phase.precision.into_iter().fold(1.0, f64::min);
        assert!(
            worst >= ego_only - 0.01,
            "{ahead_s} s ahead: {worst}, alone {ego_only}"
        );
        // An offset within the tolerance of 50 ms need not be stated.
        let offset_s = phase.offset_s.unwrap_or_default();
        assert!(
            (offset_s - ahead_s).abs() < 0.02,
            "{ahead_s} s ahead: {offset_s}"
        );
    }
}
