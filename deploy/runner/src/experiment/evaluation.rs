//! Evaluation of one cell of an experiment: a method on recorded scenes, with or without link emulation.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use agent::attack::Falsification;
use agent::config::{AgentSettings, SentBoxes};
use agent::rate::RateConfig;
use anyhow::{Context, Result, bail, ensure};
use dataset::evaluation_protocol::{EvaluationProtocol, ProtocolConfig, lacking};
use dataset::{self, IntensityScale, OpenOptions, ReadError, Scenario, findings};
use deploy::score::FrameScores;
use deploy::score::metrics::{Messages, Metrics};
use ego_fuser_offline::evaluation::stepped::ComputeTimes;
use ego_fuser_offline::evaluation::{AgentPool, Evaluator, Setup};
use fusion::{Exchange, Method};
use perception::weights::Weights;
use protocol::{CodecConfig, Stream, Topic};
use support::cli::NotWritten;
use support::file_digests::FileDigests;
use support::provenance::Provenance;
use support::sampling::evenly_spread;
use support::sync::lock;
use training::feature_store::{FeatureStore, KeptMaps, MapSource};

use crate::cached_poses;
use crate::evaluated_frame::{judge, metrics};
use crate::experiment::cell::{Cell, CellKey};
use crate::experiment::frame_files;
use crate::scenario::fingerprint::files_of;
use crate::scenario::weights_choice::weights_of;

/// A cell of an experiment: vehicles, ego and link as in a run, and the part of a data set that they see.
#[derive(Debug, Clone, Default)]
pub struct Trial {
    /// Data set, split or scenario.
    pub dataset: PathBuf,
    /// Number of scenarios, evenly spread; absent: all. `setup.frames` is of each.
    pub scenarios: Option<usize>,
    /// Divisor of the intensities of its sweeps.
    pub intensity_scale: IntensityScale,
    /// Participating vehicles, counted annotations and objects.
    pub protocol: ProtocolConfig,
    /// Vehicles, ego and delivery. The weights may be a folder with those of several methods; `method` and `protocol`
    /// follow from the method that is evaluated and from the data set.
    pub setup: Setup,
    /// Cache of the encoders' feature maps, so that each is computed once for many evaluations.
    pub maps: Option<KeptMaps>,
    /// Folder for detections, ground truth, a row per frame, and precision over recall, a folder per method in it;
    /// absent: none are written.
    pub out: Option<PathBuf>,
}

/// Data set, opened for evaluation by a protocol.
#[derive(Debug)]
pub struct OpenedData {
    /// Scenarios, with the participating agents.
    pub scenarios: Vec<Scenario>,
    /// The same with all their agents and ticks.
    recorded: Vec<Scenario>,
    /// Evaluation protocol.
    pub protocol: EvaluationProtocol,
    /// Parts of the data set that cannot be used.
    pub problems: Vec<ReadError>,
    /// Digests of the files that were read so far.
    pub digests: FileDigests,
    /// SHA-256 of each part that was asked for, by the number of its scenarios and the variant of its sweeps.
    parts: Mutex<BTreeMap<DataPart, String>>,
}

/// Number of scenarios, and variant of the sweeps.
type DataPart = (Option<usize>, Option<String>);

impl OpenedData {
    /// Opens the data set of a trial: all its scenarios, each with the agents of the protocol and the requested frames.
    /// Feature maps are cached for all of them, so that another selection needs no others.
    ///
    /// # Errors
    /// An error when it cannot be read, the protocol contradicts itself, or no scenario has an ego of it.
    pub fn open(trial: &Trial) -> Result<Self> {
        let options = OpenOptions::with_intensity_scale(trial.intensity_scale);
        let (path, frames) = (&trial.dataset, trial.setup.frames);
        let dataset = dataset::open_with(path, &options)?;
        let (protocol, scenarios) = trial.protocol.arrange_all(path, &dataset, frames)?;
        Ok(Self {
            scenarios,
            recorded: dataset.scenarios,
            protocol,
            problems: dataset.problems,
            digests: FileDigests::default(),
            parts: Mutex::default(),
        })
    }

    /// So many scenarios, evenly spread.
    pub fn chosen(&self, scenarios: Option<usize>) -> impl Iterator<Item = &Scenario> {
        let all: Vec<&Scenario> = self.scenarios.iter().collect();
        evenly_spread(&all, scenarios.unwrap_or(usize::MAX)).into_iter()
    }

    /// Sentences about numbers below the requested ones, see [`lacking`].
    pub fn lacking(&self, scenarios: Option<usize>, frames: Option<usize>) -> Vec<String> {
        lacking(&self.recorded, &self.scenarios, scenarios, frames)
    }

    /// Number of frames of so many scenarios.
    pub fn frame_count(&self, scenarios: Option<usize>) -> usize {
        let chosen = self.chosen(scenarios);
        chosen.map(|scenario| scenario.ticks.len()).sum()
    }

    /// SHA-256 of a part and of a variant of its sweeps ([`dataset::content_sha256`]), which is computed once.
    fn sha256(&self, scenarios: Option<usize>, variant: Option<&str>) -> String {
        let mut parts = lock(&self.parts);
        let place = (scenarios, variant.map(str::to_owned));
        let sha256 = parts.entry(place).or_insert_with(|| {
            dataset::content_sha256(self.chosen(scenarios), variant, &self.digests)
        });
        sha256.clone()
    }
}

impl Trial {
    /// Identity of the result of a method: these settings, and the digests of all that they are applied to.
    ///
    /// # Errors
    /// An error that names the file that cannot be read.
    pub fn key(&self, data: &OpenedData, method: Method) -> Result<CellKey> {
        let provenance = self.provenance(data, method)?;
        // The contents of data and weights count, their places do not; kept maps change no result.
        let mut settings = Self {
            dataset: PathBuf::new(),
            maps: None,
            out: None,
            ..self.clone()
        };
        let setup = &mut settings.setup;
        setup.models.weights = PathBuf::new();
        let vehicles = setup.vehicles.values_mut();
        // Only whether a vehicle has weights of its own counts here: their contents are in the provenance.
        for settings in std::iter::once(&mut setup.agents).chain(vehicles) {
            settings.weights = settings.weights.take().map(|_| PathBuf::new());
        }
        Ok(CellKey {
            method,
            // The debug text has every field, so a new setting changes the key by itself.
            sha256: provenance.key(&format!("{method} {settings:?} {:?}", data.protocol)),
            provenance,
        })
    }

    /// Refuses settings that have no effect with any of these methods, and values out of range.
    ///
    /// # Errors
    /// An error that names the setting.
    pub fn check(&self, methods: &[Method]) -> Result<()> {
        let setup = &self.setup;
        let attackers = setup.attack.map(|attack| attack.attackers);
        ensure!(attackers != Some(0), "attackers is 0, must be 1 or more");
        let delay_ms = setup.delay_ms;
        ensure!(
            delay_ms <= 10_000,
            "delay_ms is {delay_ms}, must be 0 to 10000"
        );
        let names: Vec<&str> = methods.iter().map(|method| method.name()).collect();
        let contents: Vec<Exchange> = methods.iter().map(|one| one.exchange()).collect();
        let maps = contents.contains(&Exchange::Features);
        let boxes = contents.contains(&Exchange::Boxes) || setup.agents.boxes.is_some();
        let messages = contents.iter().any(|one| *one != Exchange::Nothing);
        // Over a link the ego alone has its compute times.
        let waits = setup.link.is_some() && setup.compute == ComputeTimes::default();
        let listens = setup.attack.is_some() || setup.ego.trust || setup.delay_ms > 0 || waits;
        let falsified = setup.attack.map(|attack| attack.falsification);
        let AgentSettings { codec, rate, .. } = &setup.agents;
        let encodes = *codec != CodecConfig::default() || *rate != RateConfig::default();
        let rule = if encodes && !maps {
            "options of the codec and of the rate are for feature maps: METHODS sends none"
        } else if encodes && setup.agents.boxes == Some(SentBoxes::Only) {
            "options of the codec and of the rate are for feature maps: with boxes only METHODS sends none"
        } else if setup.agents.boxes.is_some() && !maps {
            "boxes is for methods that exchange feature maps: METHODS does not"
        } else if setup.agents.weights.is_some() && !messages {
            "neighbour_weights is for messages of neighbours: METHODS receives none"
        } else if setup.ego.box_alignment && !boxes {
            "box_alignment is for boxes of neighbours: METHODS receives none"
        } else if falsified == Some(Falsification::FalseVelocity) && !boxes {
            "attack false_velocity is for boxes of neighbours: METHODS receives none"
        } else if listens && !messages {
            "attack, trust, delay_ms and link are for messages of neighbours: METHODS uses none"
        } else {
            return Ok(());
        };
        bail!(rule.replace("METHODS", &names.join(", ")))
    }

    /// Refuses vehicles that a scenario does not have, and more attackers than any scenario has neighbours.
    ///
    /// # Errors
    /// An error with both numbers.
    pub fn check_participants(&self, data: &OpenedData) -> Result<()> {
        let mut neighbours = 0;
        for Scenario { name, agents, .. } in data.chosen(self.scenarios) {
            let found = agents.len();
            let asked = match self.setup.pool {
                AgentPool::First(vehicles) => vehicles,
                AgentPool::All | AgentPool::Named(_) => found,
            };
            ensure!(
                asked <= found,
                "vehicles is {asked}, but scenario {name} has {found} vehicles"
            );
            neighbours = neighbours.max(asked.saturating_sub(1));
        }
        let attackers = self.setup.attack.map_or(0, |attack| attack.attackers);
        ensure!(
            attackers <= neighbours,
            "attackers is {attackers}, but no scenario has more than {neighbours} neighbours"
        );
        Ok(())
    }

    /// The evaluator of a method, with its weights.
    ///
    /// # Errors
    /// An error that names the file that is missing, cannot be read, or is of another method.
    pub fn evaluator(&self, data: &OpenedData, method: Method) -> Result<Evaluator> {
        let mut setup = Setup {
            method: Some(method),
            protocol: Some(data.protocol.clone()),
            ..self.setup.clone()
        };
        setup.models.weights = self.weights(method)?;
        let chosen = data.chosen(self.scenarios).map(|one| &one.name);
        let chosen: Vec<&String> = chosen.collect();
        for settings in self.settings() {
            let recorded = data.recorded.iter();
            let recorded = recorded.filter(|one| chosen.contains(&&one.name));
            cached_poses::check(&settings.pose, recorded, &data.digests)?;
        }
        Ok(Evaluator::new(setup)?)
    }

    /// File of the weights of a method.
    fn weights(&self, method: Method) -> Result<PathBuf> {
        let weights = &self.setup.models.weights;
        // True if a vehicle sends boxes where a method fuses feature maps.
        let sends_boxes = self.settings().any(|settings| settings.boxes.is_some());
        Ok(weights_of(weights, method, sends_boxes)?)
    }

    /// Settings of all vehicles, then those of single ones.
    fn settings(&self) -> impl Iterator<Item = &AgentSettings> {
        std::iter::once(&self.setup.agents).chain(self.setup.vehicles.values())
    }

    /// Digests of all that these settings are applied to.
    fn provenance(&self, data: &OpenedData, method: Method) -> Result<Provenance> {
        let setup = &self.setup;
        let link = setup.link.as_ref();
        let link = link.map(|link| (&link.config, link.folder.as_path()));
        let files = files_of(method, self.weights(method)?, self.settings(), link);
        let data_sha256 = data.sha256(self.scenarios, setup.lidar_variant.as_deref());
        let (commit, digests) = (env!("V2VLOC_COMMIT"), &data.digests);
        let collected = Provenance::collect(&[], data_sha256, files, commit, digests);
        Ok(collected?)
    }
}

/// Evaluates one method over the chosen scenarios, the first vehicle of each being the ego; `on_frame` is called after
/// every frame. Frames and parts that cannot be read, and ticks without the ego's true pose, are left out and counted in
/// [`Metrics::left_out`].
///
/// # Errors
/// An error when no frame can be evaluated.
pub fn evaluate(
    trial: &Trial,
    data: &OpenedData,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<Metrics> {
    let metrics = compute(trial, data, trial.key(data, method)?, on_frame)?.metrics;
    if let Some(out) = &trial.out {
        frame_files::write_metrics(out, method, &metrics)?;
    }
    Ok(metrics)
}

/// [`evaluate`] for the cell of a key.
///
/// # Errors
/// As [`evaluate`].
pub fn compute(
    trial: &Trial,
    data: &OpenedData,
    key: CellKey,
    on_frame: &mut dyn FnMut(),
) -> Result<Cell> {
    let began = Instant::now();
    let (scores, evaluator) = judged(trial, data, key.method, on_frame)?;
    let is_pose =
        |topic: &Topic| matches!(topic, Topic::Stream { stream, .. } if *stream == Stream::Pose);
    let messages = Messages::of_evaluation(&evaluator.ledger, |topic| !is_pose(topic));
    let used = scores.records().iter().map(|record| record.fused as u64);
    // Over a link the time of the scene passes. Without one only the time of computing is known.
    let (clock, seconds) = match trial.setup.link {
        Some(_) => ("stepped", scores.seconds()),
        None => ("offline", began.elapsed().as_secs_f64()),
    };
    let poses = trial.setup.agents.pose.name();
    let mut metrics = metrics(&scores, &evaluator, clock, poses, seconds);
    metrics.provenance = Some(key.provenance.clone().with_command());
    Ok(Cell {
        key,
        metrics,
        used: used.sum(),
        messages,
        wall_seconds: began.elapsed().as_secs_f64(),
    })
}

/// Scores of all frames, and the evaluator with its accounts.
fn judged(
    trial: &Trial,
    data: &OpenedData,
    method: Method,
    on_frame: &mut dyn FnMut(),
) -> Result<(FrameScores, Evaluator)> {
    let mut evaluator = trial.evaluator(data, method)?;
    let kept = trial.maps.as_ref();
    // Early fusion encodes merged clouds, for which maps of single sweeps are of no use.
    if let Some(kept) = kept.filter(|_| method.exchange() != Exchange::Points) {
        evaluator = evaluator.with_maps(maps(trial, kept, data, method)?);
    }
    let (scale, rule) = (trial.intensity_scale, &data.protocol.ground_truth);
    let findings = findings::sampled(&data.scenarios, scale, Some(rule));
    evaluator.left_out.add_files(&data.problems);
    evaluator.left_out.add_findings(findings);
    let detector = evaluator.ego.detector().config();
    let map_values = detector.feature_grid().cells() as u64 * detector.sent_channels() as u64;
    let is_timed = evaluator.setup.is_timed();
    let mut scores: Option<FrameScores> = None;
    let out = trial.out.as_ref();
    let files = out.map(|out| frame_files::create(out, method));
    let mut files = files.transpose()?;
    // Of each record of the scores.
    let mut scenarios = Vec::new();
    for scenario in data.chosen(trial.scenarios) {
        let Some(ego) = scenario.agents.first() else {
            continue;
        };
        // One set of scores over all scenarios: AP orders the detections of all frames together.
        let scores =
            scores.get_or_insert_with(|| FrameScores::new(ego.clone(), evaluator.rule, map_values));
        scores.change_ego(ego);
        let judged = evaluator.run(scenario, &mut |frame| {
            let mut files = files.iter_mut();
            let written = files.try_for_each(|files| files.add(Some(&scenario.name), &frame));
            judge(scores, frame, is_timed);
            on_frame();
            written
        })?;
        scenarios.resize(scores.records().len(), scenario.name.clone());
        // A file could not be written. finish returns the error.
        if judged.is_break() {
            break;
        }
    }
    let scores = scores.filter(|scores| scores.ticks() != (0, 0));
    let scores = scores.with_context(|| {
        let (path, reasons) = (trial.dataset.display(), evaluator.left_out.reasons());
        format!("{path}: there is no frame in it that can be evaluated{reasons}")
    })?;
    let finished = files.map(|files| frame_files::finish(files, &scores, &scenarios));
    finished.transpose()?;
    Ok((scores, evaluator))
}

/// Feature maps of all sweeps, from the cache or encoded now.
fn maps(trial: &Trial, kept: &KeptMaps, data: &OpenedData, method: Method) -> Result<MapSource> {
    let weights = Weights::load(&trial.weights(method)?)?;
    let weights = Arc::new(weights.with_precision(trial.setup.models.precision));
    fs::create_dir_all(&kept.folder).with_context(|| NotWritten(kept.folder.clone()))?;
    let (scenarios, digests) = (&data.scenarios, &data.digests);
    let store = FeatureStore::open(kept, &weights, scenarios, digests, 1, &mut |_, _| {})?;
    Ok(MapSource::new(Arc::new(store), weights))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use agent::attack::AttackConfig;
    use dataset::evaluation_protocol::EgoKind;

    use super::*;

    /// A data set of three scenarios: of one, two and three vehicles.
    fn write_scenarios(root: &Path) {
        for (scenario, vehicles) in [("alone", 1), ("pair", 2), ("three", 3)] {
            for id in 1..=vehicles {
                let folder = root.join(scenario).join(id.to_string());
                fs::create_dir_all(&folder).unwrap();
                let pose = "lidar_pose: [0, 0, 2, 0, 0, 0]\nvehicles: {}\n";
                fs::write(folder.join("000000.yaml"), pose).unwrap();
                fs::write(folder.join("000000.pcd"), "").unwrap();
            }
        }
    }

    #[test]
    fn scenarios_without_an_ego_of_the_protocol_and_fewer_frames_are_named() {
        let folder = tempfile::tempdir().unwrap();
        write_scenarios(folder.path());
        let mut trial = Trial {
            dataset: folder.path().to_owned(),
            ..Trial::default()
        };
        trial.protocol.ego_kind = Some(EgoKind::Unit);
        let none = OpenedData::open(&trial).unwrap_err().to_string();
        assert!(
            none.ends_with("of the protocol: ego_kind is Unit"),
            "{none}"
        );
        let unit = folder.path().join("pair/2");
        fs::rename(unit, folder.path().join("pair/-1")).unwrap();
        let data = OpenedData::open(&trial).unwrap();
        let others = "left out, without an ego of the protocol: alone, three";
        assert_eq!(data.lacking(None, Some(1)), [others]);
        trial.protocol.ego_kind = None;
        let data = OpenedData::open(&trial).unwrap();
        assert!(data.lacking(None, None).is_empty());
        let fewer = "9 frames were asked for, there were 1";
        assert_eq!(data.lacking(Some(1), Some(9)), [fewer]);
        let fewer = "4 scenarios were asked for, there were 3";
        assert_eq!(data.lacking(Some(4), Some(1)), [fewer]);
    }

    #[test]
    fn vehicles_and_attackers_that_the_data_do_not_have_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        write_scenarios(folder.path());
        let problem = |dataset: PathBuf, attackers, pool| {
            let mut trial = Trial {
                dataset,
                ..Trial::default()
            };
            trial.setup.attack = Some(AttackConfig {
                falsification: Falsification::Noise,
                attackers,
                seed: 0,
            });
            trial.setup.pool = pool;
            let data = OpenedData::open(&trial).unwrap();
            let checked = trial.check_participants(&data).err();
            checked.map_or(String::new(), |problem| problem.to_string())
        };
        let all = || folder.path().to_owned();
        assert_eq!(problem(all(), 2, AgentPool::All), "");
        let none = "attackers is 3, but no scenario has more than 2 neighbours";
        assert_eq!(problem(all(), 3, AgentPool::All), none);
        let lacking = "vehicles is 2, but scenario alone has 1 vehicles";
        assert_eq!(problem(all(), 1, AgentPool::First(2)), lacking);
        let one = "attackers is 2, but no scenario has more than 1 neighbours";
        let three = folder.path().join("three");
        assert_eq!(problem(three, 2, AgentPool::First(2)), one);
        let alone = problem(folder.path().join("alone"), 1, AgentPool::All);
        assert_eq!(
            alone,
            "attackers is 1, but no scenario has more than 0 neighbours"
        );
    }
}
