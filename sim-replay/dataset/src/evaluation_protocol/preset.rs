//! Presets: the protocols of the supported data sets, with their sources.

use super::{AgentKinds, ApOrder, EgoKind, EvaluationProtocol};
use crate::ground_truth::{GroundTruthRule, vehicles_in};

/// Names of all presets, with the data set of each.
pub const PRESETS: [(&str, &str); 14] = [
    ("opv2v", "OPV2V, and generated scenes"),
    ("v2xset", "V2XSet"),
    ("v2vdet", "V2VDet of V2VLoc"),
    ("v2xr", "V2X-R"),
    ("v2v4real", "V2V4Real"),
    ("dair", "DAIR-V2X-C"),
    ("v2xseq", "V2X-Seq (SPD)"),
    (
        "v2xreal",
        "V2X-Real and V2XPnP, vehicles and roadside units",
    ),
    ("v2xreal-v2v", "V2X-Real, vehicles only"),
    ("v2xreal-i2i", "V2X-Real, roadside units only"),
    ("v2xsim", "V2X-Sim 2.0"),
    ("v2xradar", "V2X-Radar-C"),
    (
        "rcooper",
        "RCooper, in the layouts of its public converters",
    ),
    ("mars", "Open MARS, multi-agent subset"),
];

impl EvaluationProtocol {
    /// The preset of that name.
    pub fn preset(name: &str) -> Option<Self> {
        let known = PRESETS.iter().any(|(known, _)| *known == name);
        known.then(|| {
            let (agents, ego) = match name {
                "v2xreal-v2v" | "v2xsim" => (AgentKinds::Vehicles, EgoKind::Vehicle),
                "v2xreal-i2i" | "rcooper" => (AgentKinds::Units, EgoKind::Unit),
                _ => (AgentKinds::All, EgoKind::Vehicle),
            };
            let (ground_truth, max_agents) = rule(name);
            Self {
                name: name.to_owned(),
                ground_truth,
                exact_range: false,
                agents,
                ego,
                max_agents,
                ap_order: match name {
                    "v2v4real" => ApOrder::Frame,
                    _ => ApOrder::Global,
                },
            }
        })
    }
}

/// Boxes that count, and the largest number of agents.
fn rule(name: &str) -> (GroundTruthRule, usize) {
    match name {
        "v2v4real" => (GroundTruthRule::V2V4REAL, 2),
        // V2X-R: opencood/hypes_yaml/V2X-R, ground truth as wide as the points.
        "v2xr" => (vehicles_in(140.8, 40.0, [-3.0, 1.0], 70.0), 5),
        // HEAL, dairv2x configurations: the range of the points, z widened by 1 m where labels are filtered. V2X-Seq's
        // own code takes every pair, however far apart.
        "dair" | "v2xseq" => (vehicles_in(102.4, 51.2, [-4.5, 2.5], 100.0), 2),
        // V2X-Real: opencood/data_utils/datasets/__init__.py.
        "v2xreal" | "v2xreal-v2v" | "v2xreal-i2i" => {
            (vehicles_in(100.0, 40.0, [-15.0, 15.0], 50.0), 4)
        }
        // HEAL, v2xsim2 configurations, vehicles only. CoAlign has z -3..2 m and 50 m.
        "v2xsim" => (vehicles_in(32.0, 32.0, [-3.0, 1.0], 70.0), 5),
        // V2X-Radar: communication range of its configurations.
        "v2xradar" => (vehicles_in(140.8, 40.0, [-3.0, 1.0], 300.0), 7),
        // RCooper: roadside units up to 200 m apart.
        "rcooper" => (vehicles_in(200.0, 40.0, [-20.0, 0.0], 200.0), 7),
        // Open MARS has no annotations and so no protocol: chosen for this project.
        "mars" => (vehicles_in(51.2, 51.2, [-5.0, 3.0], 70.0), 7),
        // OPV2V, V2XSet, V2VDet.
        _ => (GroundTruthRule::OPV2V, 7),
    }
}
