use std::fs;
use std::path::Path;

use super::*;
use crate::Layout;
use crate::class_set::ClassSet;

fn agent(root: &Path, id: &str, stems: std::ops::Range<u32>) {
    let dir = root.join(id);
    fs::create_dir_all(&dir).unwrap();
    for stem in stems {
        fs::write(
            dir.join(format!("{stem:06}.yaml")),
            "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n",
        )
        .unwrap();
        fs::write(dir.join(format!("{stem:06}.pcd")), "").unwrap();
    }
}

/// Two vehicles and two roadside units; the units have ticks of their own.
fn scenario(root: &Path) -> Scenario {
    agent(root, "1", 0..4);
    agent(root, "2", 2..4);
    agent(root, "-1", 1..6);
    agent(root, "-2", 0..4);
    crate::open(root).unwrap().scenarios.remove(0)
}

fn arranged(config: ProtocolConfig) -> Option<(Vec<String>, usize, Vec<usize>)> {
    let dir = tempfile::tempdir().unwrap();
    let arranged = config
        .resolve(Layout::OPV2V)
        .unwrap()
        .arrange(&scenario(dir.path()))?;
    let agents = arranged.agents.iter().map(ToString::to_string).collect();
    let present = (0..arranged.ticks.len())
        .map(|tick| arranged.present_agents(tick).count())
        .collect();
    Some((agents, arranged.ticks.len(), present))
}

fn names(names: &[&str]) -> Vec<String> {
    names.iter().map(|name| (*name).to_owned()).collect()
}

#[test]
fn every_preset_has_a_protocol_of_its_name() {
    for (name, _) in PRESETS {
        let protocol = EvaluationProtocol::preset(name).unwrap();
        assert_eq!(protocol.name, name);
        assert!(protocol.max_agents >= 2 && protocol.ground_truth.comm_range_m >= 50.0);
    }
    assert_eq!(EvaluationProtocol::preset("nuscenes"), None);
}

#[test]
fn the_layout_decides_without_options() {
    let [opv2v, v2v4real] = [Layout::OPV2V, Layout::V2V4REAL]
        .map(|layout| ProtocolConfig::default().resolve(layout).unwrap());
    assert_eq!(opv2v.ground_truth, GroundTruthRule::OPV2V);
    assert_eq!(
        (v2v4real.ground_truth, v2v4real.ap_order),
        (GroundTruthRule::V2V4REAL, ApOrder::Frame)
    );
}

#[test]
fn the_order_of_the_precisions_is_named() {
    assert_eq!(ApOrder::of(None), ApOrder::Global);
    for (name, order) in [("v2v4real", ApOrder::Frame), ("opv2v", ApOrder::Global)] {
        let protocol = EvaluationProtocol::preset(name).unwrap();
        assert_eq!(ApOrder::of(Some(&protocol)), order);
        let text = protocol.to_string();
        let named = format!("; AP@0.3, 0.5, 0.7 in {} order", order.name());
        assert!(text.ends_with(&named), "{text}");
    }
}

#[test]
fn single_options_change_the_preset() {
    let config: ProtocolConfig = serde_json::from_str(
        r#"{"preset": "dair", "comm_range_m": 80, "classes": ["car"], "ground_truth_range_m": [0, -1, -2, 1, 2, 3]}"#,
    )
    .unwrap();
    let protocol = config.resolve(Layout::OPV2V).unwrap();
    let rule = protocol.rule_within([-10.0, -10.0, -1.0, 10.0, 10.0, 1.0]);
    assert_eq!(
        (rule.x_m, rule.y_m, rule.z_m),
        ([0.0, 1.0], [-1.0, 2.0], [-2.0, 3.0]),
        "asked for, so not cut"
    );
    assert_eq!(
        (rule.comm_range_m, rule.classes),
        (80.0, "car".parse::<ClassSet>().unwrap())
    );
    assert_eq!((protocol.name.as_str(), protocol.max_agents), ("dair", 2));
}

#[test]
fn the_range_of_a_preset_ends_with_the_area_of_the_network() {
    let rule = ProtocolConfig::default().resolve(Layout::OPV2V).unwrap();
    let rule = rule.rule_within([-51.2, -38.4, -5.0, 51.2, 38.4, 0.5]);
    assert_eq!(
        (rule.x_m, rule.y_m, rule.z_m),
        ([-51.2, 51.2], [-38.4, 38.4], [-3.0, 0.5])
    );
}

fn refusal(json: &str) -> String {
    serde_json::from_str::<ProtocolConfig>(json)
        .unwrap()
        .resolve(Layout::OPV2V)
        .unwrap_err()
}

#[test]
fn wrong_options_are_named_with_both_values() {
    assert!(
        refusal(r#"{"preset": "kitty"}"#)
            .starts_with("unknown protocol \"kitty\"; there are opv2v,")
    );
    assert_eq!(
        refusal(r#"{"min_corners": 9}"#),
        "min_corners: 9, expected 1 to 8"
    );
    assert_eq!(
        refusal(r#"{"comm_range_m": -1}"#),
        "comm_range_m: -1, expected 0 to 100000"
    );
    assert_eq!(
        refusal(r#"{"ground_truth_range_m": [1, 2]}"#),
        "ground_truth_range_m: 2 numbers, expected 6"
    );
    assert_eq!(
        refusal(r#"{"agent_kinds": "vehicles", "ego_kind": "unit"}"#),
        "ego_kind: unit, but agent_kinds: vehicles"
    );
    assert_eq!(
        refusal(r#"{"preset": "rcooper", "ego_kind": "vehicle"}"#),
        "ego_kind: vehicle, but agent_kinds: units"
    );
    let reversed = refusal(r#"{"ground_truth_range_m": [1, 0, 0, -1, 1, 1]}"#);
    assert_eq!(reversed, "ground_truth_range_m: from 1 to -1 is no range");
}

#[test]
fn agents_are_arranged_and_the_ticks_are_those_of_the_ego() {
    let config = ProtocolConfig::default;
    assert_eq!(
        arranged(config()).unwrap(),
        (names(&["1", "2", "-1", "-2"]), 4, vec![2, 3, 4, 4])
    );
    let units_first = ProtocolConfig {
        ego_kind: Some(EgoKind::Unit),
        ..config()
    };
    assert_eq!(
        arranged(units_first).unwrap(),
        (names(&["-1", "-2", "1", "2"]), 5, vec![3, 4, 4, 1, 1])
    );
    let vehicles = ProtocolConfig {
        agent_kinds: Some(AgentKinds::Vehicles),
        ..config()
    };
    assert_eq!(
        arranged(vehicles).unwrap(),
        (names(&["1", "2"]), 4, vec![1, 1, 2, 2])
    );
    let two = ProtocolConfig {
        max_agents: Some(2),
        agent_kinds: Some(AgentKinds::Units),
        ..config()
    };
    assert_eq!(
        arranged(two).unwrap(),
        (names(&["-1", "-2"]), 5, vec![2, 2, 2, 1, 1])
    );
}

#[test]
fn a_scenario_without_agents_of_the_kind_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    agent(dir.path(), "1", 0..2);
    let scenario = crate::open(dir.path()).unwrap().scenarios.remove(0);
    for kinds in [r#"{"agent_kinds": "units"}"#, r#"{"ego_kind": "unit"}"#] {
        let config: ProtocolConfig = serde_json::from_str(kinds).unwrap();
        let protocol = config.resolve(Layout::OPV2V).unwrap();
        assert_eq!(protocol.ego, EgoKind::Unit, "{kinds}");
        assert!(protocol.arrange(&scenario).is_none(), "{kinds}");
    }
}

#[test]
fn the_page_of_data_sets_names_every_layout_and_protocol() {
    let page = include_str!("../../../../deploy/docs/reference/datasets.md").replace('`', "");
    for layout in &crate::LAYOUTS {
        let row = format!(
            "| {} | {} | {} |",
            layout.name, layout.data_sets, layout.files
        );
        assert!(
            page.contains(&row),
            "deploy/docs/reference/datasets.md lacks {row}"
        );
    }
    for (name, _) in PRESETS {
        let protocol = EvaluationProtocol::preset(name).unwrap();
        let row = page.lines().find(|line| {
            line.starts_with('|') && line.split(['|', ',']).any(|cell| cell.trim() == name)
        });
        let row = row
            .unwrap_or_else(|| panic!("deploy/docs/reference/datasets.md lacks protocol {name}"));
        let range = format!("| {} m |", protocol.ground_truth.comm_range_m);
        assert!(row.contains(&range), "{row} lacks {range}");
    }
}
