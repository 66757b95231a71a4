//! `ego-fuser train`: arguments, and a progress bar or plain lines.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use agent_offline::TrainingBar;
use agent_offline::sweep_database::repeated;
use anyhow::{Context, Result};
use clap::ArgGroup;
use dataset::Layout;
use dataset::evaluation_protocol::ProtocolConfig;
use fusion::model::ModelError;
use fusion::pastat::{Part, ablated};
use fusion::{Exchange, FusionConfig, Method};
use localization::pose_source::{NoiseMode, NoisyPoseConfig, PoseTable};
use perception::model_config::DetectorConfig;
use perception::train::{TrainingEvent, TrainingOptions};
use perception::weights::Weights;
use protocol::Dtype;
use training::Error;
use training::feature_store::KeptMaps;
use training::loss::{LossConfig, Unassigned};
use training::samples::{Augmentation, Moments, SampleConfig, SampleKind, SamplePoses};
use training::train::{self, TrainConfig};

use super::DataSets;
use support::bounded_file;
use support::cli::BadInput;
use support::output;

/// Largest file of a network, bytes.
const MAX_NETWORK_BYTES: u64 = 1 << 20;

/// Trains a method on scenes; writes checkpoint, curve.csv and curve.png, weights.safetensors and model-card.md.
#[derive(Debug, clap::Args)]
#[command(group = ArgGroup::new("noise").args(["noise_position_std_m", "noise_heading_std_deg"]).multiple(true))]
pub(crate) struct Arguments {
    #[command(flatten)]
    data: DataSets,
    /// Datasets to measure AP on; none: no validation.
    #[arg(long, num_args = 1.., value_name = "DIR")]
    validation: Vec<PathBuf>,
    /// Method: none, early or one that exchanges feature maps; `ego-fuser methods` lists them.
    #[arg(long, default_value_t = Method::NONE)]
    method: Method,
    /// Network: lean, full or a JSON file of its fields; with --init it is that of the weights.
    #[arg(long, value_name = "NAME|FILE", default_value = "lean", conflicts_with = "init", value_parser = parse_network)]
    network: DetectorConfig,
    /// Weights to begin with, for example those of `none`.
    // Required as a group of one option: clap forgets the requirement of an option that another excludes.
    #[arg(long, value_name = "FILE", group = "beginning")]
    init: Option<PathBuf>,
    /// Samples of a step.
    #[arg(long, default_value_t = 4)]
    batch: usize,
    /// Highest learning rate.
    #[arg(long, default_value_t = 2e-3)]
    lr: f64,
    /// Weight decay.
    #[arg(long, default_value_t = 1e-2)]
    weight_decay: f64,
    /// Ignore anchors between the overlap thresholds, rather than count them as background as in OpenCOOD.
    #[arg(long)]
    ignore_unassigned: bool,
    /// Probability that a neighbour is missing from a sample.
    #[arg(long, default_value_t = 0.1)]
    drop_neighbour: f64,
    /// Poses to align maps by, as `agent localize` wrote them, of all scenes in one table or several [default: true
    /// poses].
    #[arg(long, value_name = "FILE", num_args = 1..)]
    poses: Vec<PathBuf>,
    /// Standard deviation of an additional error of x, y and z of the vehicles' poses, metres.
    #[arg(long, value_name = "M", default_value_t = 0.0)]
    noise_position_std_m: f64,
    /// Standard deviation of an additional error of yaw of the vehicles' poses, degrees.
    #[arg(long, value_name = "DEG", default_value_t = 0.0)]
    noise_heading_std_deg: f64,
    /// Correlation of the errors of a sample's vehicles and time steps.
    #[arg(long, value_enum, default_value_t, requires = "noise")]
    noise_mode: NoiseMode,
    /// Share of the samples with that error.
    #[arg(long, value_name = "SHARE", default_value_t = 1.0, requires = "noise")]
    noise_share: f64,
    /// Share of the samples in which one neighbour is 5 to 30 m from its reported pose, and overconfident.
    #[arg(long, default_value_t = 0.0)]
    lost_share: f64,
    /// Largest delay of neighbours' maps relative to the ego's in training, milliseconds.
    #[arg(long, value_name = "MS", default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=5_000))]
    max_delay_ms: u64,
    /// Largest number of ticks between two time steps of a method with history; every sample draws its own number.
    #[arg(long, default_value_t = 1)]
    gap: usize,
    /// Time steps of every vehicle [default: that of the method].
    #[arg(long)]
    time_steps: Option<usize>,
    /// Parts of pastat to leave out.
    #[arg(long, value_enum, value_delimiter = ',')]
    without: Vec<Part>,
    /// Weight of the loss that trains a fusion with pose correction (pastat) to undo the additional errors.
    #[arg(long, default_value_t = 0.0)]
    alignment_weight: f64,
    /// Freeze the encoder of --init and train the fusion and the head only: fast, as maps are computed once.
    #[arg(long, requires = "beginning")]
    freeze_encoder: bool,
    /// Freeze the method and the head of --init too, and train a box input behind it, a part that reads the boxes
    /// of neighbours that send no map, and the refinement of the boxes that a vehicle sends.
    #[arg(long, requires = "freeze_encoder")]
    box_input: bool,
    /// Folder of such maps.
    #[arg(
        long,
        value_name = "DIR",
        default_value = "runs/maps",
        requires = "freeze_encoder"
    )]
    feature_maps: PathBuf,
    /// Largest size of them per set of data, gigabytes; sweeps beyond are encoded whenever they are needed.
    #[arg(
        long,
        value_name = "GB",
        default_value_t = 8.0,
        requires = "freeze_encoder"
    )]
    feature_maps_limit_gb: f64,
    /// Numeric type of such maps.
    #[arg(long, value_enum, default_value_t = Exactness::F16, requires = "freeze_encoder")]
    feature_maps_dtype: Exactness,
    /// Largest turn of a vehicle's frame in training, degrees.
    #[arg(long, value_name = "DEG", default_value_t = 45.0)]
    turn_deg: f64,
    /// Of the protocol's options, `--max-agents` is of a sample [default: 5].
    #[command(flatten)]
    protocol: ProtocolConfig,
    /// Train for ego-only operation: samples of one vehicle, with its neighbours' annotations as additional targets
    /// [default for none: its own annotations only].
    #[arg(long)]
    ego_only: bool,
    /// Steps between two validations and checkpoints.
    #[arg(long, default_value_t = 500)]
    validate_every_steps: u64,
    /// Frames of a validation.
    #[arg(long, value_name = "N", default_value_t = 60, requires = "validation")]
    validation_frames: usize,
    #[command(flatten)]
    options: TrainingOptions,
}

fn parse_network(name: &str) -> Result<DetectorConfig, String> {
    if let Some(preset) = DetectorConfig::preset(name) {
        return Ok(preset);
    }
    let text = bounded_file::read_text(Path::new(name), MAX_NETWORK_BYTES)
        .map_err(|error| format!("neither lean, full nor a file that can be read: {error}"))?;
    let network: DetectorConfig = serde_json::from_str(&text).map_err(|error| error.to_string())?;
    network.validate().map_err(|error| error.to_string())?;
    Ok(network)
}

impl Arguments {
    /// Trains and reports the result.
    pub(crate) fn run(&self) -> Result<()> {
        let config = self.config()?;
        let bar = TrainingBar::of(config.run.length);
        if let Some(hint) = self.hint() {
            bar.print_line(hint);
        }
        let summary = train::run(&config, &mut |event| match event {
            TrainingEvent::Encoding(done, all) if !done.is_multiple_of(50) && done != all => {}
            event => bar.show_progress(event),
        });
        let summary = summary.map_err(blamed)?;
        bar.finish();
        let accuracy = serde_json::json!({"accuracy": summary.accuracy});
        self.options.print(&summary.trained, &accuracy)?;
        Ok(())
    }

    /// Hint at a faster way where a training from scratch was not meant.
    fn hint(&self) -> Option<&'static str> {
        // Merged points are encoded together, by an encoder that is trained with the rest.
        (self.init.is_none() && self.method.exchange() != Exchange::Points).then_some(
            "training from scratch, including the encoder; --init deploy/weights/lean-max.safetensors --freeze-encoder \
             trains fusion and head only, several times faster",
        )
    }

    /// Refuses options that change nothing of this training.
    fn check_effects(&self) -> Result<(), BadInput> {
        if self.protocol.ap_order.is_some() {
            let reason =
                "--ap-order: the curve of a training has one order, by score over all frames";
            return Err(BadInput::new(reason));
        }
        let neighbours = !self.poses.is_empty() || self.lost_share > 0.0 || self.max_delay_ms > 0;
        if neighbours && self.method.exchange() == Exchange::Nothing {
            return Err(BadInput::new(format!(
                "--poses, --lost-share and --max-delay-ms are for messages of neighbours: {} uses none",
                self.method
            )));
        }
        if self.alignment_weight > 0.0 && self.method != Method::PASTAT {
            return Err(BadInput::new(format!(
                "--alignment-weight is for a fusion that corrects poses, pastat: {} corrects none",
                self.method
            )));
        }
        Ok(())
    }

    fn config(&self) -> Result<TrainConfig> {
        self.check_effects()?;
        if !(0.0..=1.0).contains(&self.drop_neighbour) || self.validate_every_steps == 0 {
            let reason = "--drop-neighbour is a probability, --validate-every-steps is above zero";
            return Err(BadInput::new(reason).into());
        }
        for folder in self.data.data.iter().chain(&self.validation) {
            std::fs::read_dir(folder)
                .map_err(|error| BadInput::new(format!("{}: {error}", folder.display())))
                .context("datasets")?;
        }
        if let Some(reason) = repeated(&self.data.data).map_err(BadInput::of)? {
            return Err(BadInput::new(reason).into());
        }
        let all = self.data.data.iter().chain(&self.validation);
        if let Some(reason) = repeated(all).map_err(BadInput::of)? {
            output::note(format_args!(
                "--validation: {reason}: its AP is of scenes trained with"
            ));
        }
        let protocol = self.protocol.resolve(Layout::OPV2V);
        let rule = protocol.map_err(BadInput::new)?.ground_truth;
        let samples = SampleConfig {
            augmentation: Augmentation {
                turn_rad: self.turn_deg.to_radians(),
                ..Augmentation::default()
            },
            drop_neighbour: self.drop_neighbour,
            poses: self.poses()?,
            moments: Moments {
                frames: 1,
                gap: self.gap,
                max_delay_nanos: self.max_delay_ms * 1_000_000,
            },
            max_agents: self.protocol.max_agents.unwrap_or(5),
            comm_range_m: rule.comm_range_m,
            classes: rule.classes,
            merged_truth: self.ego_only,
            ..SampleConfig::training(SampleKind::Single)
        };
        let unassigned = match self.ignore_unassigned {
            true => Unassigned::Ignored,
            false => Unassigned::Background,
        };
        let run = self.options.run_config(self.batch, self.lr);
        let mut run = run.map_err(BadInput::of)?;
        run.optimizer.weight_decay = self.weight_decay;
        Ok(TrainConfig {
            data: self.data.data.clone(),
            validation: self.validation.clone(),
            protocol: self.protocol.clone(),
            open: self.data.options(),
            method: self.method,
            detector: self.network.clone(),
            init: self.init.clone(),
            fusion: self.fusion()?,
            frozen_encoder: self.freeze_encoder.then(|| KeptMaps {
                folder: self.feature_maps.clone(),
                dtype: match self.feature_maps_dtype {
                    Exactness::F16 => Dtype::F16,
                    Exactness::I8 => Dtype::I8,
                },
                limit_bytes: (self.feature_maps_limit_gb.max(0.0) * 1e9) as u64,
                intensity_scale: self.data.intensity.scale,
            }),
            box_input: self.box_input,
            run,
            validate_every: self.validate_every_steps,
            validation_frames: self.validation_frames,
            samples,
            loss: LossConfig {
                unassigned,
                alignment_weight: self.alignment_weight,
            },
        })
    }

    /// The poses by which maps are aligned.
    fn poses(&self) -> Result<SamplePoses> {
        let is_noisy = self.noise_position_std_m != 0.0 || self.noise_heading_std_deg != 0.0;
        let noise = is_noisy.then(|| NoisyPoseConfig {
            mode: self.noise_mode,
            position_std_m: self.noise_position_std_m,
            heading_std_deg: self.noise_heading_std_deg,
            ..NoisyPoseConfig::default()
        });
        let files = self.poses.iter();
        let tables = files.map(|file| PoseTable::read(file).map(Arc::new));
        let tables = tables.collect::<Result<_, _>>().map_err(BadInput::of)?;
        let poses = SamplePoses {
            tables,
            noise,
            noise_share: self.noise_share,
            lost_share: self.lost_share,
        };
        poses.validate().map_err(BadInput::of)?;
        Ok(poses)
    }

    /// The fusion, if the command line changes it.
    fn fusion(&self) -> Result<Option<FusionConfig>> {
        if self.without.is_empty() && self.time_steps.is_none() {
            return Ok(None);
        }
        // With --init the sizes of maps are those of its network.
        let detector = match &self.init {
            Some(init) => {
                let config = Weights::load(init).and_then(|weights| weights.config());
                config.map_err(BadInput::of)?
            }
            None => self.network.clone(),
        };
        let whole = self.method.default_fusion(&detector);
        let fusion = ablated(&whole, &self.without, self.time_steps);
        Ok(Some(fusion.map_err(BadInput::of)?))
    }
}

/// Cause of an early end of a training: the input, if the initial model could not be built.
fn blamed(error: Error) -> anyhow::Error {
    match error {
        Error::Model(ModelError::Weights(_) | ModelError::Config(_) | ModelError::Method(_))
        | Error::NotTrained(_)
        | Error::NothingToFreeze
        | Error::NothingToKeep(_) => BadInput::of(error).into(),
        error => error.into(),
    }
}

/// Numeric type of stored maps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Exactness {
    /// 2 bytes a value, packed.
    F16,
    /// 1 byte a value and a scale per channel, packed.
    I8,
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use perception::train::TrainingError;

    use super::*;

    #[test]
    fn weights_that_are_not_there_are_bad_input_and_a_training_that_diverges_is_not() {
        let missing = Weights::load(Path::new("no/such.safetensors")).unwrap_err();
        let blame = blamed(Error::Model(missing.into()));
        assert!(
            blame.is::<BadInput>() && blame.to_string().contains("no/such.safetensors"),
            "{blame}"
        );
        assert!(!blamed(Error::Training(TrainingError::Diverged(9))).is::<BadInput>());
    }

    #[test]
    fn a_network_is_a_preset_or_a_file_with_its_fields() {
        let half = concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../deploy/networks/half.json"
        );
        let network = parse_network(half).unwrap();
        assert_eq!(
            (network.name.as_str(), network.sent_channels()),
            ("half", 32)
        );
        assert_eq!(parse_network("lean"), Ok(DetectorConfig::lean()));
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("wide.json");
        let text = std::fs::read_to_string(half).unwrap();
        for (from, to, problem) in [
            ("\"max_pillars\"", "\"pillars\"", "unknown field `pillars`"),
            ("[16, 32, 64]", "[16, 32]", "num_filters"),
        ] {
            std::fs::write(&file, text.replace(from, to)).unwrap();
            let message = parse_network(file.to_str().unwrap()).unwrap_err();
            assert!(message.contains(problem), "{message}");
        }
        let message = parse_network("wide").unwrap_err();
        assert!(
            message.starts_with("neither lean, full nor a file"),
            "{message}"
        );
    }
}
