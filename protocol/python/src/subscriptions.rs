//! Subscriptions of a listener: key expressions of the streams that are asked for and permitted.

use protocol::{KeyExpr, Operation, Principal, RunId, RunScope, Stream};
use pyo3::{PyErr, PyResult};

use crate::error::error;

/// Streams of a listener that asks for none: all but sweeps and images, which are most of the traffic.
const STREAMS: [&str; 9] = [
    "gnss",
    "imu",
    "pose",
    "bev",
    "boxes",
    "points",
    "detections",
    "tracks",
    "truth",
];

/// A principal, and the key expressions that its certificate permits; `None`: a run without access control.
pub(crate) type Access = Option<(Principal, Vec<KeyExpr>)>;

/// Streams that the certificate of `principal` permits in a run.
pub(crate) fn access_of(principal: &Principal, run: &RunId) -> Access {
    let rights = principal.rights(&RunScope::One(run.clone())).into_iter();
    let subscribed = rights
        .filter(|right| right.act == Operation::Subscribe)
        .map(|right| right.keys);
    Some((principal.clone(), subscribed.collect()))
}

fn permits(access: &Access, wanted: &KeyExpr) -> bool {
    access
        .as_ref()
        .is_none_or(|(_, permitted)| { permitted.iter() }.any(|keys| keys.includes(wanted)))
}

/// Key expressions of the streams, and of the end of the run. Without names: those of [`STREAMS`] that are permitted.
pub(crate) fn selectors(
    run: &RunId,
    names: Option<Vec<String>>,
    access: &Access,
) -> PyResult<Vec<KeyExpr>> {
    let mut selectors = vec![KeyExpr::control(run)];
    let is_choice = names.is_some();
    for name in names.unwrap_or_else(|| STREAMS.map(str::to_owned).into()) {
        let wanted = selector(run, &name)?;
        if permits(access, &wanted) {
            selectors.push(wanted);
        } else if is_choice && let Some((principal, _)) = access {
            return Err(error(format!(
                "streams: a certificate of {principal} does not permit {name:?}"
            )));
        }
    }
    // Control messages, with the end of the run, are not permitted to every principal.
    selectors.retain(|wanted| permits(access, wanted));
    Ok(selectors)
}

fn selector(run: &RunId, name: &str) -> PyResult<KeyExpr> {
    Ok(match name {
        "truth" => KeyExpr::truth(run),
        "camera" => KeyExpr::cameras(run),
        "stats" => KeyExpr::stats(run),
        name => KeyExpr::stream(run, name.parse::<Stream>().map_err(|_| no_stream(name))?),
    })
}

fn no_stream(name: &str) -> PyErr {
    let known = "lidar, radar, camera, gnss, imu, pose, bev, boxes, points, detections, tracks, descriptor, pace, truth, stats";
    error(format!("streams: {name:?} is none; there are {known}"))
}
