//! Newest image of every camera of a live run, kept while a page asks for them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use protocol::{Camera, CavId, ImageFormat, Limits, Stream, Topic, wire};

/// Time after the last request until which images are received.
const WANTED: Duration = Duration::from_secs(3);
/// Largest number of images that are kept: 16 vehicles of four cameras.
const MOST_IMAGES: usize = 64;
/// Largest number of further cameras that are counted.
const MOST_LEFT_OUT: usize = 1024;

/// Newest images by vehicle and camera.
#[derive(Debug, Default)]
pub(super) struct NewestImages {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    asked: Option<Instant>,
    images: BTreeMap<(CavId, u8), (ImageFormat, Bytes)>,
    left_out: BTreeSet<(CavId, u8)>,
}

impl NewestImages {
    /// The newest image of a camera; from now on images are wanted.
    pub(super) fn get(&self, cav: &CavId, number: u8) -> Option<(ImageFormat, Bytes)> {
        let mut state = self.lock();
        state.asked = Some(Instant::now());
        state.images.get(&(cav.clone(), number)).cloned()
    }

    /// True while pages ask for images; afterwards those that are kept are forgotten.
    pub(super) fn are_wanted(&self) -> bool {
        let mut state = self.lock();
        let are_wanted = state.asked.is_some_and(|asked| asked.elapsed() < WANTED);
        if !are_wanted {
            state.images.clear();
            state.left_out.clear();
        }
        are_wanted
    }

    /// Number of cameras whose images are not kept, beyond the largest number.
    pub(super) fn left_out(&self) -> usize {
        self.lock().left_out.len()
    }

    /// Keeps the image of a message.
    pub(super) fn keep(&self, topic: &Topic, payload: &[u8]) {
        let Topic::Stream { cav, stream: Stream::Camera(number) } = topic else { return };
        let Ok((_, Camera { metadata, image })) = wire::decode::<Camera>([payload], &Limits::DEFAULT) else { return };
        let mut state = self.lock();
        let key = (cav.clone(), *number);
        if state.images.len() < MOST_IMAGES || state.images.contains_key(&key) {
            state.images.insert(key, (metadata.format, image.into()));
        } else if state.left_out.len() < MOST_LEFT_OUT {
            state.left_out.insert(key);
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use protocol::{CameraMetadata, Stamp};

    use super::*;

    #[test]
    fn cameras_beyond_the_most_are_counted_once_each() {
        let images = NewestImages::default();
        let metadata = CameraMetadata {
            format: ImageFormat::Png,
            width_px: 1,
            height_px: 1,
            pinhole: None,
            lidar_from_camera: None,
        };
        for round in 0..2 {
            for vehicle in 0..17 {
                let cav = CavId::new(&vehicle.to_string()).unwrap();
                let stamp =
                    Stamp { cav: cav.clone(), epoch: 1, sequence: round, capture_nanos: round, publish_nanos: round };
                for number in 0..4 {
                    let camera = Camera { metadata, image: vec![0] };
                    let topic = Topic::Stream { cav: cav.clone(), stream: Stream::Camera(number) };
                    images.keep(&topic, &wire::encode(&stamp, camera).unwrap().to_vec());
                }
            }
        }
        assert_eq!(images.left_out(), 4);
        assert!(images.get(&CavId::new("16").unwrap(), 0).is_none());
        assert!(images.are_wanted() && images.get(&CavId::new("15").unwrap(), 3).is_some());
    }
}
