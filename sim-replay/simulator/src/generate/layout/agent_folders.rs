//! Layouts of the OPV2V family: a folder per agent, several files per frame.

use std::fmt;
use std::path::{Path, PathBuf};

use super::disk::{Unfinished, make_folder, make_fresh_folder, scene_path, write_file};
use super::yaml_text::agent_folders;
use super::{AgentFrame, Moment, Omissions, SceneHeader, SceneWriter};
use crate::generate::error::SynthError;

/// Writes the files of one frame of one agent.
type WriteFrame = fn(&TickFiles<'_>, &AgentFrame) -> Result<(), SynthError>;

/// The files of one frame, which differ in what follows the number of the tick.
pub(super) struct TickFiles<'a> {
    folder: &'a Path,
    tick: u64,
    pub(super) is_roadside: bool,
}

impl TickFiles<'_> {
    pub(super) fn write(&self, suffix: &str, bytes: impl AsRef<[u8]>) -> Result<(), SynthError> {
        let name = format!("{:06}{suffix}", self.tick);
        write_file(&self.folder.join(name), bytes)
    }

    /// Writes the YAML of a frame.
    pub(super) fn write_yaml(
        &self,
        frame: &AgentFrame,
        write: impl FnOnce(&mut String) -> fmt::Result,
    ) -> Result<(), SynthError> {
        let mut yaml = String::with_capacity(2048 + 400 * frame.frame.objects.len());
        write(&mut yaml).expect("writing to a String cannot fail");
        self.write(".yaml", yaml)
    }
}

/// The writer of these layouts, which differ in the files of a frame.
#[derive(Debug)]
pub(super) struct AgentFolderWriter {
    root: PathBuf,
    scene: SceneHeader,
    /// Folder of each agent of the scene.
    folders: Vec<PathBuf>,
    mark: Option<Unfinished>,
    write_frame: WriteFrame,
}

impl AgentFolderWriter {
    pub(super) fn new(root: &Path, write_frame: WriteFrame) -> Self {
        Self {
            root: root.to_owned(),
            scene: SceneHeader::default(),
            folders: Vec::new(),
            mark: None,
            write_frame,
        }
    }
}

impl SceneWriter for AgentFolderWriter {
    /// Creates the folders, removing old ones.
    fn begin(&mut self, scene: &SceneHeader) -> Result<(), SynthError> {
        let folder = scene_path(&self.root, &scene.name);
        make_fresh_folder(&folder)?;
        self.mark = Some(Unfinished::mark(&folder)?);
        write_file(&folder.join(super::PROTOCOL_FILE), &scene.origin)?;
        let names = agent_folders(scene).into_iter();
        self.folders = names.map(|name| folder.join(name)).collect();
        self.scene = scene.clone();
        let mut folders = self.folders.iter();
        folders.try_for_each(|folder| make_folder(folder))
    }

    fn write(&self, moment: &Moment, _: &Omissions) -> Result<usize, SynthError> {
        moment.frames.iter().try_for_each(|frame| {
            let files = TickFiles {
                folder: &self.folders[frame.agent],
                tick: self.scene.capture_nanos[moment.index] / self.scene.tick_nanos,
                is_roadside: self.scene.agents[frame.agent].is_roadside,
            };
            (self.write_frame)(&files, frame)
        })?;
        Ok(moment.frames.len())
    }

    fn end(&mut self) -> Result<(), SynthError> {
        self.mark.take().map_or(Ok(()), Unfinished::clear)
    }
}
