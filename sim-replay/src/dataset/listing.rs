//! Which data it is, in one line.

use sha2::{Digest, Sha256};

use super::Scenario;

/// SHA-256 over names, agents and capture times, in hexadecimal digits: the same for the same data wherever it lies, for
/// model cards.
#[must_use]
pub fn listing_sha256<'a>(scenarios: impl IntoIterator<Item = &'a Scenario>) -> String {
    let mut hash = Sha256::new();
    for scenario in scenarios {
        hash.update(scenario.name.as_bytes());
        scenario.agents.iter().for_each(|agent| hash.update(format!("/{agent}")));
        scenario.ticks.iter().for_each(|tick| hash.update(format!("\n{} {}", tick.stem, tick.capture_nanos)));
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::dataset;

    #[test]
    fn the_hash_is_of_names_agents_and_times() {
        let folder = tempfile::tempdir().unwrap();
        for agent in ["4279", "4288"] {
            let path = folder.path().join("scene").join(agent);
            fs::create_dir_all(&path).unwrap();
            for tick in ["000068", "000070"] {
                fs::write(path.join(format!("{tick}.yaml")), "").unwrap();
                fs::write(path.join(format!("{tick}.pcd")), "").unwrap();
            }
        }
        let dataset = dataset::open(&folder.path().join("scene")).unwrap();
        let scenario = &dataset.scenarios[0];
        assert_eq!((scenario.agents.len(), scenario.ticks.len()), (2, 2));
        let [first, second] = [0, 1].map(|tick| scenario.ticks[tick].capture_nanos);
        let text = format!("scene/4279/4288\n000068 {first}\n000070 {second}");
        let expected: String = Sha256::digest(text).iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(listing_sha256(&dataset.scenarios), expected);
    }
}
