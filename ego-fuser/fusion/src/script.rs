//! TorchScript plug-in: a fusion from a file, `script:FILE.pt` as the name of a method.

use std::collections::BTreeMap;
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use perception::model_config::{ConfigError, DetectorConfig};
use perception::tensor_values::tensor;
use serde::{Deserialize, Serialize};
use support::bounded_file;
use support::file_error::AtFile;
use tch::{CModule, Device, TchError, nn};
use zip::ZipArchive;

use crate::planar_pose::planar;
use crate::{
    AlignedMaps, Fusion, FusionConfig, FusionOutput, FusionSettings, FusionSpec, MethodSpec,
};

/// Most bytes that the files of a module may have beyond their compressed size: its source is compressed, its tensors are
/// not.
const MAX_GAINED_BYTES: u64 = 64 << 20;
/// Start of the names of such methods.
pub(crate) const PREFIX: &str = "script:";

/// Their fusion.
pub(crate) const FUSION: FusionSpec = FusionSpec {
    default_config: |spec, _| {
        FusionConfig::new(ScriptConfig {
            file: spec.name.strip_prefix(PREFIX).unwrap_or_default().into(),
        })
    },
    ..FusionSpec::of::<ScriptConfig>()
};

/// The method of a file, `None` if it names none. The same name gives the same specification; it is never freed.
pub(crate) fn spec(name: &str) -> Option<&'static MethodSpec> {
    static SPECS: Mutex<BTreeMap<String, &MethodSpec>> = Mutex::new(BTreeMap::new());
    let stem = Path::new(name.strip_prefix(PREFIX)?).file_stem()?;
    let stem = stem.to_str()?.to_owned();
    let mut specs = SPECS.lock().unwrap_or_else(PoisonError::into_inner);
    Some(specs.entry(name.to_owned()).or_insert_with(|| {
        let name: &'static str = name.to_owned().leak();
        let weights: [&'static str; 3] = [name, stem.leak(), "max"];
        Box::leak(Box::new(MethodSpec {
            name,
            // Its own training, else that of a method of the file's name, else one whose fusion has no parameters.
            runs_with_weights_of: Box::leak(Box::new(weights)),
            fusion: FUSION,
            ..MethodSpec::of_features::<ScriptConfig>("feature maps, fused by a TorchScript module")
        }))
    }))
}

/// Settings of [`ScriptFusion`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ScriptConfig {
    /// TorchScript file.
    pub(crate) file: PathBuf,
}

impl FusionSettings for ScriptConfig {
    const KIND: &'static str = "script";

    /// No file: the name of the method has it.
    fn for_detector(_detector: &DetectorConfig) -> Self {
        Self {
            file: PathBuf::new(),
        }
    }

    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        check_size(&self.file).at(&self.file)?;
        let script = ScriptFusion::load(&self.file, path.device())
            .map_err(|error| format!("not a TorchScript module: {}", first_line(&error)));
        Ok(Box::new(script.at(&self.file)?))
    }
}

/// Refuses what is no regular file, and an archive that unpacks to far more than its own size: libtorch unpacks all of
/// its source. A file that is no archive passes; libtorch says what is wrong with it.
fn check_size(file: &Path) -> io::Result<()> {
    let Ok(mut archive) = ZipArchive::new(BufReader::new(bounded_file::open(file)?)) else {
        return Ok(());
    };
    let mut gained_bytes = 0_u64;
    for index in 0..archive.len() {
        let entry = archive.by_index_raw(index)?;
        gained_bytes += entry.size().saturating_sub(entry.compressed_size());
    }
    if gained_bytes > MAX_GAINED_BYTES {
        let problem = format!(
            "unpacks to {gained_bytes} bytes more than it has, at most {MAX_GAINED_BYTES} are read"
        );
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, problem));
    }
    Ok(())
}

/// A TorchScript module `forward(features, mask, ego_from_cav, confidence, age_s) -> fused`, outside training:
///
/// - `features` `[N, C, H, W]` on the ego's grid, the ego first; `mask` `[N, 1, H, W]`, 1 where an agent has sent a cell;
/// - `ego_from_cav` `[N, 3]`: x and y, metres, and heading, radians; `confidence` `[N]`, 0..1; `age_s` `[N]`, seconds;
/// - `fused` `[C, H, W]`.
///
/// All are float32, on the device of the maps. Its parameters are constant: a training trains the encoder and the head
/// around it.
#[derive(Debug)]
pub(crate) struct ScriptFusion {
    file: PathBuf,
    module: CModule,
}

impl ScriptFusion {
    /// Reads a module.
    ///
    /// # Errors
    /// [`TchError`] when there is no such file, or it is no TorchScript.
    pub(crate) fn load(file: &Path, device: Device) -> Result<Self, TchError> {
        let mut module = CModule::load_on_device(file, device)?;
        // The module is constant: dropout and batch norm are those of inference, in training too.
        module.f_set_eval()?;
        Ok(Self {
            file: file.to_owned(),
            module,
        })
    }
}

impl Fusion for ScriptFusion {
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
        let features = &maps.warped.features;
        let device = features.device();
        let poses: Vec<f32> = maps
            .metadata
            .iter()
            .flat_map(|map| planar(&map.ego_from_cav))
            .collect();
        let poses = tensor(&poses, &[-1, 3], device)?;
        let about: (Vec<f32>, Vec<f32>) = maps
            .metadata
            .iter()
            .map(|map| (map.confidence as f32, map.age_secs as f32))
            .unzip();
        let confidence = tensor(&about.0, &[-1], device)?;
        let age_s = tensor(&about.1, &[-1], device)?;
        let arguments = [features, &maps.warped.mask, &poses, &confidence, &age_s];
        let expected = &features.size()[1..];
        let fused = match self.module.forward_ts(&arguments) {
            Err(error) => Err(first_line(&error)),
            // A map of another shape or kind would fail in the head only, without the name of the file.
            Ok(fused) if fused.size() != expected => Err(format!(
                "forward returns a map of {:?}, not of {expected:?}",
                fused.size()
            )),
            Ok(fused) if fused.is_sparse() => {
                Err("forward returns a sparse map, not a dense one".into())
            }
            Ok(fused) if fused.kind() != features.kind() => Err(format!(
                "forward returns {:?}, not {:?}",
                fused.kind(),
                features.kind()
            )),
            Ok(fused) => Ok(fused.into()),
        };
        fused.map_err(|text| TchError::Torch(format!("{}: {text}", self.file.display())))
    }
}

/// The cause without the stack of the interpreter.
fn first_line(error: &TchError) -> String {
    let text = error.to_string();
    let lines = text
        .lines()
        .map(str::trim)
        .filter(|line| !line.is_empty() && !line.starts_with("Traceback"));
    // TorchScript lists its call stack first; the last line before the tensor library's own stack is the cause.
    let own = lines.take_while(|line| !line.starts_with("Exception raised from"));
    own.last().unwrap_or("no reason given").to_owned()
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use protocol::{BevGrid, Pose};
    use tch::{Kind, Tensor};
    use zip::write::FileOptions;
    use zip::{CompressionMethod, ZipWriter};

    use super::*;
    use crate::Method;
    use crate::maps::MapMetadata;

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    /// The features of each agent weighted by what a module is told of them.
    fn weighted(inputs: &[Tensor]) -> Vec<Tensor> {
        let [features, mask, poses, confidence, age_s] = inputs else {
            panic!("{} inputs", inputs.len())
        };
        let weight =
            confidence + age_s * 10.0 + poses.select(1, 0) * 100.0 + poses.select(1, 2) * 1000.0;
        let weight = weight.view([-1, 1, 1, 1]) * mask;
        vec![(features * weight).sum_dim_intlist([0_i64].as_slice(), false, None)]
    }

    /// Writes [`weighted`] as a module of the shape that PyTorch writes.
    fn write(file: &Path) {
        let mut example = [
            Tensor::rand([2, 3, 4, 5], FLOAT),
            Tensor::ones([2, 1, 4, 5], FLOAT),
            Tensor::zeros([2, 3], FLOAT),
            Tensor::ones([2], FLOAT),
            Tensor::zeros([2], FLOAT),
        ];
        let inputs: Vec<Tensor> = example
            .iter_mut()
            .map(|tensor| tensor.shallow_clone())
            .collect();
        let module =
            CModule::create_by_tracing("Fusion", "forward", &inputs, &mut weighted).unwrap();
        module.save(file).unwrap();
    }

    fn maps(features: &Tensor, mask: &Tensor) -> AlignedMaps {
        let grid = BevGrid {
            x_min_m: 0.0,
            y_min_m: 0.0,
            cell_m: 1.0,
            width: 5,
            height: 4,
        };
        let pose = Pose::from_xyz_yaw([2.0, 0.0, 0.0], 0.5);
        let other = MapMetadata {
            confidence: 0.25,
            age_secs: 0.1,
            ..MapMetadata::fresh(1, pose)
        };
        AlignedMaps::newest(
            features,
            mask,
            &[MapMetadata::fresh(0, Pose::IDENTITY), other],
            &grid,
        )
    }

    fn build_error(file: &Path) -> String {
        let variables = nn::VarStore::new(Device::Cpu);
        let config = ScriptConfig {
            file: file.to_owned(),
        };
        config.build(&variables.root()).unwrap_err().to_string()
    }

    #[test]
    fn a_module_gets_maps_poses_confidence_and_age() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("weighted.pt");
        write(&file);
        let (features, mask) = (
            Tensor::rand([2, 3, 4, 5], FLOAT),
            Tensor::ones([2, 1, 4, 5], FLOAT),
        );
        let _ = mask.get(1).narrow(1, 0, 1).fill_(0.0);
        let fused = ScriptFusion::load(&file, Device::Cpu)
            .unwrap()
            .fuse(&maps(&features, &mask))
            .unwrap()
            .map;
        let expected =
            features.get(0) + features.get(1) * mask.get(1) * (0.25 + 1.0 + 200.0 + 500.0);
        assert!(fused.allclose(&expected, 1e-5, 1e-3, false));
    }

    #[test]
    fn a_file_is_a_method_by_its_name() {
        let method: Method = "script:runs/mine.pt".parse().unwrap();
        assert_eq!(
            (method.name(), method),
            (
                "script:runs/mine.pt",
                "script:runs/mine.pt".parse().unwrap()
            )
        );
        assert_eq!(
            method.weights_names(),
            ["script:runs/mine.pt", "mine", "max"]
        );
        let config = method.default_fusion(&DetectorConfig::lean());
        assert_eq!(
            config.to_json(),
            r#"{"kind":"script","file":"runs/mine.pt"}"#
        );
        assert_eq!(
            serde_json::from_str::<FusionConfig>(&config.to_json()).unwrap(),
            config
        );
        assert!(
            "script:"
                .parse::<Method>()
                .unwrap_err()
                .to_string()
                .contains("script:FILE.pt")
        );
    }

    #[test]
    fn a_module_whose_source_unpacks_to_gigabytes_is_refused_unread() {
        let mut archive = ZipWriter::new(io::Cursor::new(Vec::new()));
        let options = FileOptions::default().compression_method(CompressionMethod::Stored);
        archive.start_file("code/__torch__.py", options).unwrap();
        archive.write_all(b"# a comment").unwrap();
        let mut bytes = archive.finish().unwrap().into_inner();
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mine.pt");
        std::fs::write(&file, &bytes).unwrap();
        check_size(&file).unwrap();
        // The unpacked size in the central directory.
        let entry = bytes
            .windows(4)
            .position(|bytes| bytes == b"PK\x01\x02")
            .unwrap();
        bytes[entry + 24..entry + 28].copy_from_slice(&400_000_000_u32.to_le_bytes());
        std::fs::write(&file, &bytes).unwrap();
        let error = check_size(&file).unwrap_err().to_string();
        assert!(error.contains("unpacks to 399999989 bytes more"), "{error}");
    }

    #[test]
    fn what_is_wrong_with_a_file_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let message = build_error(&folder.path().join("missing.pt"));
        assert!(message.contains("missing.pt"), "{message}");
        let broken = folder.path().join("broken.pt");
        std::fs::write(&broken, b"no archive").unwrap();
        assert!(build_error(Path::new("/dev/zero")).contains("no regular file"));
        let message = build_error(&broken);
        assert!(
            message.contains("broken.pt") && !message.contains('\n'),
            "{message}"
        );
        let file = folder.path().join("weighted.pt");
        write(&file);
        let script = ScriptFusion::load(&file, Device::Cpu).unwrap();
        // The module fails, or returns a map of another shape.
        for (mask, reason) in [
            (&[2, 2, 4, 5][..], "must match"),
            (&[7, 2, 1, 4, 5], "[2, 3, 4, 5], not of [3, 4, 5]"),
        ] {
            let features = Tensor::rand([2, 3, 4, 5], FLOAT);
            let maps = maps(&features, &Tensor::ones(mask, FLOAT));
            let message = script.fuse(&maps).unwrap_err().to_string();
            assert!(
                message.contains("weighted.pt") && message.contains(reason),
                "{message}"
            );
            assert!(!message.contains("Traceback"), "{message}");
        }
    }
}
