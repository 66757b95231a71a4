//! Settings of a run that have no effect with its method.

use agent::config::AgentSettings;
use protocol::CodecConfig;

use super::evaluation::Trial;
use crate::scenario::Scenario;

/// Sentences about settings, of all vehicles and of single ones, that have no effect with the method of the run.
pub fn without_effect(scenario: &Scenario) -> Vec<String> {
    let plain = AgentSettings::default();
    let single = scenario.vehicles.iter();
    let single = single.map(|(cav, own)| (format!("vehicles.{cav}: "), own.over(&plain)));
    let all = std::iter::once((String::new(), scenario.agents.clone())).chain(single);
    let sentences = all.filter_map(|(place, settings)| {
        let mut trial = Trial::default();
        if place.is_empty() {
            trial.setup.ego = scenario.ego.clone();
        }
        trial.setup.agents = AgentSettings {
            // The format of maps may stand there for other methods.
            codec: CodecConfig::default(),
            ..settings
        };
        let problem = trial.check(&[scenario.method]).err()?;
        Some(format!("without effect: {place}{problem}"))
    });
    sentences.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    use agent::config::SentBoxes;

    #[test]
    fn settings_without_effect_are_named_of_single_vehicles_too() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("s.yaml");
        let vehicles = "{1009: {rate: {message_bytes: 75000}}}";
        let text = format!("scene: {{dir: .}}\nmodels: {{weights: .}}\nvehicles: {vehicles}\n");
        std::fs::write(&file, text).unwrap();
        let mut scenario = Scenario::read(&file).unwrap();
        assert!(without_effect(&scenario).is_empty());
        let mut of_boxes = scenario.clone();
        of_boxes.agents.boxes = Some(SentBoxes::Only);
        of_boxes.agents.rate.message_bytes = Some(75_000);
        let found = without_effect(&of_boxes);
        assert!(found[0].contains("with boxes only"), "{found:?}");
        scenario.method = "late".parse().unwrap();
        let found = without_effect(&scenario);
        let expected = "without effect: vehicles.1009: options of the codec and of the rate are";
        assert!(
            found.len() == 1 && found[0].starts_with(expected),
            "{found:?}"
        );
    }
}
