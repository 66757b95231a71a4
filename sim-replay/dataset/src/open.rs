//! Opening of data sets: detects the layout of a folder by the table of layouts.

use std::path::Path;

use super::layout::{LayoutReader, LayoutRow, opened};
use super::layouts::LAYOUTS;
use super::{
    Dataset, OpenOptions, ReadError, Result, Scenario, agent_folders, files, layouts_text,
    recorded_motion, roots, unfinished,
};

/// Depth below the opened folder to which sequences of a single vehicle are searched.
const SEQUENCE_DEPTH: usize = 2;
/// Mount points of file systems that are not searched.
const KERNEL_FOLDERS: [&str; 2] = ["/proc", "/sys"];

/// Opens the data set, split, scenario or sequence in `dir`, or a recording; the layout is detected.
///
/// # Errors
/// [`ReadError`] if `dir` cannot be read or has no supported layout. Faults of single frames are found when they are
/// loaded; parts that had to be left out are listed in [`Dataset::problems`].
pub fn open(dir: &Path) -> Result<Dataset> {
    open_with(dir, &OpenOptions::default())
}

/// [`open`] with the properties that the data set does not record itself.
///
/// # Errors
/// As [`open`].
pub fn open_with(dir: &Path, options: &OpenOptions) -> Result<Dataset> {
    let canonical = dir.canonicalize().unwrap_or_default();
    let mut kernels = KERNEL_FOLDERS.iter();
    // The folders and files of the kernel's file systems have no end.
    if kernels.any(|kernel| canonical.starts_with(kernel)) {
        let reason = "no data set: a folder of the kernel";
        return Err(ReadError::malformed(dir, reason));
    }
    let mut dataset = open_among(&LAYOUTS, dir, options)?;
    unfinished::report(dir, &mut dataset);
    recorded_motion::check(&mut dataset);
    Ok(dataset)
}

/// Tries `layouts` in their order.
fn open_among(layouts: &[&LayoutRow], dir: &Path, options: &OpenOptions) -> Result<Dataset> {
    for layout in layouts {
        if let Some(LayoutReader::DataSet(open)) = layout.reader
            && let Some(dataset) = open(dir, options)?
        {
            return Ok(dataset);
        }
    }
    let mut search = SequenceSearch {
        layouts,
        root: dir,
        options,
        scenarios: Vec::new(),
        problems: Vec::new(),
    };
    search.open_below(dir, SEQUENCE_DEPTH)?;
    opened(dir, search.scenarios, search.problems)?.ok_or_else(|| unknown(dir))
}

/// Search for the sequences of a single vehicle.
struct SequenceSearch<'a> {
    layouts: &'a [&'a LayoutRow],
    root: &'a Path,
    options: &'a OpenOptions,
    /// Named by their paths below `root`.
    scenarios: Vec<Scenario>,
    problems: Vec<ReadError>,
}

impl SequenceSearch<'_> {
    /// Opens the sequences in `dir` or up to `depth` folders below.
    fn open_below(&mut self, dir: &Path, depth: usize) -> Result<()> {
        let reader = self.layouts.iter().find_map(|layout| match layout.reader {
            Some(LayoutReader::Sequence(is_one, open)) if is_one(dir) => Some(open),
            _ => None,
        });
        match reader.map(|open| open(dir, self.options, &mut self.problems)) {
            // One sequence that cannot be opened does not prevent opening the others.
            Some(Ok(scenario)) => self.scenarios.push(Scenario {
                name: files::name_below(self.root, dir),
                ..scenario
            }),
            Some(Err(error)) => self.problems.push(error),
            None if depth > 0 => {
                let below = files::list_below(dir, &files::list(dir)?, &mut self.problems);
                for (folder, _) in below {
                    self.open_below(&folder, depth - 1)?;
                }
            }
            None => {}
        }
        Ok(())
    }
}

fn unknown(dir: &Path) -> ReadError {
    let reason = if agent_folders::is_agent(dir) {
        "this is the folder of one agent: open the scenario above it".to_owned()
    } else if let Some(relative) = unsupported_kitti(dir) {
        relative.to_owned()
    } else {
        let layouts = layouts_text();
        format!(
            "no supported layout; at most three folders down, expected one of\n{}",
            layouts.trim_end()
        )
    };
    ReadError::malformed(dir, reason)
}

fn has_below(dir: &Path, path: &str) -> bool {
    !roots::find(dir, |dir| dir.join(path).exists()).is_empty()
}

/// Advice for the parts of KITTI that are not read.
fn unsupported_kitti(dir: &Path) -> Option<&'static str> {
    if has_below(dir, "velodyne_points/data") {
        return Some(
            "this looks like KITTI raw, whose GPS poses (oxts) are not read: use KITTI's odometry sequences of the \
             same drives, or write the poses of the LiDAR into a file poses.txt beside a folder velodyne with the \
             clouds; agent locate reads velodyne_points/data as it is",
        );
    }
    has_below(dir, "velodyne/0000/000000.bin").then_some(
        "this looks like KITTI tracking, which is not read: its poses (oxts) and labels (label_02) are in one file per \
         sequence; agent locate reads a folder velodyne/<sequence> as it is, KITTI's object data set is read with labels",
    )
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::PathBuf;
    use std::sync::Arc;

    use protocol::CavId;

    use super::super::{FrameSource, Layout, Tick, single_vehicle};
    use super::*;
    use crate::frame::Frame;
    use crate::pcd::PcdCloud;

    /// All that a layout needs: a row, a reader and the source of its frames.
    static DUMMY: LayoutRow = LayoutRow {
        key: "dummy",
        name: "dummy layout",
        data_sets: "none",
        files: "dummy.txt with a number of ticks",
        protocol: "opv2v",
        reader: Some(LayoutReader::Sequence(
            |dir| dir.join("dummy.txt").is_file(),
            open_dummy,
        )),
    };

    #[derive(Debug)]
    struct Dummy(PathBuf);

    impl FrameSource for Dummy {
        fn frame(&self, _: &CavId, _: &Tick) -> Result<Frame, ReadError> {
            Err(ReadError::malformed(&self.0, "no frames"))
        }

        fn points(&self, _: &CavId, _: &Tick, _: Option<&str>) -> Result<PcdCloud, ReadError> {
            Ok(PcdCloud::of_finite(vec![[1.0, 2.0, 3.0, 0.5]], Vec::new()))
        }

        fn shared_files(&self, _: &CavId) -> Vec<PathBuf> {
            Vec::new()
        }

        fn points_path(&self, _: &CavId, _: &Tick, _: Option<&str>) -> PathBuf {
            self.0.clone()
        }
    }

    fn open_dummy(
        dir: &Path,
        options: &OpenOptions,
        _: &mut Vec<ReadError>,
    ) -> Result<Scenario, ReadError> {
        let file = dir.join("dummy.txt");
        let count = fs::read_to_string(&file)
            .ok()
            .and_then(|text| text.trim().parse().ok());
        let count: u64 = count.ok_or_else(|| ReadError::malformed(&file, "no number"))?;
        let ticks = (0..count)
            .map(|index| Tick {
                stem: index.to_string(),
                capture_nanos: index * options.period_nanos,
            })
            .collect();
        let source = Arc::new(Dummy(file));
        Ok(single_vehicle(Layout(&DUMMY), ticks, source))
    }

    #[test]
    fn folders_of_the_kernel_are_not_searched() {
        let message = open(Path::new("/proc/self/..")).unwrap_err().to_string();
        assert_eq!(
            message,
            "/proc/self/..: no data set: a folder of the kernel"
        );
    }

    #[test]
    fn parts_of_kitti_that_are_not_read_have_advice() {
        for (cloud, expected) in [
            (
                "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/0000000000.bin",
                "this looks like KITTI raw",
            ),
            (
                "training/velodyne/0000/000000.bin",
                "this looks like KITTI tracking",
            ),
        ] {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join(cloud);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, [0; 16]).unwrap();
            let message = open(dir.path()).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn a_layout_is_one_row_and_one_reader() {
        let dir = tempfile::tempdir().unwrap();
        fs::create_dir(dir.path().join("first")).unwrap();
        fs::write(dir.path().join("first/dummy.txt"), "3").unwrap();
        assert!(open(dir.path()).is_err(), "the table has no such row");
        let layouts: Vec<&LayoutRow> = LAYOUTS.iter().copied().chain([&DUMMY]).collect();
        let dataset = open_among(&layouts, dir.path(), &OpenOptions::default()).unwrap();
        assert_eq!(
            (
                dataset.layout,
                dataset.scenarios.len(),
                dataset.problems.len()
            ),
            (Layout(&DUMMY), 1, 0)
        );
        let scenario = &dataset.scenarios[0];
        assert_eq!((scenario.name.as_str(), scenario.ticks.len()), ("first", 3));
        assert_eq!(
            scenario
                .source
                .points(&scenario.agents[0], &scenario.ticks[0], None)
                .unwrap()
                .points
                .xyzi
                .len(),
            1
        );
        assert_eq!(serde_json::to_string(&dataset.layout).unwrap(), "\"dummy\"");
    }
}
