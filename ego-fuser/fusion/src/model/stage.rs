//! Fusion stage: orientation-conditioned channel mixing, warp (Eq. 2) and fusion of several vehicles' feature maps.
//! Training and the ego run the same code.

use std::cell::RefCell;

use perception::int8::ScaleSearch;
use perception::layers::head::HeadOutput;
use perception::model_config::{ConfigError, DetectorConfig, YAxis};
use perception::weights::{FileError, METHOD_KEY, Weights};
use protocol::{BevGrid, Pose};
use support::file_error::AtFile;
use tch::nn::{self, VarStore};
use tch::{Device, Tensor};

use crate::box_input::{self, BoxInput, PlacedBox};
use crate::channel_mixing::{self, ChannelMixing};
use crate::classes::Classes;
use crate::f64_tensor::{Order, are_numbers};
use crate::full_resolution::FullResolutionMap;
use crate::maps::{AlignedMaps, EarlierMaps, MapMetadata, ReceivedMaps, larger_cells};
use crate::method::{Exchange, Method};
use crate::settings::{FUSION_KEY, FusionConfig, Requirements};
use crate::warp::{WarpError, WarpedMaps, check, warp_cells, warp_to_ego};
use crate::{Fusion, FusionOutput};

/// Prefix of the fusion's variables in a weights file.
pub(crate) const FUSION_PREFIX: &str = "fusion.";

/// Channel mixing, warp and fusion of one network.
///
/// Everything runs on the device of its maps. Maps on the CPU that need no gradient are read and fused in plain floats in
/// places, which is faster there.
#[derive(Debug)]
pub struct FusionStage {
    config: FusionConfig,
    /// Inputs that the fusion needs beyond the newest map of every agent.
    pub requirements: Requirements,
    fusion: Box<dyn Fusion>,
    mixing: Option<ChannelMixing>,
    /// Reads neighbours' boxes, where the weights have it.
    box_input: Option<BoxInput>,
    /// For a fusion that needs earlier maps at full resolution.
    classes: Option<Classes>,
    grid: BevGrid,
    /// Handedness of the frame of the feature maps.
    y_axis: YAxis,
    /// Search for the scales of activations, while it is under way.
    search: Option<RefCell<ScaleSearch>>,
}

impl FusionStage {
    /// The fusion of `method` with random parameters below `path`: `fusion.*`, where maps are exchanged
    /// `steering.weight` and, where earlier maps are needed at full resolution, the detector's `cls_head.*` unless that
    /// has made them.
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no fusion can be built from.
    pub fn new(
        path: &nn::Path<'_>,
        config: &FusionConfig,
        method: Method,
        detector: &DetectorConfig,
    ) -> Result<Self, ConfigError> {
        let shares_maps = method.exchange() == Exchange::Features;
        let mixing = shares_maps.then(|| ChannelMixing::new(path, detector.feature_channels()));
        let fusion = config.build(&(path / "fusion"))?;
        let anchors = detector.anchors.yaws_deg.len() as i64;
        let sizes = [detector.feature_channels(), anchors];
        let requirements = config.requirements();
        let needs_classes = requirements.history.full_resolution;
        Ok(Self {
            config: config.clone(),
            requirements,
            fusion,
            mixing,
            box_input: None,
            classes: needs_classes.then(|| Classes::under(path, sizes)),
            grid: detector.feature_grid(),
            y_axis: detector.y_axis,
            search: None,
        })
    }

    /// The fusion of a weights file, or the one of `method` where it differs and has no parameters; it takes maps on
    /// `device`.
    ///
    /// # Errors
    /// [`FileError`] names the file and the first parameter that is missing or of another shape, and the method of the
    /// file if it is another one.
    pub fn from_weights(
        weights: &Weights,
        method: Method,
        detector: &DetectorConfig,
        device: Device,
    ) -> Result<Self, FileError> {
        let variables = VarStore::new(device);
        let config = stored_config(weights, method, detector)?;
        let stage = Self::new(&variables.root(), &config, method, detector);
        let mut stage = stage.at(weights.path())?;
        if box_input::is_in(weights) {
            stage.add_box_input(&variables.root(), detector);
        }
        weights
            .copy_some_into(&variables, |name: &str| {
                name != channel_mixing::WEIGHT || weights.contains(name)
            })
            .map_err(|error| of_method(error, weights, method))?;
        if !weights.contains(channel_mixing::WEIGHT) {
            stage.mixing = None;
        }
        // On the CPU only: the operators in integers are those of oneDNN.
        if let Some(scales) = weights.activation_scales()?
            && device == Device::Cpu
        {
            tch::no_grad(|| stage.fusion.quantise(&scales))
                .map_err(|error| weights.quantise_error(error))?;
        }
        Ok(stage)
    }

    /// The fusion of `method` behind a network without fusion weights, for maps on `device`: its parameters are random,
    /// channels are not mixed.
    ///
    /// # Errors
    /// [`ConfigError`] names the field that no fusion can be built from.
    pub fn untrained(
        method: Method,
        detector: &DetectorConfig,
        device: Device,
    ) -> Result<Self, ConfigError> {
        let variables = VarStore::new(device);
        let config = method.default_fusion(detector);
        Ok(Self {
            mixing: None,
            ..Self::new(&variables.root(), &config, method, detector)?
        })
    }

    /// Reads boxes beside maps from here on; the variables are below `path`.
    pub(crate) fn add_box_input(&mut self, path: &nn::Path<'_>, detector: &DetectorConfig) {
        self.box_input = Some(BoxInput::new(path, detector));
    }

    /// True if it reads boxes of neighbours without a map.
    pub fn reads_boxes(&self) -> bool {
        self.box_input.is_some()
    }

    /// The output of the head for one fused map `[1, C, H, W]` with what `boxes` say. Without boxes, or a box input, it is
    /// the same.
    ///
    /// # Errors
    /// [`tch::TchError`] when map and output are of another shape.
    pub fn with_boxes(
        &self,
        fused: &Tensor,
        head: HeadOutput,
        boxes: &[PlacedBox],
    ) -> tch::Result<HeadOutput> {
        match (&self.box_input, self.y_axis) {
            (None, _) => Ok(head),
            (Some(input), YAxis::Left) => input.change(fused, head, boxes),
            (Some(input), YAxis::Right) => {
                // The maps of such a network are mirrored, so boxes have to be mirrored to lie on them.
                let mirrored = boxes.iter().map(|placed| PlacedBox {
                    box3d: placed.box3d.mirrored_y(),
                    ..*placed
                });
                input.change(fused, head, &mirrored.collect::<Vec<_>>())
            }
        }
    }

    /// Settings that the fusion was built from.
    pub fn config(&self) -> &FusionConfig {
        &self.config
    }

    /// Warps maps onto the ego's grid: `received` are `N`, each in the axes of its sender, as are `metadata`: the ego's
    /// newest first, then the newest of all others, then earlier ones.
    ///
    /// # Errors
    /// [`WarpError`] when the maps do not lie on the grid or metadata are missing.
    pub fn align(
        &self,
        received: &ReceivedMaps,
        metadata: &[MapMetadata],
    ) -> Result<AlignedMaps, WarpError> {
        let (count, newest) = (received.maps.size4()?.0, newest(metadata) as i64);
        if count == newest {
            return self.align_with(received, None, metadata);
        }
        let earlier = received.only(newest, count)?;
        // As live, where a map at full resolution is kept in the axes that the ego had when the map was new.
        let then = then_from_cav(&self.of_network(metadata), newest as usize);
        let turned = earlier.with_maps(self.turned(&earlier.maps, &then)?);
        let earlier = self.kept(&earlier, &turned)?;
        let newest = received.only(0, newest.min(count))?;
        self.align_with(&newest, Some(earlier), metadata)
    }

    /// The form in which maps are kept for later frames, given the same maps in the axes of the ego, `turned`.
    ///
    /// # Errors
    /// [`tch::TchError`] when the maps have not four dimensions.
    pub fn kept(
        &self,
        received: &ReceivedMaps,
        turned: &ReceivedMaps,
    ) -> tch::Result<ReceivedMaps> {
        let ReceivedMaps { maps, sent, .. } = received;
        let history = self.requirements.history;
        let kept = match history.earlier_cells {
            Some(cells) => ReceivedMaps::new(
                larger_cells(maps, cells)?,
                // A pooled cell was sent where any of its cells was.
                sent.as_ref()
                    .map(|sent| larger_cells(sent, cells)?.f_ceil())
                    .transpose()?,
            ),
            None => received.with_maps(maps.shallow_clone()),
        };
        let full_resolution = match history.full_resolution {
            true if turned.full_resolution.is_empty() => full_resolution(turned)?,
            true => FullResolutionMap::shallow_clones(&turned.full_resolution),
            false => Vec::new(),
        };
        Ok(ReceivedMaps {
            full_resolution,
            ..kept
        })
    }

    /// Maps in the axes of the ego.
    fn turned(&self, maps: &Tensor, poses: &[Pose]) -> tch::Result<Tensor> {
        match &self.mixing {
            Some(mixing) => mixing.turn(maps, poses, self.order()),
            None => Ok(maps.shallow_clone()),
        }
    }

    /// Memory order in which the fusion reads its maps: one with pooled earlier maps takes the maximum over the newest
    /// cell by cell.
    fn order(&self) -> Order {
        match self.requirements.history.earlier_cells {
            Some(_) => Order::Cells,
            None => Order::Planes,
        }
    }

    /// [`Self::align`] with earlier maps in the form of [`Self::kept`].
    ///
    /// # Errors
    /// [`WarpError`] when the maps do not lie on the grid or metadata are missing.
    pub fn align_with(
        &self,
        newest: &ReceivedMaps,
        earlier: Option<ReceivedMaps>,
        metadata: &[MapMetadata],
    ) -> Result<AlignedMaps, WarpError> {
        let mut metadata = self.of_network(metadata);
        let count = newest.maps.size4()?.0;
        let (mut maps, poses) = (count, metadata.len());
        if let Some(earlier) = &earlier {
            maps += earlier.maps.size4()?.0;
        }
        if maps != poses as i64 {
            return Err(WarpError::PoseCount { maps, poses });
        }
        let Some(earlier) = earlier else {
            return self.aligned(newest, None, metadata);
        };
        let Some(cells) = self.requirements.history.earlier_cells else {
            let together = ReceivedMaps::together(&[newest, &earlier])?;
            return self.aligned(&together, None, metadata);
        };
        let of_earlier = metadata.split_off(count as usize);
        let grid = self.grid.downsampled(cells as u32);
        let (_, warped) = self.warped(&earlier, &of_earlier, &grid)?;
        let classes = self.classes.as_ref().map(Classes::shallow_clone);
        let earlier = EarlierMaps {
            warped,
            metadata: of_earlier,
            full_resolution: classes.map(|classes| (earlier.full_resolution, classes)),
        };
        self.aligned(newest, Some(earlier), metadata)
    }

    fn aligned(
        &self,
        received: &ReceivedMaps,
        earlier: Option<EarlierMaps>,
        metadata: Vec<MapMetadata>,
    ) -> Result<AlignedMaps, WarpError> {
        let (received, warped) = self.warped(received, &metadata, &self.grid)?;
        Ok(AlignedMaps {
            warped,
            received,
            metadata,
            grid: self.grid,
            earlier,
            is_training: false,
        })
    }

    /// Maps in the axes of the ego, and the same warped onto the ego's `grid`.
    fn warped(
        &self,
        received: &ReceivedMaps,
        metadata: &[MapMetadata],
        grid: &BevGrid,
    ) -> Result<(ReceivedMaps, WarpedMaps), WarpError> {
        let poses: Vec<Pose> = metadata.iter().map(|map| map.ego_from_cav).collect();
        check(&received.maps, &poses, grid)?;
        let mut turned = received.with_maps(self.turned(&received.maps, &poses)?);
        if self.order() == Order::Planes || !are_numbers(&turned.maps) {
            let warped = warp_to_ego(&turned.maps, turned.sent.as_ref(), &poses, grid)?;
            return Ok((turned, warped));
        }
        turned.full_resolution = full_resolution(&turned)?;
        let sent = turned.full_resolution.iter();
        let sent: Vec<&[f32]> = sent.filter_map(FullResolutionMap::sent).collect();
        let warped = warp_cells(&turned.maps, &sent, &poses, grid)?;
        Ok((turned, warped))
    }

    /// Fuses aligned maps into one in the frame of the ego.
    ///
    /// # Errors
    /// [`WarpError::Torch`] when the tensor library reports an error.
    pub fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, WarpError> {
        if let Some(search) = &self.search {
            self.fusion.observe(maps, &mut search.borrow_mut())?;
        }
        Ok(self.fusion.fuse(maps)?)
    }

    /// Searches the scales of activations in all that is fused from here on.
    pub fn start_scale_search(&mut self) {
        self.search = Some(RefCell::default());
    }

    /// Ends the search; `None` if none was started.
    pub fn take_scale_search(&mut self) -> Option<ScaleSearch> {
        self.search.take().map(RefCell::into_inner)
    }

    /// Metadata in the frame of the network: a mirrored network has mirrored poses.
    fn of_network(&self, metadata: &[MapMetadata]) -> Vec<MapMetadata> {
        let mut metadata = metadata.to_vec();
        // y to the left is the convention of all poses: nothing to mirror.
        if self.y_axis == YAxis::Right {
            for map in &mut metadata {
                map.ego_from_cav = map.ego_from_cav.mirrored_y();
            }
        }
        metadata
    }
}

/// Each of the maps at full resolution.
fn full_resolution(
    ReceivedMaps { maps, sent, .. }: &ReceivedMaps,
) -> tch::Result<Vec<FullResolutionMap>> {
    (0..maps.size4()?.0)
        .map(|map| {
            let sent = sent.as_ref().map(|sent| sent.f_narrow(0, map, 1));
            FullResolutionMap::of(&maps.f_narrow(0, map, 1)?, sent.transpose()?.as_ref())
        })
        .collect()
}

/// Number of leading entries that are the newest of their agents.
fn newest(facts: &[MapMetadata]) -> usize {
    (0..facts.len())
        .take_while(|&entry| step_of(entry, facts) == 0)
        .count()
}

/// Poses of the entries from `newest` on in the frame that the ego had when they were the newest of their agents. The
/// ego's own entry of the same time step gives that frame; without one the ego counts as stationary.
fn then_from_cav(facts: &[MapMetadata], newest: usize) -> Vec<Pose> {
    (newest..facts.len())
        .map(|entry| {
            if facts[entry].agent == 0 {
                return Pose::IDENTITY;
            }
            let step = step_of(entry, facts);
            let ego = (0..facts.len())
                .find(|&ego| facts[ego].agent == 0 && step_of(ego, facts) == step)
                .map_or(Pose::IDENTITY, |ego| facts[ego].ego_from_cav);
            // then_from_cav = now_from_then^-1 now_from_cav: the current frame is the common world.
            ego.from_world(&facts[entry].ego_from_cav)
        })
        .collect()
}

/// Index of the time step of an entry: how many newer maps of the same agent are listed before it.
fn step_of(entry: usize, facts: &[MapMetadata]) -> usize {
    let before = facts[..entry].iter();
    before.filter(|map| map.agent == facts[entry].agent).count()
}

/// Names the method of the weights beside an error, if it is another one.
fn of_method(error: FileError, weights: &Weights, method: Method) -> FileError {
    match weights.metadata(METHOD_KEY) {
        Some(trained) if trained != method.name() => {
            let problem = &error.problem;
            let problem =
                format!("{problem}; the file was trained for method {trained}, not {method}");
            FileError { problem, ..error }
        }
        _ => error,
    }
}

/// The configuration that a weights file names, as long as it belongs to `method`.
pub(crate) fn stored_config(
    weights: &Weights,
    method: Method,
    detector: &DetectorConfig,
) -> Result<FusionConfig, FileError> {
    if weights.metadata(FUSION_KEY).is_some() {
        let stored: FusionConfig = weights.metadata_json(FUSION_KEY)?;
        if method.has_fusion(&stored) {
            return Ok(stored);
        }
    }
    Ok(method.default_fusion(detector))
}

#[cfg(test)]
mod tests {
    use perception::weights::{Precision, save};
    use tch::Kind;

    use super::*;
    use crate::disconet::DiscoNetConfig;

    fn fused(detector: &DetectorConfig, maps: &Tensor, facts: &[MapMetadata]) -> Tensor {
        let stage = FusionStage::untrained(Method::ATTENTION, detector, Device::Cpu).unwrap();
        let received = ReceivedMaps::new(maps.shallow_clone(), None);
        let aligned = stage.align(&received, facts).unwrap();
        stage.fuse(&aligned).unwrap().map
    }

    fn turned_map(agent: usize, yaw_rad: f64) -> MapMetadata {
        MapMetadata::fresh(agent, Pose::from_xyz_yaw([1.0, 2.0, 0.0], yaw_rad))
    }

    /// A mirrored network gets mirrored maps and returns a mirrored one.
    #[test]
    fn a_mirrored_world_is_fused_like_this_one() {
        tch::set_num_threads(1);
        let plain = DetectorConfig::lean();
        let mirrored = DetectorConfig {
            y_axis: YAxis::Right,
            ..DetectorConfig::lean()
        };
        let grid = plain.feature_grid();
        let size = [
            3,
            plain.feature_channels(),
            i64::from(grid.height),
            i64::from(grid.width),
        ];
        let maps = Tensor::rand(size, (Kind::Float, Device::Cpu));
        let poses = [
            Pose::IDENTITY,
            Pose::from_xyz_yaw([8.0, 3.0, 0.0], 0.4),
            Pose::from_xyz_yaw([-5.0, 9.0, 0.0], -2.0),
        ];
        let facts: Vec<MapMetadata> = (0..3)
            .map(|agent| MapMetadata::fresh(agent, poses[agent]))
            .collect();
        let here = fused(&plain, &maps, &facts);
        let there = fused(&mirrored, &maps.flip([2]), &facts).flip([1]);
        assert!(here.allclose(&there, 1e-3, 1e-3, false));
    }

    #[test]
    fn settings_of_no_fusion_are_named_with_their_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("weights.safetensors");
        let settings = FusionConfig::new(DiscoNetConfig::full(0));
        let about = [(FUSION_KEY.to_owned(), settings.to_json())].into();
        let nothing = VarStore::new(Device::Cpu);
        save(&path, &nothing, &about, Precision::Single).unwrap();
        let (weights, lean) = (Weights::load(&path).unwrap(), DetectorConfig::lean());
        let stage = FusionStage::from_weights(&weights, Method::DISCONET, &lean, Device::Cpu);
        let message = stage.unwrap_err().to_string();
        for part in ["weights.safetensors: ", "fusion channels is 0"] {
            assert!(message.contains(part), "{message}");
        }
    }

    #[test]
    fn weights_of_another_method_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("weights.safetensors");
        let detector = DetectorConfig::lean();
        let variables = VarStore::new(Device::Cpu);
        let attention = Method::ATTENTION;
        FusionStage::new(
            &variables.root(),
            &attention.default_fusion(&detector),
            attention,
            &detector,
        )
        .unwrap();
        let about = [(METHOD_KEY.to_owned(), attention.name().to_owned())].into();
        save(&path, &variables, &about, Precision::Single).unwrap();
        let weights = Weights::load(&path).unwrap();
        let error = FusionStage::from_weights(&weights, Method::COBEVT, &detector, Device::Cpu)
            .unwrap_err();
        let message = error.to_string();
        assert!(
            message.starts_with(&path.display().to_string()),
            "{message}"
        );
        assert!(
            message.ends_with("; the file was trained for method attention, not cobevt"),
            "{message}"
        );
    }

    #[test]
    fn earlier_maps_are_turned_as_when_they_were_the_newest() {
        // The ego has turned by 0.1 since; it has no map of a third time step.
        let facts = [
            MapMetadata::fresh(0, Pose::IDENTITY),
            turned_map(1, 0.7),
            turned_map(0, -0.1),
            turned_map(1, 0.5),
            turned_map(1, 0.4),
        ];
        let yaws: Vec<f64> = then_from_cav(&facts, 2).iter().map(Pose::yaw_rad).collect();
        assert!(
            yaws.iter()
                .zip([0.0, 0.6, 0.4])
                .all(|(found, expected)| (found - expected).abs() < 1e-9),
            "{yaws:?}"
        );
        assert_eq!(then_from_cav(&facts, 2)[0], Pose::IDENTITY);
    }
}
