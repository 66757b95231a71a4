//! Sweeps and poses of a bag: the stamps of its clouds, and its transforms, as the scan finds them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::Isometry3;
use protocol::text::excerpt;
use ros2::{PoseType, RosType, Transform, read_header};

use super::scan::{BagMessage, BagTopic, MessagePlace, Scan};
use super::transforms::is_map;
use crate::faults::Faults;
use crate::{ReadError, poses};

/// Last part of the topic of fixed transforms.
const FIXED_TRANSFORMS: &str = "tf_static";
/// Largest number of topics that an error lists.
const LISTED: usize = 12;

/// A cloud: its stamp, frame and position.
#[derive(Debug, Clone)]
pub(super) struct CloudStamp {
    pub(super) recorded_nanos: u64,
    /// Stamp of its header.
    pub(super) nanos: u64,
    pub(super) frame: String,
    pub(super) bytes: usize,
    pub(super) place: MessagePlace,
}

/// A pose of one frame in another.
#[derive(Debug, Clone)]
pub(super) struct PoseStamp {
    pub(super) recorded_nanos: u64,
    /// Stamp of its header.
    pub(super) nanos: u64,
    pub(super) parent: String,
    /// `None` where the message names none.
    pub(super) child: Option<String>,
    pub(super) parent_from_child: Isometry3<f64>,
}

/// Everything that sweeps and poses are made of.
#[derive(Debug, Default)]
pub(super) struct BagContents {
    path: PathBuf,
    topics: Vec<BagTopic>,
    /// By topic, in the order in which they were recorded.
    pub(super) clouds: BTreeMap<String, Vec<CloudStamp>>,
    /// Odometry and poses, by topic, likewise.
    pub(super) poses: BTreeMap<String, Vec<PoseStamp>>,
    /// Moving transforms.
    pub(super) moving: Vec<PoseStamp>,
    /// Fixed transforms.
    pub(super) fixed: Vec<PoseStamp>,
    /// Messages that cannot be read, by topic.
    faults: BTreeMap<String, Faults>,
}

/// True for topics of clouds and of poses.
fn is_used(topic: &BagTopic) -> bool {
    let name = &topic.type_name;
    *name == RosType::PointCloud2.name() || name.parse::<PoseType>().is_ok()
}

impl BagContents {
    /// Contents of the bag at `path`, before the scan.
    pub(super) fn of(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            ..Self::default()
        }
    }

    /// Orders everything by the time of recording, and reports messages that could not be read.
    pub(super) fn finish(&mut self, problems: &mut Vec<ReadError>) {
        // Several topics feed one list, and SQLite is scanned topic by topic.
        let poses = self.poses.values_mut();
        for poses in poses.chain([&mut self.moving, &mut self.fixed]) {
            poses.sort_by_key(|pose| pose.recorded_nanos);
        }
        let clouds = self.clouds.values_mut();
        clouds.for_each(|clouds| clouds.sort_by_key(|cloud| cloud.recorded_nanos));
        for faults in std::mem::take(&mut self.faults).into_values() {
            faults.report("message", problems);
        }
    }

    /// The topics with their types, for messages.
    pub(super) fn listing(&self) -> String {
        let shown = self.topics.iter().take(LISTED);
        let mut names: Vec<String> = shown
            .map(|topic| {
                let [name, kind] = [&topic.name, &topic.type_name].map(|text| excerpt(text, 60));
                format!("{name} ({kind})")
            })
            .collect();
        let more = self.topics.len().saturating_sub(LISTED);
        if more > 0 {
            names.push(format!("and {more} more"));
        }
        match names.is_empty() {
            true => "nothing".into(),
            false => names.join(", "),
        }
    }

    /// True for the frame of a map or of odometry, in which clouds are no sweeps of a LiDAR.
    pub(super) fn is_world(&self, frame: &str) -> bool {
        let mut poses = self.poses.values().flatten();
        is_map(frame) || frame.contains("odom") || poses.any(|pose| pose.parent == frame)
    }

    fn fault(&mut self, topic: &str, reason: String) {
        let fault = ReadError::malformed(&self.path, format!("{topic}: {reason}"));
        self.faults.entry(topic.to_owned()).or_default().push(fault);
    }

    /// Takes the poses or the cloud of a message.
    fn read(&mut self, message: BagMessage<'_>) -> Result<(), String> {
        let (topic, recorded_nanos) = (&message.topic.name, message.recorded_nanos);
        let data = message.data?;
        if let Ok(pose_type) = message.topic.type_name.parse::<PoseType>() {
            let is_tf = pose_type == PoseType::TfMessage;
            for transform in pose_type.read(&data).map_err(|error| error.to_string())? {
                self.take_transform(topic, recorded_nanos, transform, is_tf);
            }
            return Ok(());
        }
        // A topic that is used and has no poses has clouds.
        let (nanos, frame) = read_header(&data).map_err(|error| error.to_string())?;
        let cloud = CloudStamp {
            recorded_nanos,
            nanos,
            frame,
            bytes: data.len(),
            place: message.place,
        };
        self.clouds.entry(topic.clone()).or_default().push(cloud);
        Ok(())
    }

    fn take_transform(&mut self, topic: &str, recorded_nanos: u64, read: Transform, is_tf: bool) {
        let parent_from_child = match poses::of_rounded(&read.parent_from_child) {
            Ok(pose) => pose,
            Err(reason) => {
                let child = read.child.as_deref().unwrap_or("the pose");
                return self.fault(topic, format!("{child} in {}: {reason}", read.parent));
            }
        };
        let pose = PoseStamp {
            recorded_nanos,
            nanos: read.nanos,
            parent: read.parent,
            child: read.child,
            parent_from_child,
        };
        if !is_tf {
            self.poses.entry(topic.to_owned()).or_default().push(pose);
        } else if topic.rsplit('/').next() == Some(FIXED_TRANSFORMS) {
            // Told by the last part of the topic: a robot may have a namespace, `/robot/tf_static`.
            self.fixed.push(pose);
        } else {
            self.moving.push(pose);
        }
    }
}

impl Scan for BagContents {
    fn declare(&mut self, topic: &BagTopic) -> bool {
        // MCAP declares a topic with each message: its fault is reported once.
        if !self.topics.contains(topic) {
            self.topics.push(topic.clone());
            if is_used(topic) && !topic.is_cdr() {
                let reason = format!("encoding {:?}, expected cdr", excerpt(&topic.encoding, 40));
                self.fault(&topic.name, reason);
            }
        }
        topic.is_cdr() && is_used(topic)
    }

    fn take(&mut self, message: BagMessage<'_>) {
        let topic = message.topic;
        if let Err(reason) = self.read(message) {
            self.fault(&topic.name, reason);
        }
    }

    fn forget(&mut self, file: usize) {
        self.clouds.retain(|_, clouds| {
            clouds.retain(|cloud| cloud.place.file != file);
            !clouds.is_empty()
        });
    }
}
