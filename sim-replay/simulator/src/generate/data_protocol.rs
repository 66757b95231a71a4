//! `data_protocol.yaml`: settings with which a scenario was made.

use super::layout::SceneLayout;
use super::options::SynthOptions;
use super::recording::SceneSpec;
use super::traffic::STEP_S;
use crate::map::{Finding, MapModel};

/// The text of the file for a converted scene: source layout and name of the scenario there.
pub(crate) fn converted_yaml(from: &str, scenario: &str, tick_nanos: u64) -> String {
    let (version, tick_s) = (env!("CARGO_PKG_VERSION"), tick_nanos as f64 / 1e9);
    let scenario = scenario.replace('\'', "''");
    format!(
        "\
description: converted scene
converter:
  name: sim-replay convert
  version: {version}
  from: {from}
  scenario: '{scenario}'
world:
  fixed_delta_seconds: {tick_s}
"
    )
}

/// The text of the file. It holds every setting that determines the bytes of the scenario, and the sensors in the terms
/// of OpenCDA.
pub(crate) fn protocol_yaml(options: &SynthOptions, spec: &SceneSpec, model: &MapModel) -> String {
    let (seed, map_seed) = (options.seed, options.map_seed);
    let (frames, period_s) = (options.frames, options.period_s);
    let (name, map_name, scene_seed, agents) = (&spec.name, &model.name, spec.seed, spec.agents);
    let (subset, weather) = (options.subset.name(), options.weather.name());
    let version = env!("CARGO_PKG_VERSION");
    // Without the entry the layout is OPV2V's.
    let layout = match options.layout {
        SceneLayout::Opv2v => String::new(),
        layout => format!("  layout: {}\n", layout.name()),
    };
    let map = map_yaml(&model.findings);
    let cameras = options.cameras.map_or_else(String::new, |size| {
        format!("      camera:\n        fov: 100\n        image_size: {size}\n        num: 4\n")
    });
    format!(
        "\
description: generated scene, no recording
generator:
  name: sim-replay synth
  version: {version}
  subset: {subset}
  scenario: {name}
  seed: {seed}
  scene_seed: {scene_seed}
  town: '{map_name}'
  town_seed: {map_seed}
  agents: {agents}
  frames: {frames}
  period_seconds: {period_s}
  weather: {weather}
{layout}vehicle_base:
  sensing:
    localization:
      gnss:
        heading_direction_stddev: 0.1
        noise_alt_stddev: 0.001
        noise_lat_stddev: 1.0e-06
        noise_lon_stddev: 1.0e-06
        speed_stddev: 0.2
    perception:
      lidar:
        channels: 64
        dropoff_general_rate: 0.1
        dropoff_intensity_limit: 0.7
        dropoff_zero_intensity: 0.15
        lower_fov: -25
        noise_stddev: 0.02
        points_per_second: 1300000
        range: 120
        rotation_frequency: 20
        upper_fov: 2
      radar:
        horizontal_fov: 120
        range: 150
        red_channel_mps: [-64, 64]
        vertical_fov: 30
{cameras}world:
  fixed_delta_seconds: {STEP_S}
  seed: {seed}
  sync_mode: true
{map}"
    )
}

/// Findings of the map: parts that were not built as the file gives them; empty if there are none.
fn map_yaml(findings: &[Finding]) -> String {
    if findings.is_empty() {
        return String::new();
    }
    // JSON is valid YAML, and its strings need no further escaping.
    let lines = findings
        .iter()
        .filter_map(|finding| serde_json::to_string(finding).ok());
    lines.fold("map_findings:\n".to_owned(), |yaml, line| {
        yaml + "  - " + &line + "\n"
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn finding(within: Option<&str>, found: &str) -> Finding {
        Finding {
            line: 7,
            within: within.map(str::to_owned),
            element: "speed".into(),
            found: found.into(),
            action: "treated as absent".into(),
            count: 2,
        }
    }

    #[test]
    fn findings_of_the_map_are_read_back() {
        let findings = [
            finding(Some("road 1: '2'"), "max=\"-1\" #{[: \u{e9}"),
            finding(None, "- x"),
        ];
        let read: serde_json::Value = serde_saphyr::from_str(&map_yaml(&findings)).unwrap();
        assert_eq!(read, serde_json::json!({ "map_findings": findings }));
        assert_eq!(map_yaml(&[]), "");
    }
}
