//! Egress rules of a router: no receiver stops the messages of the others.
//!
//! A thread that takes in the messages of a sender hands each to all receivers, one after the other. Publishers send
//! with `CongestionControl::Block`; if a router handed messages over in the same way, it would wait up to
//! [`super::BusOptions::stall_limit`] for a receiver that takes nothing, and so would all others. The router therefore
//! replaces the congestion control of what it hands over (zenoh's `qos/network`):
//!
//! | message | egress | a receiver that takes nothing | a slow receiver |
//! | --- | --- | --- | --- |
//! | any, unless below | drop | costs [`FIRST_WAIT`] once per priority, [`FRAGMENT_WAIT`] more if large | loses what its queue does not hold |
//! | map or sweep to another host | block first: one message waits, on a thread of its own | costs [`FIRST_WAIT`] per message until the stall limit closes its connection | gets whole messages at its pace |
//! | of a lossless publisher | block | stops that publisher until the stall limit | slows it |
//!
//! A large message to a slow link must not be dropped in part: the fragments already sent would use up the link, and no
//! message would ever arrive whole. On one machine block-first is not used: it lets one message per priority wait, and
//! maps of several senders come at the same time; zenoh 1.10 also skips the hand-off of shared memory there. A message
//! that waits keeps the queue of its priority locked, so the priorities of maps and sweeps carry nothing else.
//!
//! Receivers count what they miss ([`super::delivery_gaps`]).

use std::time::Duration;

use serde_json::{Value, json};

/// Wait for a place in the queue of a receiver.
const FIRST_WAIT: Duration = Duration::from_millis(10);
/// Further wait for the other fragments of a large message. A queue and the buffers of a socket hold megabytes: a
/// receiver on a busy machine may pause for longer.
const FRAGMENT_WAIT: Duration = Duration::from_millis(90);
/// Maps and sweeps have at least so many bytes, notifications fewer.
const LARGE_BYTES: usize = 2 << 10;
/// Priorities of maps and of sweeps.
const TENSOR_PRIORITIES: [&str; 2] = ["data", "data_low"];
/// Batches of 64 KiB in the queue of a receiver, for priorities of small messages: the most that zenoh allows. An
/// express message has a batch of its own.
const SMALL_BATCHES: usize = 16;

/// Names of the loopback interface, on Linux and elsewhere.
const LOOPBACK: [&str; 2] = ["lo", "lo0"];

/// Settings of zenoh that a router has in addition.
pub(super) fn settings() -> Vec<(&'static str, Value)> {
    let [first, fragment] = [FIRST_WAIT, FRAGMENT_WAIT]
        .map(|wait| json!(u64::try_from(wait.as_micros()).unwrap_or(u64::MAX)));
    let mut settings = vec![
        (
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop",
            first,
        ),
        (
            "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments",
            fragment,
        ),
        ("qos/network", rules()),
    ];
    settings.extend(SMALL_QUEUES.map(|queue| (queue, json!(SMALL_BATCHES))));
    settings
}

const SMALL_QUEUES: [&str; 5] = [
    "transport/link/tx/queue/size/control",
    "transport/link/tx/queue/size/interactive_high",
    "transport/link/tx/queue/size/interactive_low",
    "transport/link/tx/queue/size/data_high",
    "transport/link/tx/queue/size/background",
];

/// zenoh's `qos/network`. Each rule sees what the ones before it have made of a message.
fn rules() -> Value {
    // zenoh 1.10 writes an open end as 0: a configuration that it prints would not mean the same.
    let large = json!({"payload_size": format!("{LARGE_BYTES}..{}", u32::MAX)});
    let tensors = TENSOR_PRIORITIES.map(|priority| {
        let filter = json!({"congestion_control": "block", "priority": priority});
        let id = format!("egress-{priority}");
        rule(&id, &filter, "block_first", &large)
    });
    let [block, block_first] =
        ["block", "block_first"].map(|how| json!({"congestion_control": how}));
    let lossless = json!({"priority": "real_time"});
    let (always, here) = (json!({}), json!({"interfaces": LOOPBACK}));
    let others = [
        // What is still `block` here is no large tensor: the rules above have made those `block_first`.
        rule("egress", &block, "drop", &always),
        // For receivers on the loopback large tensors are dropped like all else.
        rule("egress-here", &block_first, "drop", &here),
        // Last: it overrides the rules above for lossless publishers, which alone use this priority.
        rule("egress-lossless", &lossless, "block", &always),
    ];
    tensors.into_iter().chain(others).collect()
}

fn rule(id: &str, filter: &Value, congestion_control: &str, only: &Value) -> Value {
    let mut rule = json!({
        "id": id,
        "messages": ["put"],
        "flows": ["egress"],
        "qos": filter,
        "overwrite": {"congestion_control": congestion_control},
    });
    if let (Some(rule), Some(only)) = (rule.as_object_mut(), only.as_object()) {
        rule.extend(only.clone());
    }
    rule
}
