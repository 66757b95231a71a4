//! Map of a generated scenario, from its `data_protocol.yaml`.

use std::fmt;
use std::path::Path;

use super::yaml::{self, YamlField};
use super::{Result, Scenario};

/// A generated map: the name of its roads and the seed of its objects.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GeneratedMap {
    /// Name of the road map.
    pub name: String,
    /// Seed of the objects beside the roads.
    pub seed: u64,
}

impl fmt::Display for GeneratedMap {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.name, self.seed)
    }
}

impl Scenario {
    /// The map that a scenario was generated on.
    ///
    /// # Errors
    /// [`crate::ReadError`] when there is no protocol of a generation in the scenario's folder, or it names no map.
    pub fn generated_map(&self) -> Result<GeneratedMap> {
        let points = self.points_path(0, 0, None)?;
        // `<scenario>/<agent>/<frame>`: the folder two levels above a sweep.
        let folder = points.ancestors().nth(2).unwrap_or(Path::new(""));
        let path = folder.join("data_protocol.yaml");
        let node = yaml::read(&path)?;
        let generator = YamlField::root(&path, &node).required("generator")?;
        let seed = generator.required("town_seed")?;
        Ok(GeneratedMap {
            name: generator.required("town")?.text()?.to_owned(),
            seed: seed
                .integer()?
                .try_into()
                .map_err(|_| seed.expected("a seed"))?,
        })
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    #[test]
    fn the_map_of_a_generated_scene_is_read_from_its_protocol() {
        let dir = tempfile::tempdir().unwrap();
        let agent = dir.path().join("scene/7");
        fs::create_dir_all(&agent).unwrap();
        fs::write(
            agent.join("000069.yaml"),
            "lidar_pose: [0, 0, 0, 0, 0, 0]\n",
        )
        .unwrap();
        fs::write(agent.join("000069.pcd"), "").unwrap();
        let map = || crate::open(dir.path()).unwrap().scenarios[0].generated_map();
        assert!(
            map()
                .unwrap_err()
                .to_string()
                .contains("data_protocol.yaml")
        );
        let text = "description: x\ngenerator:\n  name: synth\n  town: 'town4'\n  town_seed: 5\nworld:\n  seed: 1\n";
        fs::write(dir.path().join("scene/data_protocol.yaml"), text).unwrap();
        assert_eq!(map().unwrap().to_string(), "town4:5");
    }
}
