//! Pace of a fleet with two egos: an agent computes what the faster one has time for, and forgets egos that have left.

use agent::node::{self as agent_node, NodeOptions};
use bus::shutdown::Stop;
use bus::{Barrier, Bus, MessageStats, Publisher, PublisherOptions, Route};
use ego_fuser::config::EgoSettings;
use ego_fuser::node as ego_node;
use fusion::Method;
use protocol::{Account, DropReason, Lidar, Pace, PointCloud, ProcessId, Stream};
use tests::bus::{TIMEOUT, TestRouter, wait_for};

use super::in_process::{agent, cav, ego, topic};

/// Sweep period, nanoseconds.
const PERIOD_NANOS: u64 = 100_000_000;
/// Sweeps per interval of the slow ego.
const SWEEPS: u64 = 4;

/// Sensor of vehicle 10, and the counters of its agent.
struct Sweeps {
    lidar: Publisher,
    agent: MessageStats,
    account: Account,
    next: u64,
}

impl Sweeps {
    fn open(replay: &Bus, agent: &MessageStats) -> Self {
        let receiver: ProcessId = "agent-10".parse().unwrap();
        let route = Route {
            topic: topic("10", Stream::Lidar),
            receiver: receiver.clone(),
        };
        let lidar = replay
            .publisher(route.topic.clone(), PublisherOptions::SENSOR.lossless(8))
            .unwrap();
        let account = Account::towards(route.topic.clone(), &receiver);
        Barrier::new([route])
            .await_routes(replay)
            .unwrap()
            .wait(TIMEOUT)
            .unwrap();
        Self {
            lidar,
            agent: agent.clone(),
            account,
            next: 0,
        }
    }

    /// Sweeps of vehicle 10 that were computed, and those that were left out.
    fn handled(&self) -> [u64; 2] {
        let ledger = self.agent.ledger();
        let counts = ledger.get(&self.account).cloned().unwrap_or_default();
        [
            counts.received,
            counts
                .dropped
                .get(&DropReason::Paced)
                .copied()
                .unwrap_or_default(),
        ]
    }

    /// Publishes the sweeps of one interval of the slow ego one after another; which of them were computed.
    fn interval(&mut self) -> Vec<u64> {
        let publish = |sweep: u64| {
            let [computed, left_out] = self.handled();
            self.lidar.submit(
                (self.next + sweep) * PERIOD_NANOS,
                Lidar {
                    points: PointCloud {
                        xyzi: vec![[5.0, 0.0, 0.0, 0.5]],
                    },
                },
            );
            wait_for("the sweep", || {
                self.handled().iter().sum::<u64>() > computed + left_out
            });
            self.handled()[0] > computed
        };
        let computed = (0..SWEEPS).filter(|&sweep| publish(sweep)).collect();
        self.next += SWEEPS;
        computed
    }
}

#[test]
fn an_agent_serves_the_faster_of_two_egos_and_forgets_those_that_leave() {
    let router = TestRouter::open();
    let (stop, fast_stop) = (Stop::new(), Stop::new());
    let (agent_bus, replay) = (
        router.join("agent-10", "10"),
        router.join("replay", "replay"),
    );
    let agent_stats = agent_bus.stats().clone();
    std::thread::scope(|scope| {
        let own_stop = stop.clone();
        let running = scope.spawn(move || {
            let report = agent_node::run(
                &agent_bus,
                agent("10", Method::MAX),
                &NodeOptions::default(),
                &own_stop,
            )
            .unwrap();
            agent_bus.leave(TIMEOUT).unwrap();
            report
        });
        let mut sweeps = Sweeps::open(&replay, &agent_stats);
        let all: Vec<u64> = (0..SWEEPS).collect();
        assert_eq!(sweeps.interval(), all, "there is no pace");

        let slow_bus = router.join("ego-30", "30");
        let slow = slow_bus
            .publisher(topic("30", Stream::Pace), PublisherOptions::POSE)
            .unwrap();
        // Repeated, as an ego does.
        let mut becomes = |what: &str, expected: &[u64]| {
            wait_for(what, || {
                slow.submit(
                    0,
                    Pace {
                        period_nanos: PERIOD_NANOS,
                        phase_nanos: 0,
                        computed: 1,
                        of: SWEEPS as u8,
                    },
                );
                sweeps.interval() == expected
            });
        };
        becomes("the only ego sets the pace", &[0]);

        // An ego that keeps up: its own agent publishes nothing, so no frame is late.
        let fast = scope.spawn(|| {
            let bus = router.join("ego-20", "20");
            ego_node::run(
                &bus,
                &cav("20"),
                ego(Method::MAX),
                &ego_node::NodeOptions::from(&EgoSettings::default()),
                &fast_stop,
            )
            .unwrap();
            bus.leave(TIMEOUT).unwrap();
        });
        becomes("the faster ego is served", &all);
        fast_stop.request();
        fast.join().unwrap();
        becomes(
            "the faster ego has left, the slow one sets the pace again",
            &[0],
        );

        // The slow one hangs: it says nothing, not even that it leaves.
        wait_for("the slow ego is forgotten", || sweeps.interval() == all);
        stop.request();
        let report = running.join().unwrap();
        assert_eq!((report.failed, report.unfollowed_paces), (0, 0));
    });
}
