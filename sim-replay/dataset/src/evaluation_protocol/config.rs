//! Options of an evaluation protocol: a preset, and single changes over it.

use std::fmt;
use std::ops::RangeInclusive;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{AgentKinds, ApOrder, EgoKind, EvaluationProtocol, PRESETS};
use crate::Layout;
use crate::class_set::ClassSet;

/// An evaluation protocol in command lines and files. Absent values are those of the preset.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema, clap::Args)]
#[serde(default, deny_unknown_fields)]
#[command(next_help_heading = "Evaluation protocol")]
pub struct ProtocolConfig {
    /// Protocol of a benchmark: opv2v, v2xset, v2vdet, v2xr, v2v4real, dair, v2xseq, v2xreal, v2xreal-v2v, v2xreal-i2i,
    /// v2xsim, v2xradar, rcooper or mars [default: the one of the data set's layout].
    #[arg(long = "protocol", value_name = "NAME")]
    pub preset: Option<String>,
    /// Agents farther from the ego than this do not take part, metres in the plane.
    #[arg(long = "comm-range-m", value_name = "M")]
    pub comm_range_m: Option<f64>,
    /// Range in which objects count, in the ego's LiDAR frame: x, y, z low, then x, y, z high, metres. Without this the
    /// range of the protocol ends at the area of the network.
    #[arg(long = "ground-truth-range-m", value_name = "M,M,M,M,M,M")]
    #[arg(value_delimiter = ',', allow_hyphen_values = true)]
    pub ground_truth_range_m: Option<Vec<f64>>,
    /// Corners of a box, of 8, that must lie within that range.
    #[arg(long = "min-corners", value_name = "N")]
    pub min_corners: Option<usize>,
    /// Classes that count: vehicle, car, van, truck, bus, two_wheeler, pedestrian, other; several with commas.
    #[arg(long, value_name = "CLASSES")]
    pub classes: Option<ClassSet>,
    /// Agents that take part at most, the ego included.
    #[arg(long, value_name = "N")]
    pub max_agents: Option<usize>,
    /// Agents that take part.
    #[arg(long, value_enum)]
    pub agent_kinds: Option<AgentKinds>,
    /// The ego: the first vehicle or the first roadside unit.
    #[arg(long, value_enum)]
    pub ego_kind: Option<EgoKind>,
    /// Order of detections in the average precision that is reported first.
    #[arg(long, value_enum)]
    pub ap_order: Option<ApOrder>,
}

impl ProtocolConfig {
    /// The protocol for a data set of `layout`.
    ///
    /// # Errors
    /// A message with the option and both values.
    pub fn resolve(&self, layout: Layout) -> Result<EvaluationProtocol, String> {
        self.resolve_over(None, layout)
    }

    /// The same for a run that was scored: without a preset the changes are over the protocol of its scores.
    pub(super) fn resolve_over(
        &self,
        scored: Option<EvaluationProtocol>,
        layout: Layout,
    ) -> Result<EvaluationProtocol, String> {
        let name = self.preset.as_deref().unwrap_or(layout.0.protocol);
        let scored = scored.filter(|_| self.preset.is_none());
        let start = scored.or_else(|| EvaluationProtocol::preset(name));
        let mut protocol = start.ok_or_else(|| {
            let known: Vec<&str> = PRESETS.iter().map(|(name, _)| *name).collect();
            format!("unknown protocol {name:?}; there are {}", known.join(", "))
        })?;
        let rule = &mut protocol.ground_truth;
        let comm_range_m = self.comm_range_m.unwrap_or(rule.comm_range_m);
        rule.comm_range_m = checked("comm_range_m", comm_range_m, 0.0..=1e5)?;
        let min_corners = self.min_corners.unwrap_or(rule.min_corners);
        rule.min_corners = checked("min_corners", min_corners, 1..=8)?;
        rule.classes = self.classes.unwrap_or(rule.classes);
        if let Some(range) = &self.ground_truth_range_m {
            [rule.x_m, rule.y_m, rule.z_m] = intervals("ground_truth_range_m", range)?;
            protocol.exact_range = true;
        }
        let max_agents = self.max_agents.unwrap_or(protocol.max_agents);
        protocol.max_agents = checked("max_agents", max_agents, 1..=1000)?;
        protocol.agents = self.agent_kinds.unwrap_or(protocol.agents);
        // Where all agents are of one kind, the ego is too.
        let only = match protocol.agents {
            AgentKinds::All => None,
            AgentKinds::Vehicles => Some(EgoKind::Vehicle),
            AgentKinds::Units => Some(EgoKind::Unit),
        };
        protocol.ego = self.ego_kind.or(only).unwrap_or(protocol.ego);
        if only.is_some_and(|only| only != protocol.ego) {
            let (ego, agents) = (protocol.ego, protocol.agents);
            return Err(format!("ego_kind: {ego:?}, but agent_kinds: {agents:?}").to_lowercase());
        }
        protocol.ap_order = self.ap_order.unwrap_or(protocol.ap_order);
        Ok(protocol)
    }
}

/// An error if the value is outside `range`.
fn checked<T: PartialOrd + fmt::Display>(
    name: &str,
    value: T,
    range: RangeInclusive<T>,
) -> Result<T, String> {
    if range.contains(&value) {
        return Ok(value);
    }
    let (low, high) = (range.start(), range.end());
    Err(format!("{name}: {value}, expected {low} to {high}"))
}

/// Low and high of x, y and z, metres, from x, y, z low, then x, y, z high, the value of the option `name`.
///
/// # Errors
/// A message with the option and both values where they are no range.
pub fn intervals(name: &str, range: &[f64]) -> Result<[[f64; 2]; 3], String> {
    let &[x_low, y_low, z_low, x_high, y_high, z_high] = range else {
        let count = range.len();
        return Err(format!("{name}: {count} numbers, expected 6"));
    };
    let intervals = [[x_low, x_high], [y_low, y_high], [z_low, z_high]];
    for [low, high] in intervals {
        if !(low.is_finite() && high.is_finite() && low < high) {
            return Err(format!("{name}: from {low} to {high} is no range"));
        }
    }
    Ok(intervals)
}
