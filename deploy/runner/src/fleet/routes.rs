//! Subscriptions that must be in place before the clock of a scene starts.

use std::collections::BTreeSet;

use bus::{Route, process_id};
use deploy::operate::RECORDER;
use deploy::score::scorer_cav;
use fusion::Exchange;
use protocol::{CavId, ProcessId, Role, Stream, Topic};

use super::Fleet;

impl Fleet {
    /// Routes that must exist before the clock starts, in addition to those from the replay to the agents.
    pub(super) fn routes(&self) -> Vec<Route> {
        let ego = process_id(Role::Ego, &self.ego);
        let scorer = process_id(Role::Scorer, &scorer_cav());
        let mut routes = vec![
            Route::new(Topic::Truth, scorer.clone()),
            route(&self.ego, Stream::Detections, &scorer),
        ];
        if self.scenario.ego.tracks {
            routes.push(route(&self.ego, Stream::Tracks, &scorer));
        }
        for cav in &self.agents {
            routes.push(route(cav, Stream::Pose, &scorer));
        }
        // The ego hears its own agent directly, also where others are behind an emulated link.
        routes.push(route(&self.ego, self.needed().stream(), &ego));
        // Ego-only: the ego subscribes to its own agent and to no other.
        if self.scenario.method.exchange() == Exchange::Nothing {
            return routes;
        }
        let link = process_id(Role::Link, &self.ego);
        if self.is_over_link() {
            // The link takes nothing else of the ego. A neighbour's position is subscribed to before its stream.
            routes.push(route(&self.ego, Stream::Gnss, &link));
        }
        for cav in self.neighbours() {
            for stream in self.streams_of(cav) {
                // Over an emulated link a message takes two hops, and both have to be there.
                if self.is_over_link() {
                    routes.push(route(cav, stream, &link));
                    let received = Topic::Received {
                        ego: self.ego.clone(),
                        cav: cav.clone(),
                        stream,
                    };
                    routes.push(Route::new(received, ego.clone()));
                } else {
                    routes.push(route(cav, stream, &ego));
                }
            }
        }
        routes
    }

    /// The routes, and, if the run is recorded, those of the same topics and of the sensors to the recorder: messages
    /// published before it subscribes are not recorded.
    pub(super) fn recorded(&self, mut routes: Vec<Route>) -> Vec<Route> {
        if self.scenario.record.is_some() {
            let recorder = CavId::new(RECORDER).expect("eight lower-case letters");
            let receiver = process_id(Role::Recorder, &recorder);
            let sensors = self.agents.iter().flat_map(|cav| {
                [Stream::Lidar, Stream::Gnss, Stream::Imu].map(|stream| Topic::stream(cav, stream))
            });
            let topics = routes.iter().map(|route| route.topic.clone());
            let topics: BTreeSet<Topic> = topics.chain(sensors).collect();
            let topics = topics.into_iter();
            routes.extend(topics.map(|topic| Route::new(topic, receiver.clone())));
        }
        routes
    }
}

fn route(cav: &CavId, stream: Stream, receiver: &ProcessId) -> Route {
    Route::new(Topic::stream(cav, stream), receiver.clone())
}
