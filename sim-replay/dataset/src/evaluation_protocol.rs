//! Evaluation protocols: agents, ranges and classes whose annotations count, and the order of detections in average
//! precision.
//!
//! Every benchmark has its own protocol, and results of two protocols cannot be compared.
//! [`EvaluationProtocol::preset`] gives those of the supported data sets; [`ProtocolConfig`] is the same as options,
//! with single changes on top.

mod arranged;
mod config;
mod preset;
mod scored_run;

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub use arranged::{fewer, lacking};
pub use config::{ProtocolConfig, intervals};
pub use preset::PRESETS;
pub use scored_run::ScoredRun;

use crate::Scenario;
use crate::ground_truth::GroundTruthRule;

/// Rules of evaluation on a data set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EvaluationProtocol {
    /// Name of the preset that it starts from.
    pub name: String,
    /// Classes, ranges and communication range of the ground truth.
    pub ground_truth: GroundTruthRule,
    /// True to keep the ground-truth range as it is. Otherwise it is limited to the area of the network.
    pub exact_range: bool,
    /// Kinds of agents that take part.
    pub agents: AgentKinds,
    /// Choice of the ego.
    pub ego: EgoKind,
    /// Largest number of agents, the ego included.
    pub max_agents: usize,
    /// Order of detections in the average precision that the benchmark reports.
    pub ap_order: ApOrder,
}

/// Kinds of agents of a scenario that take part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[derive(JsonSchema, clap::ValueEnum)]
pub enum AgentKinds {
    /// Vehicles and roadside units.
    #[default]
    All,
    /// Vehicles only.
    Vehicles,
    /// Roadside units only.
    Units,
}

/// Choice of the ego in a scenario.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[derive(JsonSchema, clap::ValueEnum)]
pub enum EgoKind {
    /// The first vehicle; the first roadside unit if there is no vehicle.
    #[default]
    Vehicle,
    /// The first roadside unit; a scenario without one is left out.
    Unit,
}

/// Order of detections when precision and recall are summed up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[derive(JsonSchema, clap::ValueEnum, strum::IntoStaticStr)]
#[strum(serialize_all = "snake_case")]
pub enum ApOrder {
    /// By score over all frames.
    #[default]
    Global,
    /// Frame by frame, by score within a frame, as OpenCOOD's default does.
    Frame,
}

impl ApOrder {
    /// Order of the average precision that is reported first: that of the protocol, the default without one.
    pub fn of(protocol: Option<&EvaluationProtocol>) -> Self {
        protocol.map_or(Self::default(), |protocol| protocol.ap_order)
    }

    /// Name in headings and in the columns of sweeps.
    pub fn name(self) -> &'static str {
        self.into()
    }
}

impl EvaluationProtocol {
    /// The rule for a network that covers `area_m`: x, y, z low, then x, y, z high, metres in the ego's LiDAR frame. No
    /// network finds objects outside its area, so the ground-truth range ends there, unless `exact_range` is set.
    pub fn rule_within(&self, area_m: [f64; 6]) -> GroundTruthRule {
        if self.exact_range {
            return self.ground_truth;
        }
        let [x_low, y_low, z_low, x_high, y_high, z_high] = area_m;
        let rule = self.ground_truth;
        GroundTruthRule {
            x_m: common(rule.x_m, [x_low, x_high]),
            y_m: common(rule.y_m, [y_low, y_high]),
            z_m: common(rule.z_m, [z_low, z_high]),
            ..rule
        }
    }

    /// The protocol with the ground-truth rule for a network that covers `area_m`, see [`Self::rule_within`].
    pub fn within(&self, area_m: [f64; 6]) -> Self {
        Self {
            ground_truth: self.rule_within(area_m),
            ..self.clone()
        }
    }

    /// The scenario with the agents that take part, the ego first; none if no agent or no ego is of the kind asked for.
    pub fn arrange(&self, scenario: &Scenario) -> Option<Scenario> {
        let (units, vehicles): (Vec<usize>, Vec<usize>) =
            (0..scenario.agents.len()).partition(|&index| {
                let agent = scenario.agents.get(index);
                agent.is_some_and(|agent| scenario.roadside_units.contains(agent))
            });
        let mut order = match (self.agents, self.ego) {
            (AgentKinds::Vehicles, _) => vehicles,
            (AgentKinds::Units, _) => units,
            (AgentKinds::All, EgoKind::Vehicle) => [vehicles, units].concat(),
            // A vehicle is no ego of this protocol.
            (AgentKinds::All, EgoKind::Unit) if units.is_empty() => units,
            (AgentKinds::All, EgoKind::Unit) => [units, vehicles].concat(),
        };
        // From the end: the ego and the first agents stay.
        order.truncate(self.max_agents);
        (!order.is_empty()).then(|| scenario.arranged(&order))
    }
}

/// The part of a range that lies in another one.
fn common([low, high]: [f64; 2], [from, to]: [f64; 2]) -> [f64; 2] {
    [low.max(from), high.min(to)]
}

impl fmt::Display for EvaluationProtocol {
    /// One line for reports.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let GroundTruthRule {
            x_m: [x0, x1],
            y_m: [y0, y1],
            z_m: [z0, z1],
            comm_range_m,
            min_corners,
            classes,
        } = self.ground_truth;
        let order = self.ap_order.name();
        write!(
            f,
            "protocol {}: {classes} with {min_corners} of 8 corners in x {x0} to {x1}, y {y0} to {y1}, z {z0} to {z1} m of \
             the ego's LiDAR; at most {} agents within {comm_range_m} m; AP@0.3, 0.5, 0.7 in {order} order",
            self.name, self.max_agents
        )
    }
}

#[cfg(test)]
mod tests;
