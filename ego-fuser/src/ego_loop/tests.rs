use fusion::method::Method;
use protocol::message::{Descriptor, ModelHash};
use protocol::{Box3d, Detection, DropReason, Dtype, HEADER_LEN};

use super::*;
use crate::ego::Content;
use crate::ego::tests::{HERE, NOW, egos_of_files, near, view};

const PERIOD: u64 = 100_000_000;
/// Bytes of metadata and body of every message, and of every pose message with its header.
const PAYLOAD_BYTES: u64 = 1000;
const POSE_BYTES: u64 = 154;

/// A loop of vehicle `a` with the neighbour `b`, whose boxes it reads.
struct Case {
    ego: Ego,
    ego_loop: EgoLoop,
    own: View,
    map: View,
    boxes: View,
}

impl Case {
    fn new() -> Self {
        let [_, ego] = egos_of_files(Method::MAX);
        let own = view("a", HERE, Method::MAX, 0.0);
        let map = view("b", near(), Method::MAX, 0.15);
        let found = Detection {
            box3d: Box3d {
                center_m: [2.0, 1.0, -1.0],
                size_m: [4.0, 1.8, 1.6],
                heading_rad: 0.4,
            },
            score: 0.9,
            source: None,
        };
        let boxes = View {
            content: Content::Boxes(vec![found.into()]),
            ..map.clone()
        };
        let options = LoopOptions::stepped(&EgoSettings::default());
        let ego_loop = EgoLoop::new(&own.cav, &ego, options);
        let mut case = Self {
            ego,
            ego_loop,
            own,
            map,
            boxes,
        };
        case.handle(Input::Joined(case.map.cav.clone()));
        case
    }

    fn handle(&mut self, input: Input) -> Vec<Output> {
        self.ego_loop.handle(&mut self.ego, input, NOW)
    }

    /// The sender of a view names another network, and the streams that it publishes beside its pose.
    fn describe(&mut self, view: &View, streams: &[Stream]) {
        let detector = self.ego.detector();
        let descriptor = Descriptor {
            model_hash: ModelHash([7; 32]),
            grid: detector.grid(),
            channels: u32::try_from(detector.sent_shape()[0]).unwrap(),
            dtype: Dtype::F32,
            streams: (std::iter::once(Stream::Pose).chain(streams.iter().copied())).collect(),
            sweeps: vec![],
        };
        self.handle(Input::Model(view.cav.clone(), descriptor));
    }

    /// The same view, captured `sweeps` later, arrives.
    fn receive(&mut self, view: &View, sweeps: u64) -> Vec<Output> {
        self.receive_at(view, sweeps * PERIOD, 0)
    }

    /// The same view, captured `captured_after` later, arrives `arrived_after` later, nanoseconds.
    fn receive_at(&mut self, view: &View, captured_after: u64, arrived_after: u64) -> Vec<Output> {
        let view = View {
            capture_nanos: NOW + captured_after,
            ..view.clone()
        };
        self.handle(Input::Message(Box::new(Message {
            reception: Reception {
                cav: view.cav.clone(),
                arrived_nanos: NOW + arrived_after,
                transport: None,
                clock_offset_s: None,
            },
            view,
            sequence: 0,
            payload_bytes: PAYLOAD_BYTES,
            wire_bytes: PAYLOAD_BYTES + HEADER_LEN as u64 + POSE_BYTES,
        })))
    }

    /// Streams of `b` whose messages were used, and those not used with the reason.
    fn accounts(outputs: &[Output]) -> (Vec<Stream>, Vec<(Stream, DropReason)>) {
        let used = outputs.iter().filter_map(|output| match output {
            Output::Counted((cav, stream), None) if cav.as_str() == "b" => Some(*stream),
            _ => None,
        });
        let dropped = outputs.iter().filter_map(|output| match output {
            Output::Counted((cav, stream), Some(reason)) if cav.as_str() == "b" => {
                Some((*stream, *reason))
            }
            _ => None,
        });
        (used.collect(), dropped.collect())
    }
}

#[test]
fn a_neighbour_of_another_network_counts_by_its_boxes() {
    let mut case = Case::new();
    let (own, map, boxes) = (case.own.clone(), case.map.clone(), case.boxes.clone());
    case.describe(&map, &[Stream::Boxes, Stream::Bev]);
    let refused = Case::accounts(&case.receive(&map, 0));
    assert_eq!(refused, (vec![], vec![(Stream::Bev, DropReason::Shape)]));
    case.receive(&own, 0);
    assert!(case.handle(Input::Wake).is_empty(), "its boxes are awaited");
    case.receive(&boxes, 0);
    let outputs = case.handle(Input::Wake);
    assert_eq!(Case::accounts(&outputs), (vec![Stream::Boxes], vec![]));
    let result = outputs.iter().find_map(|output| match output {
        Output::Publish { result, .. } => Some(result),
        _ => None,
    });
    let result = result.unwrap();
    assert_eq!(result.fused[0].cav, boxes.cav);
    assert!(result.skipped.is_empty(), "{:?}", result.skipped);
    let report = case.ego_loop.report();
    assert_eq!((report.fused_boxes, &report.other_network), (1, &None));
}

#[test]
fn an_agent_of_another_network_is_reported_and_frames_of_the_egos_own_fail() {
    let mut case = Case::new();
    let (own, map) = (case.own.clone(), case.map.clone());
    let hashes = [[7; 32], case.ego.detector().model_hash().0].map(ModelHash);
    let difference = format!("model_hash is {}, the ego's is {}", hashes[0], hashes[1]);
    case.describe(&map, &[Stream::Bev]);
    let reported = Some(format!("agent b: {difference}"));
    assert_eq!(case.ego_loop.report().other_network, reported);

    case.describe(&own, &[Stream::Bev]);
    case.receive(&own, 0);
    let outputs = case.handle(Input::Wake);
    let [
        Output::Counted((cav, _), Some(DropReason::Shape)),
        Output::Failed { error, .. },
    ] = &outputs[..]
    else {
        panic!("{outputs:?}");
    };
    assert_eq!(*cav, own.cav);
    let error = error.to_string();
    assert!(error.ends_with(&difference), "{error}");
    assert_eq!(case.ego_loop.report().failed, 1);
}

#[test]
fn a_pose_message_counts_once_for_all_messages_of_its_sweep() {
    let mut case = Case::new();
    let (own, map, boxes) = (case.own.clone(), case.map.clone(), case.boxes.clone());
    let sent_bytes = 2 * (PAYLOAD_BYTES + HEADER_LEN as u64);
    // At the second sweep the boxes are those of the first: two sweeps have two poses.
    for (sweep, expected) in [
        (0, sent_bytes + POSE_BYTES),
        (1, sent_bytes + 2 * POSE_BYTES),
    ] {
        case.receive(&map, sweep);
        if sweep == 0 {
            case.receive(&boxes, sweep);
        }
        case.receive(&own, sweep);
        let outputs = case.handle(Input::Wake);
        let fused = outputs.iter().find_map(|output| match output {
            Output::Publish { result, .. } => Some(result.fused.clone()),
            _ => None,
        });
        let fused = fused.unwrap();
        assert_eq!(
            (fused.len(), fused[0].wire_bytes),
            (1, expected),
            "sweep {sweep}"
        );
        assert_eq!(fused[0].payload_bytes, 2 * PAYLOAD_BYTES);
    }
}

#[test]
fn boxes_that_come_after_their_map_was_fused_are_not_missing() {
    let mut case = Case::new();
    let (own, map, boxes) = (case.own.clone(), case.map.clone(), case.boxes.clone());
    let unneeded = (Stream::Boxes, DropReason::Unneeded);
    for sweep in 0..2 {
        case.receive(&map, sweep);
        case.receive(&own, sweep);
        let accounts = Case::accounts(&case.handle(Input::Wake));
        // Boxes that missed their own frame are read in the next one.
        let used = match sweep {
            0 => vec![Stream::Bev],
            _ => vec![Stream::Bev, Stream::Boxes],
        };
        assert_eq!(accounts, (used, vec![]), "sweep {sweep}");
        case.receive(&boxes, sweep);
    }
    let left = case.handle(Input::Left(map.cav.clone()));
    assert_eq!(Case::accounts(&left), (vec![], vec![unneeded]));
}

#[test]
fn after_a_gap_of_the_recording_a_neighbour_may_be_first() {
    let mut case = Case::new();
    let (own, map) = (case.own.clone(), case.map.clone());
    case.receive(&map, 0);
    case.receive(&own, 0);
    case.handle(Input::Wake);
    let gap = 30 * PERIOD;
    let early = Case::accounts(&case.receive_at(&map, gap, 0));
    let future = (Stream::Bev, DropReason::Future);
    assert_eq!(early, (vec![], vec![future]), "no time has passed");
    let after_gap = Case::accounts(&case.receive_at(&map, gap, gap));
    assert_eq!(after_gap, (vec![], vec![]));
    case.receive(&own, 30);
    let accounts = Case::accounts(&case.handle(Input::Wake));
    assert_eq!(accounts, (vec![Stream::Bev], vec![]));
}

#[test]
fn after_one_short_step_a_neighbour_that_lags_is_not_awaited_to_the_deadline() {
    let mut case = Case::new();
    let (own, map) = (case.own.clone(), case.map.clone());
    let lag = 2 * PERIOD / 5;
    // The second step is half as long.
    for halves in [2, 4, 5, 7, 9] {
        let captured = halves * PERIOD / 2;
        case.receive_at(&map, captured - lag, 0);
        case.receive_at(&own, captured, 0);
        case.handle(Input::Wake);
        case.handle(Input::Wake);
        // While the odd step is one of two, the lead is that of 20 Hz.
        let waits = case.ego_loop.wakes_nanos().is_some();
        assert_eq!(waits, halves == 5, "{halves}");
    }
}
