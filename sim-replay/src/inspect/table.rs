//! Text table of the findings.

use std::collections::BTreeMap;
use std::fmt;

use protocol::Handedness;

use super::{AgentReport, CountSummary, Report, ScenarioReport};
use dataset::Layout;
use terminal::text_table::TextTable;

/// Problems that are printed; further ones are counted.
const MAX_PROBLEMS: usize = 50;

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let layout = self.layout.map_or("no supported layout", Layout::name);
        let frames: usize = self.scenarios.iter().map(|scenario| scenario.frames).sum();
        let scenarios = count(self.scenarios.len(), "scenario");
        let frames = count(frames, "frame");
        writeln!(f, "{}: {layout}, {scenarios}, {frames}", self.path)?;
        let agents = self.scenarios.iter().flat_map(|scenario| &scenario.agents);
        let mut boxes = agents.filter_map(|agent| agent.boxes);
        let has_boxes = boxes.any(|boxes| boxes.max > 0);
        if let Some(protocol) = self.protocol.as_ref().filter(|_| has_boxes) {
            writeln!(f, "{protocol}")?;
        }
        for scenario in &self.scenarios {
            self.write_scenario(f, scenario)?;
        }
        if self.problems.is_empty() {
            return write!(f, "\nno problems");
        }
        write!(f, "\n{}:", count(self.problems.len(), "problem"))?;
        for problem in self.problems.iter().take(MAX_PROBLEMS) {
            write!(f, "\n  {}", problem.message)?;
        }
        match self.problems.len().saturating_sub(MAX_PROBLEMS) {
            0 => Ok(()),
            more => write!(f, "\n  and {more} more (--json lists all)"),
        }
    }
}

impl Report {
    fn write_scenario(&self, f: &mut fmt::Formatter<'_>, scenario: &ScenarioReport) -> fmt::Result {
        let axes = match scenario.handedness {
            Handedness::Left => "left-handed",
            Handedness::Right => "right-handed",
        };
        let rate = scenario.rate_hz;
        let rate = rate.map_or(String::new(), |rate| format!(" at {rate:.1} Hz"));
        let (name, seconds) = (&scenario.name, scenario.seconds);
        let frames = count(scenario.frames, "frame");
        writeln!(
            f,
            "\n{name}: {frames}{rate}, {seconds:.1} s, {axes} on disk"
        )?;
        write!(f, "{}", agents_table(&scenario.agents))?;
        for agent in &scenario.agents {
            if let Some(sweeps) = &agent.sweeps {
                writeln!(f, "  sweeps of {}: {sweeps}", agent.id)?;
            }
        }
        if !scenario.lidar_variants.is_empty() {
            let names = scenario.lidar_variants.join(", ");
            writeln!(f, "  LiDAR variants: {names}")?;
        }
        if !scenario.cameras.is_empty() {
            let numbers: Vec<String> = scenario.cameras.iter().map(u8::to_string).collect();
            writeln!(f, "  cameras: {}", numbers.join(", "))?;
        }
        for join in &scenario.joins {
            writeln!(f, "  {join}")?;
        }
        write_missing(f, scenario)?;
        self.write_merged(f, scenario)
    }

    /// One line per ego: boxes ego-only, and with the other agents.
    fn write_merged(&self, f: &mut fmt::Formatter<'_>, scenario: &ScenarioReport) -> fmt::Result {
        let ticks = self.ticks.iter();
        let mut by_ego: BTreeMap<&str, (Vec<usize>, Vec<usize>)> = BTreeMap::new();
        for tick in ticks.filter(|tick| tick.scenario == scenario.name) {
            let (alone, together) = by_ego.entry(tick.ego.as_str()).or_default();
            let is_alone = tick.agents.len() == 1;
            if is_alone { alone } else { together }.push(tick.merged_boxes);
        }
        for (ego, (alone, together)) in by_ego {
            let with_others = match CountSummary::of(&together) {
                Some(summary) => format!(", {} with those in range", shown(Some(summary))),
                None => String::new(),
            };
            let alone = shown(CountSummary::of(&alone));
            writeln!(
                f,
                "  ground truth of ego {ego}: {alone} ego-only{with_others}"
            )?;
        }
        Ok(())
    }
}

/// One line for every agent that lacks frames which others have; at those that the ego lacks there is no tick.
fn write_missing(f: &mut fmt::Formatter<'_>, scenario: &ScenarioReport) -> fmt::Result {
    for (index, AgentReport { id, .. }) in scenario.agents.iter().enumerate() {
        let missing = scenario.missing.iter();
        let lacking: Vec<_> = missing.filter(|frame| frame.agent == *id).collect();
        let (Some(first), Some(last)) = (lacking.first(), lacking.last()) else {
            continue;
        };
        let frames = count(lacking.len(), "frame");
        let consequence = match index {
            0 => "the frames of others are not used there",
            _ => "absent there",
        };
        writeln!(
            f,
            "  agent {id} lacks {frames}, from {} to {}: {consequence}",
            first.stem, last.stem
        )?;
    }
    Ok(())
}

fn agents_table(agents: &[AgentReport]) -> TextTable {
    let numbers = [
        "points",
        "dropped",
        "boxes",
        "empty boxes",
        "radar",
        "metres",
    ];
    let mut table = TextTable::of(&["agent"], &numbers);
    for agent in agents {
        table.row([
            agent.id.to_string(),
            shown(agent.points),
            agent.dropped_points.to_string(),
            shown(agent.boxes),
            agent.boxes_without_points.to_string(),
            shown(agent.radar_points),
            agent
                .distance_m
                .map_or("no pose".into(), |metres| format!("{metres:.1}")),
        ]);
    }
    table
}

/// The mean, and the range if there is one.
fn shown(summary: Option<CountSummary>) -> String {
    match summary {
        None => "-".into(),
        Some(CountSummary { min, max, .. }) if min == max => min.to_string(),
        Some(CountSummary { min, mean, max }) => format!("{mean:.1} ({min} to {max})"),
    }
}

fn count(number: usize, noun: &str) -> String {
    format!("{number} {noun}{}", if number == 1 { "" } else { "s" })
}
