//! Frame lines: `detections.jsonl`, `tracks.jsonl` and `truth.jsonl` of frames that are evaluated offline or in simulation
//! time.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use deploy::score::{ScenarioLine, TRACKS, TruthLine};
use ego_fuser_offline::evaluation::EvaluatedFrame;
use protocol::FrameReport;
use serde::Serialize;

/// The files; the first error of writing is kept.
pub(crate) struct FrameLines {
    /// Their folder.
    pub(crate) folder: PathBuf,
    detections: BufWriter<File>,
    truth: BufWriter<File>,
    /// Created with the first tracks.
    tracks: Option<BufWriter<File>>,
    written: io::Result<()>,
}

impl FrameLines {
    /// Empty files in a folder.
    ///
    /// # Errors
    /// Those of the operating system.
    pub(crate) fn create(folder: &Path) -> io::Result<Self> {
        Ok(Self {
            folder: folder.to_owned(),
            detections: create(folder, "detections.jsonl")?,
            truth: create(folder, "truth.jsonl")?,
            tracks: None,
            written: Ok(()),
        })
    }

    /// Adds a frame, with the name of its scenario where there are several; a break after an error, which
    /// [`Self::finish`] returns.
    pub(crate) fn add(
        &mut self,
        scenario: Option<&str>,
        frame: &EvaluatedFrame,
    ) -> ControlFlow<()> {
        if self.written.is_ok() {
            self.written = self.write(scenario, frame);
        }
        match self.written {
            Ok(()) => ControlFlow::Continue(()),
            Err(_) => ControlFlow::Break(()),
        }
    }

    fn write(&mut self, scenario: Option<&str>, frame: &EvaluatedFrame) -> io::Result<()> {
        let tick = Some(frame.tick as u64);
        // A frame that failed has no result, but its truth is written all the same.
        if frame.failure.is_none() {
            let line = FrameReport::new(&frame.stamp, tick, &frame.result);
            write_line(&mut self.detections, &ScenarioLine { scenario, line })?;
        }
        // An ego that does not track leaves no file: readers tell the two apart by that.
        if let Some(tracks) = &frame.tracks {
            let out = match &mut self.tracks {
                Some(out) => out,
                absent => absent.insert(create(&self.folder, TRACKS)?),
            };
            let line = FrameReport::new(&frame.stamp, tick, tracks);
            write_line(out, &ScenarioLine { scenario, line })?;
        }
        // The vehicle has driven on, but nothing tells where the true boxes are.
        let Some(world_from_ego) = frame.true_pose() else {
            return Ok(());
        };
        let line = TruthLine {
            tick: frame.tick as u64,
            capture_nanos: frame.stamp.capture_nanos,
            publish_nanos: frame.stamp.capture_nanos,
            ego: frame.result.ego.clone(),
            world_from_ego: Some(world_from_ego),
            truth: frame.truth.clone(),
        };
        write_line(&mut self.truth, &ScenarioLine { scenario, line })
    }

    /// Writes what is left.
    ///
    /// # Errors
    /// The first of the operating system.
    pub(crate) fn finish(self) -> io::Result<()> {
        self.written?;
        for mut file in [self.detections, self.truth].into_iter().chain(self.tracks) {
            file.flush()?;
            file.get_ref().sync_all()?;
        }
        Ok(())
    }
}

fn create(folder: &Path, name: &str) -> io::Result<BufWriter<File>> {
    File::create(folder.join(name)).map(BufWriter::new)
}

fn write_line(out: &mut impl Write, value: &impl Serialize) -> io::Result<()> {
    serde_json::to_writer(&mut *out, value)?;
    out.write_all(b"\n")
}
