//! Pose of one cloud: localization in the map of a released head, with the confidence of the pose.
//!
//! `locate_cloud CLOUD [HEAD]`; the head is a file or the name of a released one (`town1`).

use std::path::{Path, PathBuf};

use dataset::cloud_files::clouds_at;
use localization::pgc::LocalizerInput;
use localization::pgc::head_files::{encoder_or_named, head_file};
use localization::place_localizer::place_localizer;
use perception::inference::Inference;
use protocol::PoseEstimate;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let cloud = arguments.next().ok_or("which cloud?")?;
    let head = head_file(&arguments.next().unwrap_or("town1".into()))?;
    // The head names the encoder with which it was trained. Poses are not registered to a surfel map.
    let files = [&encoder_or_named(None, &head)?, &head, Path::new("")];
    let mut localizer = place_localizer(files, 0.0, Inference::default(), |_| ())?;
    for file in clouds_at(&[cloud]) {
        let file = file?;
        let points = file.read()?.points;
        let localization = localizer.localize(LocalizerInput::of(&points))?;
        match localization.estimate {
            PoseEstimate::Pose {
                world_from_cav,
                confidence,
                ..
            } => {
                let [x, y, z] = world_from_cav.translation_m;
                println!(
                    "{}: x {x:.2} y {y:.2} z {z:.2} m, confidence {confidence:.3}",
                    file.path.display()
                );
            }
            PoseEstimate::NoPose { reason, .. } => {
                println!("{}: no pose, {reason:?}", file.path.display());
            }
        }
    }
    Ok(())
}
