//! Newest image of every camera of a live run, kept while a page asks for them.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use protocol::{Camera, CavId, ImageFormat, Limits, Stream, Topic, wire};

/// Time after the last request until which images are received.
const WANTED: Duration = Duration::from_secs(3);
/// Largest number of images that are kept: 16 vehicles of four cameras.
const MOST_IMAGES: usize = 64;

/// Newest images by vehicle and camera.
#[derive(Debug, Default)]
pub(super) struct NewestImages {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    asked: Option<Instant>,
    images: BTreeMap<(CavId, u8), (ImageFormat, Bytes)>,
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
        }
        are_wanted
    }

    /// Keeps the image of a message.
    pub(super) fn keep(&self, topic: &Topic, payload: &[u8]) {
        let Topic::Stream { cav, stream: Stream::Camera(number) } = topic else { return };
        let Ok((_, Camera { metadata, image })) = wire::decode::<Camera>([payload], &Limits::DEFAULT) else { return };
        let mut state = self.lock();
        let key = (cav.clone(), *number);
        if state.images.len() < MOST_IMAGES || state.images.contains_key(&key) {
            state.images.insert(key, (metadata.format, image.into()));
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
